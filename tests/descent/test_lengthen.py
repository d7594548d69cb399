"""Windows that are lengthened: a chaotic window reaches the minimum at the truth, which descents alone do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaotic import chaotic
from cut_anywhere import assert_cut_anywhere
from toys import Linear, make_problem, with_discrepancy, with_noise

from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes.settings import AssimilationSettings

OPTIONS = {"members": 60, "refine": "none", "what_if": False, "emulator": "off"}


def _cost(problem, seed, **more):
    return assimilate(problem, AssimilationSettings(**OPTIONS, **more), seed=seed).iterations[-1].cost


def test_a_chaotic_window_ends_in_a_wrong_minimum_unless_it_is_lengthened():
    problem, truth = chaotic(seed=1)
    assert _cost(problem, 1) > 3 * truth
    assert _cost(problem, 1, lengthen=6) < truth


@pytest.mark.slow
def test_nine_of_ten_reach_the_minimum_of_the_truth():
    """24 modes and two parameters over five times in which errors grow by e; J at the minimum is below the truth's."""
    reached = 0
    for seed in range(20, 30):
        problem, truth = chaotic(seed)
        reached += _cost(problem, seed, lengthen=6) < truth
    assert reached >= 9


@pytest.mark.parametrize("correlated", [False, True])
def test_a_linear_problem_ends_where_it_does_without(correlated):
    problem = make_problem(Linear(("a", "b")), [1.0, -0.5])
    if correlated:
        apart = np.abs(np.subtract.outer(*[problem.observations.times] * 2))
        problem = replace(problem, observations=with_noise(problem.observations, correlation=np.exp(-apart / 0.4)))
    with_and_without = [assimilate(problem, AssimilationSettings(lengthen=n), seed=2) for n in (1, 4)]
    np.testing.assert_allclose(*(a.posterior for a in with_and_without), rtol=1e-9)
    assert with_and_without[1].forward_runs > with_and_without[0].forward_runs - 60


def test_a_discrepancy_waits_for_the_whole_window():
    problem = with_discrepancy(make_problem(Linear(("a", "b")), [1.0, -0.5]))
    with_and_without = [assimilate(problem, AssimilationSettings(lengthen=n), seed=2) for n in (1, 4)]
    np.testing.assert_allclose(*(a.centre for a in with_and_without), rtol=1e-3)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_to_the_same_bits():
    problem, _ = chaotic(seed=3)
    assert_cut_anywhere(problem, AssimilationSettings(**OPTIONS, lengthen=4), 1, cuts=4)


def test_readings_at_one_time_have_no_window_to_lengthen():
    problem = make_problem(Linear(("a", "b")), [1.0, -0.5])
    data = problem.observations
    noise = replace(data.noise, std=data.std[:1], time_std=data.noise.time_std[:1])
    one = replace(data, times=data.times[:1], values=data.values[:1], weights=data.weights[:1], noise=noise)
    with pytest.raises(ConfigError, match="no window to lengthen"):
        assimilate(replace(problem, observations=one), AssimilationSettings(lengthen=3), seed=1)
