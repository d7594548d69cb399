"""Linear model, Gaussian prior: one iteration is the Kalman smoother of the ensemble's own mean and covariance."""

from dataclasses import replace

import numpy as np
import pytest
from toys import OBSERVABLE, Linear, Vectorised, make_observations, make_problem

from en4dvar.diagnosis import diagnostics as diag
from en4dvar.ensemble.linalg import Hessian, anomaly_basis, centre
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.state import READING_OFFSET, TIME_SHIFT, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.base import Evaluation, Runs, Weights, gauss_newton
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.schemes.settings import AssimilationSettings

NAMES = ("a", "b", "c")
TRUTH = np.array([1.0, -0.5, 0.7])
# Finite differences of a linear model are exact but for rounding: eps · |y| / ε, here 2e-16 · 1 / 1e-3, times the
# condition of the analysis.
TOLERANCE = {"transform": 1e-12, "bundle": 1e-9}


def jacobian(model, times):
    return np.array([[model.curve(row, t) for row in np.eye(len(model.parameters))] for t in times])


def kalman(members, h, y, r):
    """Posterior mean, covariance and DFS, written from the textbook (n×n, not in weight space)."""
    mean, cov = members.mean(axis=0), np.atleast_2d(np.cov(members.T))
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
    return mean + gain @ (y - h @ mean), (np.eye(len(mean)) - gain @ h) @ cov, np.trace(h @ gain)


def run(problem, linearisation="transform", *, seed=5, **changes):
    options = {"members": 20, "start": "prior-mean", "max_iterations": 1, "linearisation": linearisation}
    return assimilate(problem, AssimilationSettings(**{**options, **changes}), seed)


def close(actual, expected, tolerance):
    scale = max(1.0, float(np.max(np.abs(expected))))
    assert np.max(np.abs(np.asarray(actual) - expected)) <= tolerance * scale


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
@pytest.mark.parametrize("sampling", ["random", "exact"])
@pytest.mark.parametrize("start", ["prior-mean", "best-member"])
@pytest.mark.parametrize("step_control", ["full", "line-search", "levenberg-marquardt"])
@pytest.mark.parametrize("weights", [1.0, 1 / 9])
def test_one_iteration_is_the_kalman_smoother(linearisation, sampling, start, step_control, weights):
    problem = make_problem(Vectorised(NAMES), TRUTH, weights=weights)
    analysis = run(problem, linearisation, sampling=sampling, start=start, step_control=step_control)
    h = jacobian(problem.model, problem.observations.times)
    mean, cov, dfs = kalman(analysis.prior, h, problem.observations.values, 0.01 / weights * np.eye(9))
    tolerance = TOLERANCE[linearisation]
    close(analysis.centre, mean, tolerance)
    close(analysis.posterior.mean(axis=0), mean, tolerance)
    close(np.cov(analysis.posterior.T), cov, tolerance)
    close(analysis.iterations[-1].dfs, dfs, tolerance)
    close(analysis.dfs_per_parameter, 1 - np.diag(cov) / np.var(analysis.prior, axis=0, ddof=1), tolerance)
    assert analysis.converged
    assert len(analysis.iterations) == 2


def test_exact_sampling_reproduces_the_analytic_posterior():
    problem = make_problem(Vectorised(NAMES), TRUTH)
    h = jacobian(problem.model, problem.observations.times)
    precision = np.eye(3) + h.T @ h / 0.01
    mean = np.linalg.solve(precision, 0.8 * TRUTH + h.T @ problem.observations.values / 0.01)
    analysis = run(problem)
    close(analysis.posterior.mean(axis=0), mean, 1e-12)
    close(np.cov(analysis.posterior.T), np.linalg.inv(precision), 1e-12)


@pytest.mark.parametrize("n", [2, 3, 8])
def test_control_space_larger_than_smaller_than_ensemble(n):
    names = tuple("abcdefgh"[:n])
    problem = make_problem(Vectorised(names), np.linspace(1, 2, n))
    analysis = run(problem, sampling="random", members=5)
    h = jacobian(problem.model, problem.observations.times)
    mean, cov, _ = kalman(analysis.prior, h, problem.observations.values, 0.01 * np.eye(9))
    close(analysis.centre, mean, 1e-11)
    close(np.cov(analysis.posterior.T), cov, 1e-11)


