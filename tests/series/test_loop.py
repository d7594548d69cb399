"""The sequential loop: members that fail, models that depend on time, bad input."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.data.noise import Correlation
from en4dvar.model.forward import Failure, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, StateLayout
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.schemes.filters import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.sequential import CycleSeries, SequentialSettings, run_sequential


class Forced(ForwardModel):
    """dx/dt = cos t, dy/dt = 0: the path of x depends on the instant it starts at."""

    parameters = ()
    layout = StateLayout((Field("x"), Field("y")))
    observables = (Observable("x", "1", StateField("x")), Observable("y", "1", StateField("y")))

    def initial_state(self, theta):
        return np.zeros(2)

    def step(self, x, t0, t1):
        return x + np.array([np.sin(t1) - np.sin(t0), 0.0])


class Breaking(Forced):
    """Members with |y| beyond a limit fail once the window has passed time ``when``."""

    def __init__(self, limit, when):
        self.limit, self.when = limit, when

    def step(self, x, t0, t1):
        if t1 > self.when and abs(x[1]) > self.limit:
            raise ArithmeticError("too stiff")
        return super().step(x, t0, t1)


def series(cycles=4, std=0.5):
    values = np.random.default_rng(0).standard_normal((cycles, 2))
    return CycleSeries(np.arange(1.0, cycles + 1), values, np.full(2, std))


def members(n=10):
    return np.random.default_rng(1).standard_normal((n, 2))


@pytest.mark.parametrize("scheme", [ETKF(), IEnKS(1), IEnKS(3)])
def test_a_model_that_depends_on_time_is_run_from_the_right_instant(scheme):
    model, blind = Forced(), series(std=1e9)  # observations that say nothing leave the free run
    result = run_sequential(model, model.observables, members(), blind, SequentialSettings(scheme))
    expected = members().mean(axis=0) + np.column_stack([np.sin(blind.times), np.zeros(4)])
    assert result.analysis.mean == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("scheme", [ETKF(), IEnKS(1), IEnKS(2)])
def test_lost_members_leave_an_ensemble_of_the_survivors(scheme):
    start = members()
    lost = np.abs(start[:, 1]) > 1.2
    assert 1 <= lost.sum() <= 4
    # all fail in the first cycle, so that the survivors alone must give the same
    model = Breaking(1.2, 0.0)
    result = run_sequential(model, model.observables, start, series(), SequentialSettings(scheme))
    alone = run_sequential(Forced(), model.observables, start[~lost], series(), SequentialSettings(scheme))
    assert result.members == pytest.approx(alone.members, abs=1e-12)
    assert result.failures == ("ArithmeticError: too stiff (t = 0 to 1)",) * int(lost.sum())
    assert alone.failures == ()


def test_too_few_members_is_an_error():
    model = Breaking(0.1, 1.5)
    with pytest.raises(TooFewMembersError, match=r"of 10 members failed, at least 5 .*too stiff"):
        run_sequential(model, model.observables, members(), series(std=5.0), SequentialSettings(ETKF()))


def test_failures_may_be_values():
    class Failing(Forced):
        autonomous = True

        def trajectories(self, x, times):
            results = list(super().trajectories(x, times))
            results[0] = Failure("first") if len(x) == 10 else results[0]
            return results

    result = run_sequential(Failing(), Forced.observables, members(), series(), SequentialSettings(ETKF()))
    assert result.failures == ("first (t = 0 to 1)",)
    assert len(result.members) == 9


@pytest.mark.parametrize("scheme", [ETKF(), IEnKS(1)])
def test_a_prediction_that_is_no_number_loses_the_reading_and_not_its_member(scheme):
    """The operator is linear, so that what is regressed on the others is what it would have given."""

    def gap(trajectory):
        return np.where(trajectory["y"] > 0.7, np.nan, trajectory["y"])

    start = members()
    assert (start[:, 1] > 0.7).sum() == 1
    runs = []
    for second in (gap, lambda trajectory: trajectory["y"]):
        observed = (Forced.observables[0], Observable("gap", "1", second))
        runs.append(run_sequential(Forced(), observed, start, series(), SequentialSettings(scheme)))
    assert runs[0].failures == ()
    assert runs[0].members == pytest.approx(runs[1].members, abs=1e-9)


@pytest.mark.parametrize("scheme", [ETKF(), IEnKS(1)])
def test_an_infinite_prediction_loses_its_member(scheme):
    def wall(trajectory):
        return np.where(trajectory["y"] > 0.7, np.inf, trajectory["y"])

    start = members()
    lost = start[:, 1] > 0.7
    observed = (Forced.observables[0], Observable("wall", "1", wall))
    blind = series(std=1e9)  # so that no other member is moved into it
    result = run_sequential(Forced(), observed, start, blind, SequentialSettings(scheme))
    assert result.failures == ("non-finite prediction (t = 0 to 1)",)
    assert result.members[:, 1] == pytest.approx(start[~lost, 1], abs=1e-9)


def test_count_of_forward_runs():
    model = Forced()
    filtered = run_sequential(model, model.observables, members(), series(), SequentialSettings(ETKF()))
    assert filtered.forward_runs == 4 * 10
    smoothed = run_sequential(model, model.observables, members(), series(), SequentialSettings(IEnKS(1)))
    # the model is linear: the second step is zero, so each window is run twice and once to its analysis
    assert smoothed.iterations.tolist() == [2, 2, 2, 2]
    assert smoothed.forward_runs == 4 * 3 * 10


def test_progress_is_told_each_cycle():
    seen = []
    model = Forced()
    run_sequential(model, model.observables, members(), series(), SequentialSettings(ETKF()), on_cycle=seen.append)
    assert seen == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("times", "values", "std", "message"),
    [
        (np.array([1.0, 1.0]), np.zeros((2, 1)), np.ones(1), "increase"),
        (np.array([-0.1, 1.0]), np.zeros((2, 1)), np.ones(1), "increase from zero"),
        (np.array([1.0]), np.zeros((2, 1)), np.ones(1), "do not match times"),
        (np.array([1.0]), np.zeros((1, 2)), np.ones(1), "does not match values"),
        (np.array([1.0]), np.zeros((1, 1)), np.zeros(1), "positive"),
    ],
)
def test_bad_series(times, values, std, message):
    with pytest.raises(ValueError, match=message):
        CycleSeries(times, values, std)


@pytest.mark.parametrize(
    ("correlation", "message"),
    [
        (np.eye(3), "does not match 2 observations"),
        (np.array([[1.0, 0.2], [0.3, 1.0]]), "symmetric with a unit diagonal"),
        (np.array([[2.0, 0.2], [0.2, 2.0]]), "symmetric with a unit diagonal"),
        (np.array([[1.0, 1.2], [1.2, 1.0]]), "not positive definite"),
    ],
)
def test_bad_correlation(correlation, message):
    with pytest.raises(ValueError, match=message):
        CycleSeries(np.array([1.0]), np.zeros((1, 2)), np.ones(2), Correlation(correlation))


def test_localisation_needs_independent_errors():
    local = BlockLocalisation([np.arange(2)], np.ones((1, 2)))
    y = CycleSeries(np.array([1.0]), np.zeros((1, 2)), np.ones(2), Correlation(np.eye(2)))
    with pytest.raises(ValueError, match="independent errors"):
        run_sequential(Forced(), Forced.observables, members(), y, SequentialSettings(ETKF(), localisation=local))


def test_errors_may_differ_by_time():
    model, plain = Forced(), series()
    each = CycleSeries(plain.times, plain.values, np.tile(plain.std, (4, 1)))
    a, b = (run_sequential(model, model.observables, members(), y, SequentialSettings(IEnKS(1))) for y in (plain, each))
    assert np.array_equal(a.members, b.members)
    blind = each.std.copy()
    blind[1:] = 1e12
    once = run_sequential(
        model, model.observables, members(), CycleSeries(plain.times, plain.values, blind), SequentialSettings(ETKF())
    )
    assert once.analysis.std[-1] == pytest.approx(once.analysis.std[0], rel=1e-9)
    assert np.all(b.analysis.std[-1] < 0.9 * once.analysis.std[-1])
