"""Members as arrays: a batch, a list and single members give the same numbers; who is in trouble is singled out."""

from dataclasses import replace

import numpy as np
import pytest
from same_bits import assert_same_bits
from toys import Vectorised, make_problem

from en4dvar import Batch
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Observable, ValidityLimit
from en4dvar.schemes.settings import AssimilationSettings

NAMES, TRUTH = ("a", "b", "c"), (1.0, 0.5, 0.2)
GRID = np.linspace(0.3, 1.9, 7)


class Whole(Vectorised):
    """Returns all members in arrays; those with a first parameter beyond ``limit`` end in NaN half-way."""

    validity = (ValidityLimit("y", 1.0), ValidityLimit("v", 1.0))

    def __init__(self, limit=np.inf, **options):
        super().__init__(names=NAMES, **options)
        self.limit = limit

    def trajectories(self, x, times):
        paths = super().trajectories(x, times)
        states = np.array([path.states for path in paths])
        states[x[:, 2] > self.limit, states.shape[1] // 2 :] = np.nan
        return Batch(np.array([path.times for path in paths]), states, self.layout)


class Listed(Whole):
    """The same as a list."""

    def trajectories(self, x, times):
        return list(super().trajectories(x, times))


def curve_of_one(path):
    """H that cannot take a batch: it says so by having no ``batched``."""
    assert path["y"].ndim == 1
    return path["y"]


@pytest.mark.parametrize("time_std", [0.0, 0.02])
@pytest.mark.parametrize("limit", [np.inf, 0.8])
def test_batch_and_list_have_the_same_bits(time_std, limit):
    problem = make_problem(Whole(limit), TRUTH, time_std=time_std)
    x = problem.prior.sample(12, 0)
    batch, listed = (forecast(replace(problem, model=m), x, None, GRID) for m in (Whole(limit), Listed(limit)))
    lost = x[:, 0] > limit
    assert lost.any() == np.isfinite(limit)
    assert batch.failures == listed.failures
    assert batch.failures == tuple("non-finite state" if i else "" for i in lost)
    for name in ("predictions", "path", "extremes", "beyond"):
        np.testing.assert_array_equal(getattr(batch, name), getattr(listed, name))
    if batch.predicted.rates is not None:
        np.testing.assert_array_equal(batch.predicted.rates, listed.predicted.rates)
    assert np.isfinite(batch.predictions[~lost]).all()
    assert np.isnan(batch.predictions[lost]).all()
    assert np.isnan(batch.extremes[lost]).all()
    assert batch.extremes.shape == (12, 2)
    assert np.allclose(batch.extremes[~lost, 0], np.abs(np.hstack([batch.predictions, batch.path])[~lost]).max(axis=1))


def test_operator_that_takes_one_path_never_sees_a_batch():
    problem = make_problem(Whole(), TRUTH)
    single = replace(problem, observable=Observable("y", "m", curve_of_one))
    x = problem.prior.sample(9, 0)
    run = forecast(single, x)
    assert run.failures == ("",) * 9
    np.testing.assert_array_equal(run.predictions, forecast(problem, x).predictions)


def test_members_alone_have_the_same_bits():
    problem = make_problem(Whole(), TRUTH)
    x = problem.prior.sample(6, 0)
    together = forecast(problem, x).predictions
    np.testing.assert_array_equal(np.concatenate([forecast(problem, row[None]).predictions for row in x]), together)


def test_posterior_does_not_depend_on_how_paths_come():
    settings = AssimilationSettings(members=13)
    batch, listed = (assimilate(make_problem(model, TRUTH), settings, 3) for model in (Whole(), Listed()))
    assert_same_bits(batch, listed)