def test_single_observation_is_the_etkf():
    """The ETKF of Hunt, Kostelich & Szunyogh (2007), eqs 20-24, written independently; H nonlinear, n ≥ N − 1."""
    rng = np.random.default_rng(0)
    members = rng.standard_normal((6, 8))
    predictions = np.sin(members[:, :1]) + members[:, 1:2] ** 2
    y, r = np.array([0.4]), 0.04

    x_mean, y_mean = members.mean(axis=0), predictions.mean(axis=0)
    c = (predictions - y_mean) / r
    p = np.linalg.inv(5 * np.eye(6) + c @ (predictions - y_mean).T)
    values, vectors = np.linalg.eigh(5 * p)
    w = p @ c @ (y - y_mean)
    expected = x_mean + (w[:, None] + vectors @ np.diag(np.sqrt(values)) @ vectors.T).T @ (members - x_mean)

    scheme = En4DVar("transform")
    mean, anomalies = centre(members)
    weights = Weights.prior(6)
    basis = anomaly_basis(anomalies)
    reference, spread = scheme.linearise(weights, Runs(predictions, np.zeros(1), np.ones(6, dtype=bool), basis))
    step = gauss_newton(weights.w, Evaluation((y - reference) / np.sqrt(r), spread.T / np.sqrt(r), basis))
    whole = gauss_newton(weights.w, Evaluation((y - reference) / np.sqrt(r), (basis @ spread).T / np.sqrt(r)))
    close(step.direction, whole.direction, 1e-13)
    close(step.transform, whole.transform, 1e-13)
    close(mean + (step.direction + step.transform) @ anomalies, expected, 1e-12)


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
def test_batching_is_invisible(linearisation):
    one, many = (make_problem(cls(NAMES, batch=b), TRUTH) for cls, b in ((Linear, 1), (Vectorised, 8)))
    close(run(one, linearisation).posterior, run(many, linearisation).posterior, 1e-10)


def test_member_order_permutes_the_posterior(monkeypatch):
    problem = make_problem(Vectorised(NAMES), TRUTH)
    plain = run(problem)
    order = np.random.default_rng(2).permutation(20)
    sample = Prior.sample
    monkeypatch.setattr(Prior, "sample", lambda *args: sample(*args)[order])
    shuffled = run(problem)
    close(shuffled.posterior, plain.posterior[order], 1e-12)
    close(shuffled.centre, plain.centre, 1e-12)


class _Scaled(Linear):
    """The same curve from parameters in other units."""

    def __init__(self, names, factors):
        super().__init__(names)
        self.factors = np.asarray(factors)

    def curve(self, theta, t):
        return super().curve(theta / self.factors, t)

    def rate(self, theta, t):
        return super().rate(theta / self.factors, t)


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
def test_units_of_parameters_do_not_matter(linearisation):
    factors = np.array([1e-9, 1e6, 1.0])
    plain = make_problem(Vectorised(NAMES), TRUTH)
    terms = tuple(
        PriorTerm.normal(t.parameter, t.mean * f, t.std * f) for t, f in zip(plain.prior.terms, factors, strict=True)
    )
    scaled = replace(plain, model=_Scaled(NAMES, factors), prior=Prior(terms))
    a, b = run(plain, linearisation, start="best-member"), run(scaled, linearisation, start="best-member")
    close(b.posterior / factors, a.posterior, TOLERANCE[linearisation])
    close(b.iterations[-1].dfs, a.iterations[-1].dfs, TOLERANCE[linearisation])


def test_order_of_observations_does_not_matter():
    rng = np.random.default_rng(3)
    d, s, order = rng.standard_normal(7), rng.standard_normal((7, 5)), rng.permutation(7)
    s -= s.mean(axis=1, keepdims=True)
    a = gauss_newton(np.zeros(5), Evaluation(d, s))
    b = gauss_newton(np.zeros(5), Evaluation(d[order], s[order]))
    close(a.direction, b.direction, 1e-13)
    close(a.transform, b.transform, 1e-13)


@pytest.mark.parametrize("shape", [(3, 8), (8, 8), (40, 8)])
def test_hessian_algebra(shape):
    rng = np.random.default_rng(4)
    s = rng.standard_normal(shape)
    s -= s.mean(axis=1, keepdims=True)
    hessian, g = Hessian.of(s), rng.standard_normal(8)
    a = 7 * np.eye(8) + s.T @ s
    close(hessian.solve(g), np.linalg.solve(a, g), 1e-13)
    close(hessian.solve(g, damping=2.0), np.linalg.solve(a + 14 * np.eye(8), g), 1e-13)
    t = hessian.transform
    close(t @ t, 7 * np.linalg.inv(a), 1e-13)
    close(t, t.T, 1e-14)
    close(t @ np.ones(8), np.ones(8), 1e-13)


