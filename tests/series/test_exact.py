"""Sequential schemes where the answer is known: Kalman filter and smoother, special cases, invariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import en4dvar
from en4dvar.data.noise import Correlation
from en4dvar.ensemble.linalg import centre
from en4dvar.executor import SerialExecutor, ThreadsExecutor
from en4dvar.model.forward import Observable
from en4dvar.schemes.base import Evaluation, Runs, Weights
from en4dvar.schemes.filters import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.series.sequential import CycleSeries, SequentialSettings, run_sequential
from en4dvar_lorenz import Linear, Lorenz63, Lorenz96
from en4dvar_lorenz.linear import LinearSettings
from en4dvar_lorenz.lorenz63 import Lorenz63Settings
from en4dvar_lorenz.lorenz96 import Lorenz96Settings

DT, CYCLES, STD = 0.3, 8, 0.4
SEEN = np.array([0, 3, 4])


def three_of_eight(trajectory):
    return trajectory.states[:, SEEN]


def linear_twin(n_members, seed=0):
    model = Linear.from_settings(LinearSettings(oscillators=4))
    rng = np.random.default_rng(seed)
    members = np.hstack([rng.standard_normal((n_members, 8)), np.full((n_members, 1), 0.1)])
    values = rng.standard_normal((CYCLES, 3))
    series = CycleSeries(DT * np.arange(1, CYCLES + 1), values, np.full(3, STD))
    return model, (Observable("seen", "1", three_of_eight),), members, series


def flow(model, t):
    """The linear map of the 8 dynamic variables over time t, from the model itself."""
    unit = np.hstack([np.eye(8), np.full((8, 1), 0.1)])
    return np.array([model.step(row, 0.0, t)[:8] for row in unit]).T


def close(actual, expected, tolerance=1e-12):
    scale = max(1.0, float(np.max(np.abs(expected))))
    assert np.max(np.abs(np.asarray(actual) - expected)) <= tolerance * scale


def batch_posterior(model, members, series, upto, at):
    """Mean and covariance at time index ``at`` given y_1…y_upto: one big regression on the state at time zero."""
    mean, cov = members[:, :8].mean(axis=0), np.cov(members[:, :8].T)
    if upto:
        h = np.vstack([flow(model, t)[SEEN] for t in series.times[:upto]])
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + STD**2 * np.eye(len(h)))
        mean = mean + gain @ (series.values[:upto].ravel() - h @ mean)
        cov = (np.eye(8) - gain @ h) @ cov
    m = flow(model, series.times[at - 1])
    return m @ mean, m @ cov @ m.T


@pytest.mark.parametrize("n_members", [5, 9, 30])
def test_etkf_is_the_kalman_filter_of_the_ensemble_moments(n_members):
    model, observed, members, series = linear_twin(n_members)
    result = run_sequential(model, observed, members, series, SequentialSettings(ETKF()))
    mean, cov = members[:, :8].mean(axis=0), np.cov(members[:, :8].T)
    m, h, r = flow(model, DT), np.eye(8)[SEEN], STD**2 * np.eye(3)
    for k in range(CYCLES):
        mean, cov = m @ mean, m @ cov @ m.T
        close(result.forecast.mean[k, :8], mean)
        close(result.forecast.std[k, :8], np.sqrt(np.diag(cov)))
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
        mean, cov = mean + gain @ (series.values[k] - h @ mean), (np.eye(8) - gain @ h) @ cov
        close(result.analysis.mean[k, :8], mean)
        close(result.analysis.std[k, :8], np.sqrt(np.diag(cov)))
    close(np.cov(result.members[:, :8].T), cov)
    close(result.members[:, 8], 0.1)


@pytest.mark.parametrize("n_members", [10, 48])
@pytest.mark.parametrize("seed", range(3))
def test_enkf_n_has_the_spread_of_the_kalman_filter_after_many_weak_readings(n_members, seed):
    """A line, read 200 times with an error of 10. The spread of N drawn members is off by 1 in √(2N − 2)."""
    times, rng = np.arange(1, 201) / 10, np.random.default_rng(seed)
    design, prior = np.column_stack([np.ones(200), times]), np.diag([9.0, 4.0])
    readings = design @ [1.0, -0.2] + 10 * rng.standard_normal(200)
    result = en4dvar.estimate_sequence(
        "trend",
        {"x": (times, readings)},
        {"level": {"prior": "normal", "mean": 0, "std": 3}, "slope": {"prior": "normal", "mean": 0, "std": 2}},
        error={"x": 10.0},
        assimilation={"scheme": "enkf-n", "members": n_members},
        seed=seed,
    )
    cov = np.linalg.inv(np.linalg.inv(prior) + design.T @ design / 100)
    std = np.sqrt(np.diag(cov))
    assert result.run.analysis.std[-1, 1:] == pytest.approx(std, rel=1 / np.sqrt(2 * n_members - 2))
    assert np.all(np.abs(result.run.analysis.mean[-1, 1:] - cov @ design.T @ readings / 100) < 0.3 * std)
    whole = multivariate_normal(np.zeros(200), design @ prior @ design.T + 100 * np.eye(200))
    assert result.log_evidence == pytest.approx(whole.logpdf(readings), abs=1)


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
@pytest.mark.parametrize("lag", [0, 1, 3, CYCLES + 2])
def test_ienks_is_the_fixed_lag_kalman_smoother(lag, linearisation):
    # finite differences of a linear model are exact but for rounding, eps/ε
    tolerance = 1e-12 if linearisation == "transform" else 1e-10
    model, observed, members, series = linear_twin(12)
    scheme = IEnKS(lag, linearisation, epsilon=1e-3)
    result = run_sequential(model, observed, members, series, SequentialSettings(scheme))
    for k in range(1, CYCLES + 1):
        mean, cov = batch_posterior(model, members, series, k, k)
        close(result.analysis.mean[k - 1, :8], mean, tolerance)
        close(result.analysis.std[k - 1, :8], np.sqrt(np.diag(cov)), tolerance)
        mean, cov = batch_posterior(model, members, series, k - 1, k)
        close(result.forecast.mean[k - 1, :8], mean, tolerance)
        close(result.forecast.std[k - 1, :8], np.sqrt(np.diag(cov)), tolerance)
        smoothed = result.smoothed.mean[k - 1, :8]
        if lag == 0 or k + lag > CYCLES:
            assert np.isnan(smoothed).all()
            continue
        mean, cov = batch_posterior(model, members, series, k + lag, k)
        close(smoothed, mean, tolerance)
        close(result.smoothed.std[k - 1, :8], np.sqrt(np.diag(cov)), tolerance)


def chaotic_twin(n_members=12, cycles=6, seed=1):
    model = Lorenz96.from_settings(Lorenz96Settings(size=20))
    rng = np.random.default_rng(seed)
    start = np.append(3 * rng.standard_normal(20), 8.0)
    times = 0.1 * np.arange(1, cycles + 1)
    truth = model.trajectories(start[None], times)[0].states[:, :20]
    members = np.tile(start, (n_members, 1))
    members[:, :20] += rng.standard_normal((n_members, 20))
    return model, members, CycleSeries(times, truth + rng.standard_normal(truth.shape), np.ones(20))


def test_ienks_without_lag_and_iterations_is_the_etkf():
    model, members, series = chaotic_twin()
    etkf, ienks = (
        run_sequential(model, model.observables, members, series, SequentialSettings(scheme))
        for scheme in (ETKF(), IEnKS(lag=0, max_iterations=1))
    )
    close(ienks.members, etkf.members)
    close(ienks.analysis.mean, etkf.analysis.mean)
    close(ienks.forecast.std, etkf.forecast.std)


def test_bundle_and_transform_meet_where_the_spread_is_small():
    model, members, series = chaotic_twin(cycles=1)
    mean, anomalies = centre(members)
    gaps = []
    for scale in (1e-2, 1e-3):
        narrow = mean + scale * anomalies
        runs = [
            run_sequential(model, model.observables, narrow, series, SequentialSettings(IEnKS(1, kind)))
            for kind in ("transform", "bundle")
        ]
        gaps.append(np.max(np.abs(runs[0].analysis.mean - runs[1].analysis.mean)))
    assert gaps[1] < 0.02 * gaps[0]  # second order in the spread


def test_order_of_members_does_not_matter():
    model, members, series = chaotic_twin()
    order = np.random.default_rng(3).permutation(len(members))
    for scheme in (ETKF(), IEnKS(2)):
        plain, shuffled = (
            run_sequential(model, model.observables, e, series, SequentialSettings(scheme))
            for e in (members, members[order])
        )
        close(shuffled.members, plain.members[order], 1e-11)  # rounding grows with the chaos of six cycles


def test_executor_and_workers_do_not_change_the_bits():
    model, members, series = chaotic_twin()
    settings = SequentialSettings(IEnKS(2), rotation=True)
    results = []
    for executor in (SerialExecutor(), ThreadsExecutor(2)):
        with executor:
            results.append(run_sequential(model, model.observables, members, series, settings, 5, executor))
    assert np.array_equal(results[0].members, results[1].members)
    assert np.array_equal(results[0].smoothed.mean, results[1].smoothed.mean, equal_nan=True)
    other = run_sequential(model, model.observables, members, series, settings, 6)
    assert not np.array_equal(other.members, results[0].members)


def test_observations_of_the_same_state_can_be_reordered_and_rescaled():
    model, members, series = chaotic_twin()
    order = np.random.default_rng(4).permutation(20)
    factor = 10.0 ** np.random.default_rng(5).integers(-6, 6, 20)
    shuffled = CycleSeries(series.times, (series.values * factor)[:, order], factor[order] * series.std)
    observed = (Observable("mixed", "1", lambda trajectory: (trajectory["x"] * factor)[:, order]),)
    plain = run_sequential(model, model.observables, members, series, SequentialSettings(IEnKS(1)))
    mixed = run_sequential(model, observed, members, shuffled, SequentialSettings(IEnKS(1)))
    close(mixed.members, plain.members, 1e-10)


def test_iterations_end_at_a_minimum_of_the_cost():
    """∇J by central differences of the model alone vanishes at the weights that the bundle variant finds."""
    model = Lorenz63.from_settings(Lorenz63Settings())
    rng = np.random.default_rng(2)
    start = np.array([1.509, -1.531, 25.46, 10, 28, 8 / 3])
    members = np.tile(start, (5, 1))
    members[:, :3] += 0.5 * rng.standard_normal((5, 3))
    value, time = np.array([3.0, 4.0, 15.0]), 0.25
    mean, anomalies = centre(members)

    def predict(rows):
        return np.array([p.states[0, :3] for p in model.trajectories(mean + rows @ anomalies, np.array([time]))])

    def cost(w):
        return 0.5 * np.sum((value - predict(w[None])[0]) ** 2) / 2 + 2.0 * w @ w

    scheme, weights = IEnKS(1, "bundle", epsilon=1e-5), Weights.prior(5)
    for _ in range(30):
        reference, spread = scheme.linearise(weights, Runs(predict(scheme.members(weights))))
        evaluation = Evaluation((value - reference) / np.sqrt(2), spread.T / np.sqrt(2))
        weights = scheme.advance(weights, evaluation, 0, None).weights
    h = 1e-5
    gradient = [(cost(weights.w + h * e) - cost(weights.w - h * e)) / (2 * h) for e in np.eye(5)]
    start_gradient = [(cost(h * e) - cost(-h * e)) / (2 * h) for e in np.eye(5)]
    assert np.linalg.norm(gradient) < 1e-5 * np.linalg.norm(start_gradient)
    assert cost(weights.w) < cost(np.zeros(5))


BLOCKS = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 1.0]])
FULL = np.array([[1.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 1.0]])


@pytest.mark.parametrize("correlation", [BLOCKS, FULL])
@pytest.mark.parametrize("scheme", [ETKF(), IEnKS(0), IEnKS(2)])
def test_correlated_errors_are_those_of_the_kalman_filter(scheme, correlation):
    model, observed, members, series = linear_twin(12)
    each = STD * np.array([1.0, 0.5, 2.0])
    series = CycleSeries(series.times, series.values, each, Correlation(correlation))
    result = run_sequential(model, observed, members, series, SequentialSettings(scheme))
    mean, cov = members[:, :8].mean(axis=0), np.cov(members[:, :8].T)
    m, h, r = flow(model, DT), np.eye(8)[SEEN], np.outer(each, each) * correlation
    for k in range(CYCLES):
        mean, cov = m @ mean, m @ cov @ m.T
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
        mean, cov = mean + gain @ (series.values[k] - h @ mean), (np.eye(8) - gain @ h) @ cov
        close(result.analysis.mean[k, :8], mean)
        close(result.analysis.std[k, :8], np.sqrt(np.diag(cov)))
    independent = run_sequential(
        model,
        observed,
        members,
        CycleSeries(series.times, series.values, each, Correlation(np.eye(3))),
        SequentialSettings(scheme),
    )
    plain = run_sequential(
        model, observed, members, CycleSeries(series.times, series.values, each), SequentialSettings(scheme)
    )
    close(independent.members, plain.members)
