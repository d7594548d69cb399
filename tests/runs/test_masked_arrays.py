"""Masked arrays of NumPy: what is masked is missing, in readings, times, errors and predictions."""

from __future__ import annotations

import numpy as np
import pytest
from toys import Linear

import en4dvar
from en4dvar.ensemble.tangent import _LinearPaths
from en4dvar.inputs.arrays import columns_of
from en4dvar.model.forward import Failure, Trajectory, instants_of
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter, floats
from en4dvar.plumbing.errors import DataError

T = np.linspace(1, 60, 20)
Y = 3 * np.exp(-0.05 * T) + 0.05 * np.random.default_rng(3).standard_normal(20)
PRIORS = {
    "a": {"prior": "lognormal", "median": 2, "log_std": 0.5},
    "k": {"prior": "lognormal", "median": 0.03, "log_std": 0.7},
}
WHERE = np.arange(20) == 5


def masked(values, wrong=9.9):
    return np.ma.masked_array(np.where(WHERE, wrong, values), WHERE)


def decay(p, t):
    return p["a"] * np.exp(-p["k"] * t)


def estimated(data, error=0.05, function=decay):
    return en4dvar.estimate(function, data, PRIORS, error=error, progress=False, seed=1)


def test_what_is_masked_is_nan():
    np.testing.assert_array_equal(floats(np.ma.masked_array([1, 2], [False, True])), [1.0, np.nan])
    assert not isinstance(floats(masked(Y)), np.ma.MaskedArray)
    for data in ((T, masked(Y)), {"time": T, "y": masked(Y)}):
        np.testing.assert_array_equal(columns_of(data)["y"], np.where(WHERE, np.nan, Y))


def test_a_masked_reading_is_missing():
    own, expected = (estimated((T, y)) for y in (masked(Y), np.where(WHERE, np.nan, Y)))
    assert str(own) == str(expected)


def test_a_masked_time_or_error_is_told():
    with pytest.raises(DataError, match="the time of reading 6 is NaN or masked; leave out"):
        estimated((masked(T, -999.0), Y))
    with pytest.raises(DataError, match=r"the error of reading 6 .* is blank"):
        estimated((T, Y), masked(np.full(20, 0.05), 1e-9))
    with pytest.raises(en4dvar.ConfigError, match="times: give"):
        instants_of(masked(T), "s")


def test_a_masked_prediction_is_nan():
    model = FunctionModel(lambda p, t: masked(decay(p, t)), [Parameter(n, "1") for n in "ak"], {"y": "1"})
    (path,) = model.trajectories(np.array([[3.0, 0.05]]), T)
    np.testing.assert_array_equal(np.isnan(path["y"]), WHERE)


class MaskedModel(Linear):
    """Masks a part of its state, its derivatives and its first state."""

    at_start = False

    def initial_state(self, theta):
        return np.ma.masked_array(super().initial_state(theta), [self.at_start, False, False, False])

    def step(self, x, t0, t1):
        return np.ma.masked_array(super().step(x, t0, t1), [t1 > 2, False, False, False])

    def tangent(self, x, directions, times):
        changes = np.ma.masked_array(np.ones((len(directions), len(times), 4)), True)
        return Trajectory(times, np.ones((len(times), 4)), self.layout), changes


def test_a_masked_state_is_that_of_a_lost_member():
    model, theta = MaskedModel(), {"a": np.ones(2), "b": np.ones(2)}
    assert model.trajectories(model.initial_states(theta), T) == [Failure("non-finite state", T[1])] * 2
    model.at_start = True
    assert np.isnan(model.initial_states(theta)[:, 0]).all()
    *others, _ = _LinearPaths().trajectories(model, np.ones((3, 4)), np.tile(T, (3, 1)))
    assert all(np.isnan(path.states).all() for path in others)