def test_log_evidence_of_a_linear_gaussian_case():
    problem = make_problem(Vectorised(NAMES), TRUTH)
    h = jacobian(problem.model, problem.observations.times)
    covariance = h @ h.T + 0.01 * np.eye(9)  # the prior has unit covariance
    r = problem.observations.values - h @ (0.8 * TRUTH)
    expected = -0.5 * (r @ np.linalg.solve(covariance, r) + np.linalg.slogdet(2 * np.pi * covariance)[1])
    assert run(problem).log_evidence == pytest.approx(expected, abs=1e-10)
    assert run(problem, members=50, seed=8).log_evidence == pytest.approx(expected, abs=1e-10)


def test_time_shift_reads_each_member_at_its_own_time():
    """y = a + v t observed at t + t_s with a known: the shift is a linear parameter with Jacobian v."""

    class Ramp(Linear):
        def curve(self, theta, t):
            return float(theta[0] + 2.0 * t)

        def rate(self, theta, t):
            return 2.0

    times = np.linspace(1.0, 2.0, 6)
    values = 0.3 + 2.0 * (times + 0.05) + 0.01 * np.random.default_rng(1).standard_normal(6)
    prior = Prior((PriorTerm.normal(TIME_SHIFT, 0.0, 0.1),))
    problem = InverseProblem(Ramp(("a",)), OBSERVABLE, make_observations(times, values), prior, {"a": 0.3})
    analysis = run(problem)
    mean, cov, _ = kalman(analysis.prior, np.full((6, 1), 2.0), values - 0.3 - 2 * times, 0.01 * np.eye(6))
    close(analysis.centre, mean, 1e-12)
    close(analysis.posterior.var(axis=0, ddof=1), cov.ravel(), 1e-12)
    path = 0.3 + 2.0 * (analysis.trajectory_times + analysis.posterior)
    close(analysis.posterior_trajectories, path, 1e-12)
    assert analysis.fixed_parameters == (Parameter("a", "m"),)


def test_an_offset_of_the_readings_is_an_error_that_they_share():
    """Estimated beside a model, it leaves the posterior of R + c² 11ᵀ; as a fixed number it is subtracted."""
    problem, c, ones = make_problem(Vectorised(NAMES), TRUTH), 0.3, np.ones((9, 9))
    widened = replace(problem, prior=Prior((*problem.prior.terms, PriorTerm.normal(READING_OFFSET, 0.0, c))))
    analysis, h = run(widened, sampling="exact"), jacobian(problem.model, problem.observations.times)
    mean, cov, _ = kalman(analysis.prior[:, :3], h, problem.observations.values, 0.01 * np.eye(9) + c**2 * ones)
    close(analysis.centre[:3], mean, 1e-9)
    close(np.cov(analysis.posterior[:, :3].T), cov, 1e-9)
    fixed = run(replace(problem, fixed={"reading_offset": c, "reading_scale": 2.0}))
    mean, cov, _ = kalman(fixed.prior, 2 * h, problem.observations.values - c, 0.01 * np.eye(9))
    close(fixed.centre, mean, 1e-12)
    close(np.cov(fixed.posterior.T), cov, 1e-12)


def test_minimum_norm_start_has_the_background_of_the_member():
    problem = make_problem(Vectorised(NAMES), TRUTH)
    analysis = run(problem, start="best-member", max_iterations=0, sampling="random")
    record, members = analysis.iterations[0], analysis.prior
    z = record.centre - members.mean(axis=0)
    assert np.min(np.max(np.abs(members - record.centre), axis=1)) < 1e-13
    assert record.background == pytest.approx(0.5 * z @ np.linalg.solve(np.cov(members.T), z), rel=1e-11)
    assert record.cost == pytest.approx(record.background + record.observation)
    residual = problem.observations.values - jacobian(problem.model, problem.observations.times) @ record.centre
    assert record.observation == pytest.approx(0.5 * np.sum(residual**2) / 0.01)
    assert record.chi2_per_observation == pytest.approx(2 * record.observation / 9)


def test_diagnostics_by_hand():
    assert diag.dfs(np.array([3.0, 0.0]), 10) == pytest.approx(0.5)
    assert diag.nrmse(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 4.0])) == pytest.approx(1 - 1 / np.sqrt(2))
    prior = np.array([[1.0, 2.0], [3.0, -2.0]])
    assert diag.dfs_per_parameter(prior.var(axis=0), prior * [0.5, 1.0]) == pytest.approx([0.75, 0.0])
    assert diag.spread(prior * [0.5, 1.0], prior.var(axis=0)) == pytest.approx(np.sqrt(0.625))
    assert float(diag.background_cost(np.array([1.0, -1.0, 0.0]))) == pytest.approx(2.0)
    low, high = diag.chi2_interval(10.0)  # tabulated: χ²_10 at 0.0005 and 0.9995
    assert (low, high) == pytest.approx((1.265, 31.420), abs=2e-3)
