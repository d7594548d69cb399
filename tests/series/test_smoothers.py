"""EnKS and EnRTS: the Kalman smoother of a linear model, each other elsewhere, and members that are lost."""

from __future__ import annotations

import numpy as np
import pytest
from test_exact import CYCLES, batch_posterior, chaotic_twin, close, linear_twin
from test_loop import Breaking, Forced, members, series

from en4dvar.model.forward import Batch, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, StateLayout
from en4dvar.schemes.enkf_n import EnKFN
from en4dvar.schemes.filters import ESRF, ETKF, Climatology
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.sequential import SequentialSettings, run_sequential
from en4dvar.series.series import CycleSeries
from en4dvar.series.settings import EnKS, EnRTS, Inflation


@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("smoother", [EnKS(1), EnKS(3), EnKS(CYCLES + 2), EnRTS()])
@pytest.mark.parametrize(("scheme", "n_members"), [(ETKF(), 5), (ETKF(), 30), (ESRF(), 12)])
def test_smoothed_moments_are_those_of_the_kalman_smoother(scheme, n_members, smoother, rotation):
    model, observed, start, y = linear_twin(n_members)
    settings = SequentialSettings(scheme, rotation=rotation, smoother=smoother)
    result = run_sequential(model, observed, start, y, settings)
    plain = run_sequential(model, observed, start, y, SequentialSettings(scheme, rotation=rotation))
    assert np.array_equal(result.analysis.mean, plain.analysis.mean)  # the filter does not notice
    assert np.isnan(plain.smoothed.mean).all()
    for k in range(1, CYCLES + 1):
        upto = min(CYCLES, k + getattr(smoother, "lag", CYCLES))
        mean, cov = batch_posterior(model, start, y, upto, k)
        close(result.smoothed.mean[k - 1, :8], mean, 1e-11)
        close(result.smoothed.std[k - 1, :8], np.sqrt(np.diag(cov)), 1e-11)


def test_both_are_the_same_in_the_space_of_a_small_ensemble():
    """Fewer members than variables, chaos and rotation: J_k then is exact along every anomaly."""
    model, start, y = chaotic_twin(n_members=12)
    results = [
        run_sequential(model, model.observables, start, y, SequentialSettings(EnKFN(), rotation=True, smoother=one))
        for one in (EnKS(20), EnRTS())
    ]
    assert results[0].smoothed.mean == pytest.approx(results[1].smoothed.mean, abs=1e-8)
    assert results[0].smoothed.std == pytest.approx(results[1].smoothed.std, abs=1e-8)


@pytest.mark.parametrize("smoother", [EnKS(2), EnRTS()])
def test_the_past_of_lost_members_is_not_smoothed(smoother):
    """Members fail in the third cycle; nothing is learned after the first, so what is smoothed are the survivors."""
    start, blind = members(), series(std=1e9)
    lost = np.abs(start[:, 1]) > 1.2
    result = run_sequential(
        Breaking(1.2, 2.5), Forced.observables, start, blind, SequentialSettings(ETKF(), smoother=smoother)
    )
    alone = start[~lost, 1]
    assert len(result.failures) == lost.sum() > 0
    assert result.analysis.mean[1, 1] == pytest.approx(start[:, 1].mean(), abs=1e-9)
    assert result.smoothed.mean[1, 1] == pytest.approx(alone.mean(), abs=1e-9)
    assert result.smoothed.std[1, 1] == pytest.approx(alone.std(ddof=1), abs=1e-9)


class Damped(ForwardModel):
    """One variable that decays, or two that turn as well."""

    parameters = ()
    autonomous = True

    def __init__(self, size):
        self.layout = StateLayout(tuple(Field(name) for name in "xv"[:size]))
        self.observables = (Observable("x", "1", StateField("x")),)

    def initial_state(self, theta):
        return np.zeros(self.layout.size)

    def flow(self, h):
        turned = np.array([[np.cos(h), np.sin(h)], [-np.sin(h), np.cos(h)]]) if self.layout.size == 2 else np.eye(1)
        return np.exp(-0.3 * h) * turned

    def trajectories(self, x, times):
        times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return Batch(times, np.stack([x @ self.flow(h).T for h in times[0]], axis=1), self.layout)


UNEVEN, R = np.cumsum([0.4, 1.0, 0.3, 0.8, 0.8, 1.5, 0.2, 0.9, 0.6, 1.1, 0.7, 0.5]), 0.25


