"""The choice of readings, against all choices."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from toys import Vectorised, make_observations

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Series
from en4dvar.estimation.design.evaluate import choose
from en4dvar.estimation.design.planned import Planned
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem


def _planned(about=(), correlated=False):
    model, times = Vectorised(names=("a", "b", "c")), np.linspace(0.1, 3, 12)
    data = make_observations(times, np.zeros(12), std=0.3)
    if correlated:
        matrix = np.exp(-np.abs(np.subtract.outer(times, times)))
        data = type(data)(times, data.values, noise_of(data.std, 0 * times, matrix), data.weights)
    terms = tuple(PriorTerm.normal(p, 0.3, s) for p, s in zip(model.parameters, (0.8, 1.2, 0.9), strict=True))
    return Planned(InverseProblem(model, model.observables[0], data, Prior(terms)), about)


def _gain(planned, taken):
    j, times = np.arange(3), planned.problem.observations.times[list(taken)]
    S = np.cos(times[:, None] * j + j**2 / 3) * np.array([0.8, 1.2, 0.9]) / 0.3
    covariance = np.linalg.inv(np.eye(3) + S.T @ S)
    a = [planned.problem.prior.names.index(name) for name in planned.about]
    return -0.5 * np.linalg.slogdet(covariance[np.ix_(a, a)])[1]


@pytest.mark.parametrize("about", [(), ("b",), ("c", "a")])
def test_no_choice_is_better(about):
    planned = _planned(about)
    found = choose(planned, planned.draws(30, 1), 4)
    best = max(_gain(planned, taken) for taken in combinations(range(12), 4))
    assert _gain(planned, found) == pytest.approx(best, abs=1e-9)


@pytest.mark.parametrize("about", [(), ("b",), ("c", "a")])
def test_no_exchange_is_better_where_readings_lie_apart(about):
    planned = _planned(about)
    times, found = planned.problem.observations.times, choose(planned, planned.draws(30, 1), 4, 0.6).tolist()
    exchanged = [sorted({*found} - {one} | {other}) for one in found for other in range(12)]
    allowed = [taken for taken in exchanged if len(taken) == 4 and np.min(np.diff(times[taken])) >= 0.6]
    assert found in allowed
    assert len(allowed) > 4
    assert _gain(planned, found) == pytest.approx(max(_gain(planned, taken) for taken in allowed), abs=1e-9)


def test_readings_of_weight_zero_are_none_to_choose_from():
    """One that tells least, and whatever else is not among the four best, so that a fifth would be one of them."""
    planned = _planned()
    best = choose(planned, planned.draws(30, 1), 4)
    planned.problem = replace(
        planned.problem, observations=replace(planned.problem.observations, weights=1.0 * np.isin(range(12), best))
    )
    np.testing.assert_array_equal(choose(planned, planned.draws(30, 1), 4), best)
    with pytest.raises(ConfigError, match="no 5 of 4 readings"):
        choose(planned, planned.draws(30, 1), 5)


def test_readings_of_several_series_lie_apart_in_time_whatever_their_order():
    """Those at 0.4, 1.6, 9.4 and 10.6, though the series that stands first lies between them."""
    planned, times = _planned(), [np.array([1.0, 10.0]), np.array([0.4, 1.6, 9.4, 10.6])]
    (observable,) = planned.problem.model.observables
    series = [
        Series(observable, own, 0 * own, noise_of(0.3 + 0 * own, 0 * own), name=name)
        for name, own in zip("uv", times, strict=True)
    ]
    planned = Planned(replace(planned.problem, observations=Observations.of_series(series)))
    assert choose(planned, planned.draws(30, 1), 4, 1.0).tolist() == [2, 3, 4, 5]


def test_choices_that_are_not_possible():
    planned = _planned()
    with pytest.raises(ConfigError, match="no 6 of 12 readings lie so far apart"):
        choose(planned, planned.draws(30, 1), 6, 1.0)
    correlated = _planned(correlated=True)
    with pytest.raises(ConfigError, match="independent of each other"):
        choose(correlated, correlated.draws(30, 1), 3)
