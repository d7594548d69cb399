"""Series with model error, windows that move by several cycles, and repeated assimilation, where the answer is known.

The references are the Kalman filter and one big regression on all states at once (the Rauch–Tung–Striebel smoother),
written out here with matrices alone.
"""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.model.forward import Observable
from en4dvar.priors.prior import whiten_sample
from en4dvar.schemes.filters import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.series.model_error import ModelError, fresh_noise, narrowed
from en4dvar.series.sequential import SequentialSettings, run_sequential
from en4dvar.series.series import CycleSeries
from en4dvar.series.settings import Inflation
from en4dvar_lorenz import Linear
from en4dvar_lorenz.linear import LinearSettings

N, STD, GAMMA = 4, 0.4, 0.1  # variables; the damping rate is the fifth, constant
TIMES = np.array([0.3, 0.5, 1.1, 1.2, 1.8, 2.3, 2.9])  # irregular
RATE = np.array([0.2, 0.0, 0.05, 0.3, 0.0])
SEEN = np.array([0, 3])


def two_of_four(trajectory):
    return trajectory.states[:, SEEN]


def twin(members, gaps=True):
    model = Linear.from_settings(LinearSettings(oscillators=2))
    rng = np.random.default_rng(5)
    ensemble = np.hstack([1 + rng.standard_normal((members, N)), np.full((members, 1), GAMMA)])
    values = rng.standard_normal((len(TIMES), 2))
    if gaps:
        values[1] = np.nan
        values[3, 0] = np.nan
    return model, (Observable("seen", "1", two_of_four),), ensemble, CycleSeries(TIMES, values, np.full(2, STD))


def flow(model, t):
    unit = np.hstack([np.eye(N), np.full((N, 1), GAMMA)])
    return np.array([model.step(row, 0.0, t)[:N] for row in unit]).T


def given(model, ensemble, series, rate):
    """``(upto, at)`` → mean and covariance of the state at time ``at`` given y_1…y_upto, from the joint Gaussian."""
    steps = np.diff(series.times, prepend=0.0)
    size = N * (len(steps) + 1)
    mean, cov = np.zeros(size), np.zeros((size, size))
    mean[:N], cov[:N, :N] = ensemble[:, :N].mean(axis=0), np.cov(ensemble[:, :N].T)
    for k, dt in enumerate(steps, 1):
        m, here, before = flow(model, dt), slice(N * k, N * k + N), slice(N * k - N, N * k)
        mean[here] = m @ mean[before]
        cov[here, : N * k] = m @ cov[before, : N * k]
        cov[: N * k, here] = cov[here, : N * k].T
        cov[here, here] = m @ cov[before, before] @ m.T + np.diag(rate[:N] * dt)

    def posterior(upto, at):
        there = [(k, i) for k in range(upto) for i in range(2) if np.isfinite(series.values[k, i])]
        rows = np.array([N * (k + 1) + SEEN[i] for k, i in there], dtype=int)
        y = np.array([series.values[k, i] for k, i in there])
        here = slice(N * at, N * at + N)
        if not len(rows):
            return mean[here], np.sqrt(np.diag(cov[here, here]))
        gain = cov[here][:, rows] @ np.linalg.inv(cov[np.ix_(rows, rows)] + STD**2 * np.eye(len(rows)))
        found = cov[here, here] - gain @ cov[rows][:, here]
        return mean[here] + gain @ (y - mean[rows]), np.sqrt(np.diag(found))

    return posterior


def check(moments, k, expected):
    assert moments.mean[k, :N] == pytest.approx(expected[0], abs=1e-10)
    assert moments.std[k, :N] == pytest.approx(expected[1], abs=1e-10)


@pytest.mark.parametrize(("form", "members"), [("drawn", 9), ("square-root", 6)])
@pytest.mark.parametrize("inflation", [1.0, 1.07])
def test_etkf_with_model_error_is_the_kalman_filter(form, members, inflation):
    model, observed, ensemble, series = twin(members)
    settings = SequentialSettings(ETKF(), Inflation(inflation), model_error=ModelError(RATE, form))
    result = run_sequential(model, observed, ensemble, series, settings)
    mean, cov = ensemble[:, :N].mean(axis=0), np.cov(ensemble[:, :N].T)
    for k, dt in enumerate(np.diff(TIMES, prepend=0.0)):
        m, there = flow(model, dt), np.isfinite(series.values[k])
        mean, cov = m @ mean, m @ cov @ m.T + np.diag(RATE[:N] * dt)
        h = np.eye(N)[SEEN[there]]
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + STD**2 * np.eye(there.sum()))
        mean, cov = mean + gain @ (series.values[k][there] - h @ mean), inflation**2 * (np.eye(N) - gain @ h) @ cov
        check(result.analysis, k, (mean, np.sqrt(np.diag(cov))))