def of_kalman(model, ensemble, y, rate, inflation, lag):
    """Mean and standard deviation (K, n) of the Rauch–Tung–Striebel smoother by ``lag`` later observations.

    Inflation is an error that joins the analysis, and makes its covariance that of inflated anomalies.
    """
    mean, cov, found, ahead = ensemble.mean(axis=0), np.atleast_2d(np.cov(ensemble.T)), [], []
    for k, dt in enumerate(np.diff(UNEVEN, prepend=0.0)):
        m = model.flow(dt)
        mean, cov, past = m @ mean, m @ cov @ m.T + np.diag(rate * dt), m @ cov
        ahead.append((mean, cov, past))
        gain = cov[:, 0] / (cov[0, 0] + R)
        mean, cov = mean + gain * (y[k] - mean[0]), inflation**2 * (cov - np.outer(gain, cov[0]))
        found.append((mean, cov))
    smoothed = []
    for at in range(len(y)):
        mean, cov = found[min(len(y) - 1, at + lag)]
        for k in range(min(len(y) - 1, at + lag), at, -1):
            analysed, inflated = found[k]  # what joined it is taken away: of the covariance C to C / λ²
            mean = analysed + (mean - analysed) / inflation**2
            cov = inflated / inflation**2 + (cov - inflated) / inflation**4
            forecast, spread, past = ahead[k]
            gain = np.linalg.solve(spread, past).T
            before, known = found[k - 1]
            mean, cov = before + gain @ (mean - forecast), known + gain @ (cov - spread) @ gain.T
        smoothed.append((mean, np.sqrt(np.diag(cov))))
    return [np.array(moments) for moments in zip(*smoothed, strict=True)]


def off(size, n_members, std, form, smoother, inflation=1.0, rotation=False, seed=0):
    """By how much smoothed means are off (K, n), in posterior standard deviations, and these as a ratio, minus 1."""
    model, rng = Damped(size), np.random.default_rng(seed)
    start, y = 1 + rng.standard_normal((n_members, size)), np.random.default_rng(7).standard_normal(len(UNEVEN))
    rate = np.full(size, std**2) * [0.0, 1.0][-size:]  # of two variables, of the one that is not read
    settings = SequentialSettings(
        ETKF(), Inflation(inflation), rotation, model_error=ModelError(rate, form), smoother=smoother
    )
    series = CycleSeries(UNEVEN, y[:, None], np.sqrt([R]))
    result = run_sequential(model, model.observables, start, series, settings, seed).smoothed
    mean, sd = of_kalman(model, start, y, rate, inflation, getattr(smoother, "lag", len(y)))
    return (result.mean - mean) / sd, result.std / sd - 1


@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("inflation", [1.0, 1.05])
@pytest.mark.parametrize("std", [0.05, pytest.param(0.6, marks=pytest.mark.slow), 4.0])
@pytest.mark.parametrize("size", [1, 2])
def test_enrts_is_the_kalman_smoother_with_model_error(size, std, inflation, rotation):
    """By a square root mean and spread, of what is drawn the mean; the spread is unbiased but for its noise."""
    for n_members in (20, size + 1):
        mean, spread = off(size, n_members, std, "square-root", EnRTS(), inflation, rotation)
        assert max(np.abs(mean).max(), np.abs(spread).max()) < 1e-11
        mean, _ = off(size, max(n_members, size + 2), std, "drawn", EnRTS(), inflation, rotation)
        assert np.abs(mean).max() < 1e-11
    found = [off(size, 20, std, "drawn", EnRTS(), inflation, rotation, seed) for seed in range(6)]
    assert np.abs(np.mean([spread for _, spread in found], axis=0)).max() < 0.2


@pytest.mark.parametrize("size", [pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("smoother", [EnKS(3), pytest.param(EnKS(10), marks=pytest.mark.slow), EnRTS()])
def test_what_draws_leave_falls_with_the_members(smoother, size):
    """As 1/√N: of the EnKS in mean and spread, of the EnRTS in the spread."""
    few, many = (
        np.array([off(size, n, 0.6, "drawn", smoother, seed=seed) for seed in range(12)]).std(axis=(0, 2, 3))
        for n in (20, 320)
    )
    assert np.all(many < np.maximum(0.4 * few, 1e-11))
    assert np.all(many < 0.1)


def test_what_takes_no_smoother():
    local = BlockLocalisation([np.arange(2)], np.ones((1, 2)))
    for scheme in (IEnKS(1), Climatology()):
        with pytest.raises(ValueError, match="behind a filter that is cycled"):
            SequentialSettings(scheme, smoother=EnRTS())
    for smoother in (EnKS(2), EnRTS()):
        with pytest.raises(ValueError, match="takes no localisation; scheme ienks smooths with it"):
            SequentialSettings(ETKF(), localisation=local, smoother=smoother)
    with pytest.raises(ValueError, match="leaves no member its past, which enks needs; use enrts, or drawn"):
        SequentialSettings(ETKF(), model_error=ModelError(np.ones(1), "square-root"), smoother=EnKS(2))
    with pytest.raises(ValueError, match="must be at least 1, not 0"):
        EnKS(0)
