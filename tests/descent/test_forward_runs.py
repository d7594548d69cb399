"""No forward run is wasted: how often the model runs, that all of it is counted, and the times it is asked for."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Failure
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

TIMES = np.linspace(0.1, 6.0, 30)
TRUTH = {"A": 1.2, "c": 0.3, "w": 2.2, "f": 0.3}


def wave(p, t):
    """A damped oscillation, far from linear in c, w and f."""
    return p["A"] * np.exp(-p["c"] * t) * np.cos(p["w"] * t + p["f"])


class Counted(FunctionModel):
    """Counts its runs by the number of times that they are asked for."""

    def __init__(self, dense=False):
        super().__init__(wave, [Parameter(name, "1") for name in TRUTH], {"y": "1"}, dense=dense)
        self.asked = Counter()

    def trajectories(self, x, times):
        self.asked[np.shape(times)[-1]] += len(x)
        return super().trajectories(x, times)


def estimate(model, seed=0, **settings):
    values = wave(TRUTH, TIMES) + 0.05 * np.random.default_rng(seed).standard_normal(30)
    a, c, w, f = model.parameters
    prior = Prior(
        (
            PriorTerm.lognormal(a, 1.0, 0.3),
            PriorTerm.lognormal(c, 0.2, 0.5),
            PriorTerm.lognormal(w, 2.0, 0.2),
            PriorTerm.normal(f, 0.0, 0.5),
        )
    )
    data = Observations(TIMES, values, noise_of(np.full(30, 0.05)), np.ones(30))
    problem = InverseProblem(model, model.observables[0], data, prior)
    return assimilate(problem, AssimilationSettings(**settings), seed)


@pytest.mark.parametrize("seed", range(5))
def test_a_plain_estimate_of_four_parameters_takes_about_two_hundred(seed):
    analysis = estimate(model := Counted(), seed)
    assert analysis.converged
    assert analysis.forward_runs == model.asked.total() <= 225  # of them some 40 for a descent from a far member


def test_es_mda_takes_its_passes_and_the_posterior():
    analysis = estimate(model := Counted(), scheme="es-mda", members=100)
    assert analysis.forward_runs == model.asked.total() == 5 * 101 + 2  # two of them run again, to compare


def test_what_a_chain_and_alternatives_take_is_counted():
    assert estimate(model := Counted(), refine="mcmc", members=16).forward_runs == model.asked.total()
    assert estimate(model := Counted(), linearisation="transform").forward_runs == model.asked.total()


def test_a_model_is_asked_for_the_observations_alone_unless_more_is_free():
    plain, smooth = estimate(sparse := Counted()), estimate(dense := Counted(dense=True))
    assert set(sparse.asked) == {30}
    np.testing.assert_array_equal(plain.trajectory_times, TIMES)
    np.testing.assert_array_equal(plain.posterior_trajectories, plain.posterior_predictions)
    prior_posterior_and_repeated = 2 * 49 + 2
    assert dense.asked == {228: prior_posterior_and_repeated, 30: smooth.forward_runs - prior_posterior_and_repeated}
    assert smooth.trajectory_times.shape == (200,)
    np.testing.assert_array_equal(smooth.posterior, plain.posterior)


def test_a_function_whose_times_are_fixed_is_never_asked_for_others():
    def recorded(p, t):
        if len(t) != 30:
            raise ValueError("asked for other times")
        return wave(p, t)

    model = Counted()
    model.function = recorded
    assert not any(estimate(model).posterior_failures)
    (lost,) = model.trajectories(np.ones((1, 4)), TIMES[:5])
    assert isinstance(lost, Failure)
    assert lost.reason == "ValueError: asked for other times"