@pytest.mark.parametrize(
    "scheme",
    [
        IEnKS(1),
        IEnKS(2),
        IEnKS(len(TIMES) + 1),
        IEnKS(2, "bundle", epsilon=1e-3),
        IEnKS(3, shift=2),
        IEnKS(2, shift=2),
        IEnKS(3, mda_weights=(1, 1, 1)),
        IEnKS(2, mda_weights=(3, 1)),
    ],
    ids=str,
)
@pytest.mark.parametrize("rate", [RATE, None], ids=["Q", "no Q"])
def test_ienks_is_the_smoother_of_rauch_tung_and_striebel(scheme, rate):
    model, observed, ensemble, series = twin(34)  # more than 4 + 8 times 3
    error = None if rate is None else ModelError(rate)
    settings = SequentialSettings(scheme, model_error=error, to_end=True)
    result = run_sequential(model, observed, ensemble, series, settings)
    posterior, last = given(model, ensemble, series, np.zeros(N) if rate is None else rate), len(TIMES)
    repeated = len(scheme.mda_weights) > 1
    for at in range(1, last + 1):
        newest = min(last, -(-at // scheme.shift) * scheme.shift)  # of its cycle
        check(result.forecast, at - 1, posterior(newest - scheme.shift if newest % scheme.shift == 0 else last - 1, at))
        check(result.analysis, at - 1, posterior(newest, at))
        ends = next((k for k in range(scheme.shift, last, scheme.shift) if at < k + scheme.shift - scheme.lag), last)
        if repeated:
            ends = min(last, at + scheme.lag)
        check(result.smoothed, at - 1, posterior(ends, at))
    assert result.members.shape[1] >= N + 1


def test_state_and_parameter_together():
    """A constant forcing in the state is estimated with it, as in the Kalman filter of both."""
    from linear_drift import Drift

    model = Drift()
    rng = np.random.default_rng(1)
    white = whiten_sample(rng.standard_normal((6, 2)))
    ensemble = np.array([1.0, 0.5]) + white @ np.diag([0.3, 0.2])
    series = CycleSeries(TIMES, rng.standard_normal((len(TIMES), 1)), np.array([STD]))
    rate = np.array([0.1, 0.02])  # the forcing is a random walk
    result = run_sequential(
        model, model.observables, ensemble, series, SequentialSettings(ETKF(), model_error=ModelError(rate))
    )
    mean, cov = np.array([1.0, 0.5]), np.diag([0.09, 0.04])
    for k, dt in enumerate(np.diff(TIMES, prepend=0.0)):
        m = np.array([[1.0, dt], [0.0, 1.0]])
        mean, cov = m @ mean, m @ cov @ m.T + np.diag(rate * dt)
        gain = cov[:, 0] / (cov[0, 0] + STD**2)
        mean, cov = mean + gain * (series.values[k, 0] - mean[0]), cov - np.outer(gain, cov[0])
        assert result.analysis.mean[k] == pytest.approx(mean, abs=1e-10)
        assert result.analysis.std[k] == pytest.approx(np.sqrt(np.diag(cov)), abs=1e-10)


def test_noise_is_exact_where_there_are_members_for_it():
    rng = np.random.default_rng(0)
    anomalies = rng.standard_normal((9, 4))
    anomalies -= anomalies.mean(axis=0)
    noise = fresh_noise(anomalies, rng.standard_normal((9, 3)))
    assert np.cov(noise.T) == pytest.approx(np.eye(3), abs=1e-12)
    assert anomalies.T @ noise == pytest.approx(np.zeros((4, 3)), abs=1e-12)
    few = fresh_noise(anomalies, rng.standard_normal((9, 5)))
    assert few.mean(axis=0) == pytest.approx(np.zeros(5), abs=1e-14)
    assert 0.3 < few.std() < 2


@pytest.mark.parametrize("members", [4, 9])
def test_narrowed_moments_are_those_of_rauch_tung_and_striebel(members):
    """Also in the space of few members, and of variables whose units differ by six orders of magnitude."""
    rng, units = np.random.default_rng(2), np.array([1.0, 1e-4, 1e2, 1.0, 1.0])
    states, change = units * rng.standard_normal((2, members, 5))
    wide = ModelError(units**2 * [1.0, 0.3, 0.0, 2.0, 1e-4]).widened(states, 0.7)
    assert narrowed(states, wide, wide) / units == pytest.approx(states / units, abs=1e-9)  # nothing was learnt
    weights = np.eye(members) + 0.3 * rng.standard_normal((members, members))
    smoothed = wide.mean(axis=0) + weights @ (wide - wide.mean(axis=0)) + 0.2 * change[0]
    found = narrowed(states, wide, smoothed) / units
    before, after, known = (np.cov((ensemble / units).T) for ensemble in (states, wide, smoothed))
    gain = before @ np.linalg.pinv(after, rcond=1e-12)
    learnt = (smoothed.mean(axis=0) - wide.mean(axis=0)) / units
    if members > 5:  # of fewer, what lies outside their space is projected on it
        assert found.mean(axis=0) == pytest.approx(states.mean(axis=0) / units + gain @ learnt, abs=1e-8)
    assert np.cov(found.T) == pytest.approx(before + gain @ (known - after) @ gain.T, abs=1e-8)


def test_an_observation_at_time_zero():
    model, observed, ensemble, series = twin(9)
    first = CycleSeries(np.array([0.0, 0.4]), series.values[4:6], series.std)
    result = run_sequential(model, observed, ensemble, first, SequentialSettings(ETKF(), model_error=ModelError(RATE)))
    check(result.forecast, 0, (ensemble[:, :N].mean(axis=0), ensemble[:, :N].std(axis=0, ddof=1)))
    assert result.analysis.std[0, 0] < 0.5 * result.forecast.std[0, 0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ModelError(np.zeros(3)), "one of them positive"),
        (lambda: ModelError(np.array([-1.0, 1.0])), "not negative"),
        (lambda: SequentialSettings(IEnKS(1), model_error=ModelError(RATE, "square-root")), "is for filters"),
        (lambda: IEnKS(2, shift=3), "only 2 long"),
        (lambda: IEnKS(3, mda_weights=(1, 1)), "mda_weights are 3"),
        (lambda: IEnKS(2, mda_weights=(1, -1)), "must be positive"),
    ],
)
def test_what_does_not_go_together(make, message):
    with pytest.raises(ValueError, match=message):
        make()
