"""The analyses of DEnKF, EnKF, ESRF and EnKF-N against closed forms and a direct minimisation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from toys import Linear, make_problem

from en4dvar.ensemble.linalg import centre
from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes.base import Evaluation, Weights
from en4dvar.schemes.enkf_n import EnKFN
from en4dvar.schemes.filters import ESRF, ETKF, DEnKF, EnKF
from en4dvar.schemes.settings import AssimilationSettings


def evaluation(n_members=8, k=5, scale=1.0, seed=0):
    rng = np.random.default_rng(seed)
    return Evaluation(2 * rng.standard_normal(k), scale * centre(rng.standard_normal((n_members, k)))[1].T)


def analysed(scheme, e):
    return scheme.advance(Weights.prior(e.S.shape[1]), e, 0, None).weights


def test_denkf_moves_anomalies_by_half_the_gain():
    """X_a = X_f − ½ K H X_f and x_a = x_f + K d for a state of two variables, one of them observed."""
    rng = np.random.default_rng(3)
    mean, x = centre(rng.standard_normal((7, 2)))
    r, y = 0.5, 1.3
    p = x.T @ x / 6
    gain = p[:, :1] / (p[0, 0] + r)
    e = Evaluation(np.array([y - mean[0]]) / np.sqrt(r), x[:, :1].T / np.sqrt(r))
    weights = analysed(DEnKF(), e)
    assert mean + weights.w @ x == pytest.approx(mean + gain[:, 0] * (y - mean[0]), abs=1e-13)
    assert weights.T @ x == pytest.approx(x - 0.5 * x[:, :1] @ gain.T, abs=1e-13)


def test_denkf_is_the_etkf_to_first_order():
    gaps = []
    for scale in (0.1, 0.05):
        e = evaluation(scale=scale)
        gaps.append(np.abs(analysed(DEnKF(), e).T - analysed(ETKF(), e).T).max())
    assert gaps[0] / gaps[1] == pytest.approx(16, rel=0.1)  # the next order is that of (SᵀS)²


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("k", "scale"), [(3, 2.0), (20, 1.0), (3, 0.3)])
def test_enkf_n_minimises_its_cost(seed, k, scale):
    """Its logarithm has the factor N + 1, and less where less is learned than ε_N degrees of freedom."""
    e, n = evaluation(k=k, scale=scale, seed=seed), 8
    learned = np.trace(e.S @ np.linalg.inv((n - 1) * np.eye(n) + e.S.T @ e.S) @ e.S.T)
    assert (learned < 1 + 1 / n) == (scale < 1)
    factor = n - 1 / n + min(1 + 1 / n, learned)

    def cost(w):
        return 0.5 * np.sum((e.d - e.S @ w) ** 2) + 0.5 * factor * np.log(1 + 1 / n + w @ w)

    found = analysed(EnKFN(), e)
    direct = minimize(cost, found.w + 0.1, method="BFGS", options={"gtol": 1e-9})
    assert cost(found.w) <= direct.fun + 1e-8
    h = 1e-5
    gradient = [(cost(found.w + h * u) - cost(found.w - h * u)) / (2 * h) for u in np.eye(n)]
    assert np.abs(gradient).max() < 1e-5
    # the transform is a root of the inverse Hessian of that cost
    hessian = np.array([
        [(cost(found.w + 1e-3 * (a + b)) - cost(found.w + 1e-3 * (a - b)) - cost(found.w + 1e-3 * (b - a))
          + cost(found.w - 1e-3 * (a + b))) / 4e-6 for a in np.eye(n)] for b in np.eye(n)
    ])  # fmt: skip
    assert found.T @ hessian @ found.T.T == pytest.approx((n - 1) * np.eye(n), abs=2e-3)
    assert np.abs(found.T.sum(axis=0) - found.T.sum() / n).max() < 1e-12


def test_enkf_n_of_an_ensemble_that_is_lost_stays_finite():
    """Predictions of 1e10 standard deviations: to rounding the Hessian is not positive, which was a domain error."""
    rng = np.random.default_rng(0)
    s = 1e10 * rng.standard_normal((8, 6)) * np.logspace(0, -16, 8)[:, None]
    step = analysed(EnKFN(), Evaluation(1e10 * rng.standard_normal(8), s - s.mean(axis=1, keepdims=True)))
    assert np.isfinite(step.w).all()


def test_without_information_enkf_n_keeps_mean_and_spread():
    weights = analysed(EnKFN(), Evaluation(np.ones(3), np.zeros((3, 6))))
    assert weights.w == pytest.approx(np.zeros(6), abs=1e-12)
    assert np.abs(weights.T - np.eye(6)).max() < 1e-12


@pytest.mark.parametrize("scheme", ["etkf", "denkf", "enkf", "esrf", "enkf-n"])
def test_filters_estimate_parameters_too(scheme):
    """One analysis of a linear model has the mean of the Kalman update, and two ensembles are run with their mean.

    Two members are run again, to compare.
    """
    truth = np.array([1.0, -0.5, 0.7])
    problem = make_problem(Linear(("a", "b", "c")), truth)
    analysis = assimilate(problem, AssimilationSettings(scheme=scheme, members=20), 3)
    h = np.array([[problem.model.curve(row, t) for row in np.eye(3)] for t in problem.observations.times])
    mean, cov = analysis.prior.mean(axis=0), np.cov(analysis.prior.T)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + np.diag(problem.observations.std**2))
    exact = mean + gain @ (problem.observations.values - h @ mean)
    tolerance = 1e-10 if scheme != "enkf-n" else 0.05  # which allows for the sampling error of the prior
    assert np.abs(analysis.posterior.mean(axis=0) - exact).max() < tolerance
    assert analysis.forward_runs == 2 * 21 + 2


@pytest.mark.parametrize("k", [3, 20])
def test_serial_updates_have_the_moments_of_the_batch_analysis(k):
    """Mean and covariance of ESRF and ETKF agree, and those are the Kalman filter's of the ensemble's moments."""
    e = evaluation(k=k, seed=2)
    serial, batch = analysed(ESRF(), e), analysed(ETKF(), e)
    assert serial.w == pytest.approx(batch.w, abs=1e-13)
    assert np.abs(serial.T.T @ serial.T - batch.T.T @ batch.T).max() < 1e-13
    assert np.abs(serial.T - batch.T).max() > 1e-3  # another root of it
    x = centre(np.random.default_rng(1).standard_normal((8, 4)))[1]
    assert (serial.T @ x).sum(axis=0) == pytest.approx(np.zeros(4), abs=1e-12)


def test_perturbed_observations_move_every_member_by_the_gain():
    """x_i + K (y + e_i − H x_i), with the sample covariance of the ensemble; the mean as without perturbations."""
    rng = np.random.default_rng(3)
    members, std, y = rng.standard_normal((7, 4)), np.array([0.5, 0.8]), np.array([1.3, -0.4])
    noise = rng.standard_normal((7, 2))
    mean, x = centre(members)
    p = np.cov(members.T)
    gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + np.diag(std**2))
    e = Evaluation((y - mean[:2]) / std, (x[:, :2] / std).T)
    found = EnKF().advance(Weights.prior(7), e, 0, lambda purpose: noise).weights
    errors = (noise - noise.mean(axis=0)) * std
    assert mean + found.rows @ x == pytest.approx(members + (y + errors - members[:, :2]) @ gain.T, abs=1e-12)
    assert found.w == pytest.approx(analysed(ETKF(), e).w, abs=1e-12)


@pytest.mark.parametrize("n_members", [4, 8])
@pytest.mark.parametrize("k", [1, 12])
def test_perturbed_observations_have_the_covariance_of_the_square_root_on_average(n_members, k):
    """Over 4000 analyses of one forecast, within 4 standard errors, of fewer and more observations than members."""
    e, rng, squares = evaluation(n_members, k, seed=2), np.random.default_rng(5), []
    for _ in range(4000):
        noise = rng.standard_normal((n_members, k))
        transform = EnKF().advance(Weights.prior(n_members), e, 0, lambda purpose, noise=noise: noise).weights.dense
        squares.append(transform.T @ transform)
    exact, error = analysed(ETKF(), e).T, np.std(squares, axis=0) / np.sqrt(len(squares))
    assert np.all(np.abs(np.mean(squares, axis=0) - exact.T @ exact) < 4 * error + 1e-12)
