"""Correlated errors, unknown noise scale, robust cost: against closed forms, finite differences, quadrature."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from toys import Decay, Vectorised, Wave, make_observations, make_problem, visit, with_noise

from en4dvar.data.noise import Linearisation, Predicted, noise_of
from en4dvar.data.observations import Observations
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.ensemble.linalg import centre
from en4dvar.estimation.assimilate import assimilate, forecast, log_posterior
from en4dvar.executor import SerialExecutor
from en4dvar.model.state import NOISE_SCALE
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.schemes.settings import AssimilationSettings

NAMES = ("a", "b", "c")
TRUTH = np.array([1.0, -0.5, 0.7])
K = 9


def exponential(times, length):
    return np.exp(-np.abs(np.subtract.outer(times, times)) / length)


def block(k):
    """Correlated in threes, the blocks independent."""
    return np.kron(np.eye(k // 3), np.full((3, 3), 0.6) + 0.4 * np.eye(3))


def with_errors(problem, *, correlation=None, huber=None, values=None, sigma=None):
    observations = with_noise(problem.observations, correlation=correlation, huber=huber)
    if values is not None:
        observations = replace(observations, values=values)
    prior = problem.prior
    if sigma is not None:
        prior = Prior((*prior.terms, PriorTerm.lognormal(NOISE_SCALE, 1.0, sigma)))
    return replace(problem, observations=observations, prior=prior)


def jacobian(model, times):
    return np.array([[model.curve(row, t) for row in np.eye(len(model.parameters))] for t in times])


@pytest.mark.parametrize("correlation", [exponential(np.linspace(0.2, 2.0, K), 0.4), block(K)], ids=["full", "block"])
@pytest.mark.parametrize("weight", [1.0, 1 / K])
@pytest.mark.parametrize("step_control", ["line-search", "levenberg-marquardt"])
@pytest.mark.parametrize(("linearisation", "tolerance"), [("transform", 1e-12), ("bundle", 1e-9)])
def test_one_iteration_with_correlated_errors_is_the_kalman_smoother(
    correlation, weight, step_control, linearisation, tolerance
):
    std = np.linspace(0.05, 0.2, K)
    problem = with_errors(make_problem(Vectorised(NAMES), TRUTH, std=std, weights=weight), correlation=correlation)
    settings = AssimilationSettings(
        members=20, start="prior-mean", max_iterations=1, linearisation=linearisation, step_control=step_control
    )
    analysis = assimilate(problem, settings, 5)
    h, y = jacobian(problem.model, problem.observations.times), problem.observations.values
    r = np.outer(std, std) * correlation / weight
    mean, cov = analysis.prior.mean(axis=0), np.cov(analysis.prior.T)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
    expected = mean + gain @ (y - h @ mean)
    assert np.max(np.abs(analysis.centre - expected)) <= tolerance
    assert np.max(np.abs(np.cov(analysis.posterior.T) - (np.eye(3) - gain @ h) @ cov)) <= tolerance
    assert abs(analysis.iterations[-1].dfs - np.trace(h @ gain)) <= 10 * tolerance
    residual = y - h @ expected
    assert analysis.iterations[-1].chi2_per_observation == pytest.approx(
        residual @ np.linalg.solve(weight * r, residual) / K, rel=1e-8
    )
    if weight == 1.0:
        marginal = multivariate_normal(h @ mean, h @ cov @ h.T + r)
        assert analysis.log_evidence == pytest.approx(marginal.logpdf(y), abs=1e-9)


def test_identity_correlation_is_no_correlation():
    plain = make_problem(Decay(), [1.5, 1.2], time_std=0.05)
    a, b = (
        assimilate(p, AssimilationSettings(members=12), 2) for p in (plain, with_errors(plain, correlation=np.eye(K)))
    )
    assert a.posterior == pytest.approx(b.posterior, rel=1e-9)
    assert a.log_evidence == pytest.approx(b.log_evidence, rel=1e-9)
    assert a.log_likelihood == pytest.approx(b.log_likelihood, rel=1e-7)


@pytest.mark.parametrize(("huber", "correlated"), [(None, False), (None, True), (0.5, False), (1.345, False)])
def test_log_likelihood_and_cost_differ_by_a_constant(huber, correlated):
    """What ``refine: mcmc`` samples, what the evidence integrates and what is stored are one density."""
    correlation = exponential(np.linspace(0.2, 2.0, K), 0.4) if correlated else None
    base = make_problem(Wave(), [1.0, 1.3], time_std=0.1)
    problem = with_errors(base, correlation=correlation, huber=huber, sigma=0.5)
    x = problem.prior.sample(8, 1)
    run = forecast(problem, x)
    y = problem.observations
    total = y.log_likelihood(run.predicted).sum(axis=1)
    total += problem.prior.log_density(x) - problem.prior.log_density(problem.prior.mean)
    assert total == pytest.approx(log_posterior(problem, x) - y.log_normalisation(), abs=1e-8)


@pytest.mark.parametrize("time_std", [0.0, 0.1])
@pytest.mark.parametrize("sigma", [None, 0.5])
def test_log_likelihood_sums_to_the_joint_density(time_std, sigma):
    correlation = exponential(np.linspace(0.2, 2.0, K), 0.4)
    problem = with_errors(make_problem(Wave(), [1.0, 1.3], time_std=time_std), correlation=correlation, sigma=sigma)
    x = problem.prior.sample(5, 1)
    run = forecast(problem, x)
    y = problem.observations
    terms = y.log_likelihood(run.predicted)
    for i in range(5):
        s = np.full(K, 0.1) if run.predicted.rates is None else np.hypot(0.1, run.predicted.rates[i] * time_std)
        s = s * (1.0 if sigma is None else np.exp(x[i, -1]))
        joint = multivariate_normal(run.predictions[i], np.outer(s, s) * correlation).logpdf(y.values)
        assert terms[i].sum() == pytest.approx(joint, abs=1e-9)
    costs = y.cost(run.predicted)
    assert terms.sum(axis=1) == pytest.approx(-costs - y.log_normalisation(), abs=1e-9)


CASES = {
    "correlated": {"correlation": exponential(np.linspace(0.2, 2.0, K), 0.4)},
    "correlated, scaled": {"correlation": exponential(np.linspace(0.2, 2.0, K), 0.4), "sigma": 0.5},
    "scaled": {"sigma": 0.5},
    "robust": {"huber": 1.345},
    "robust, scaled": {"huber": 1.345, "sigma": 0.5},
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("time_std", [0.0, 0.1])
@pytest.mark.parametrize("weight", [1.0, 0.3])
@pytest.mark.parametrize("members", [8, 3])  # fewer runs than members, and the bundle of all of them
def test_gradient_against_finite_differences(case, time_std, weight, members):
    problem = with_errors(make_problem(Wave(), [1.0, 1.3], time_std=time_std, weights=weight), **CASES[case])
    settings = AssimilationSettings(members=members + (members == 3), sampling="random", epsilon=1e-6)
    space = WeightSpace(problem, settings, 3, SerialExecutor())
    n = len(space.members)
    w = space.basis @ np.linspace(0.1, -0.2, space.basis.shape[1])
    at = visit(space, w)
    h = 1e-5
    moved = np.concatenate([w + h * np.eye(n), w - h * np.eye(n)])
    costs = space.try_out(moved).costs
    numeric = (costs[:n] - costs[n:]) / (2 * h)
    assert np.linalg.norm(numeric) > 1
    assert np.linalg.norm(at.step.gradient - numeric) < 1e-4 * np.linalg.norm(numeric)


@pytest.mark.slow
def test_fisher_information_with_correlation_and_scale():
    """SᵀS against the covariance of the score over data drawn from the model (Monte Carlo)."""
    c = exponential(np.array([1.0, 2.0, 3.0]), 1.5)
    observations = with_noise(make_observations([1.0, 2.0, 3.0], np.zeros(3), std=0.3, time_std=0.2), correlation=c)
    rate = np.array([1.0, 2.0, -1.5])
    at = Linearisation(
        Predicted(np.zeros(3), rate, np.exp(0.3)), np.array([[0.7, -0.4, 1.0], [0.1, 0.0, 0.0]]),
        np.array([[1.5, 0.8, -1.2], [0.0, 1.0, 0.5]]), np.array([0.2, 1.0]),
    )  # fmt: skip
    s = np.exp(0.3) * np.hypot(0.3, 0.2 * rate)
    draws = (np.linalg.cholesky(c) @ np.random.default_rng(0).standard_normal((3, 20000))).T * s
    scores = []
    for y in draws:
        d, sensitivity = replace(observations, values=y).whiten(at)
        scores.append(sensitivity.T @ d)
    assert np.mean(scores, axis=0) == pytest.approx(np.zeros(2), abs=0.05)
    assert np.cov(np.array(scores).T) == pytest.approx(sensitivity.T @ sensitivity, rel=0.05, abs=0.05)


@pytest.mark.parametrize("huber", [None, 1.345])
def test_information_of_the_noise_scale_is_that_of_the_density(huber):
    observations = with_noise(make_observations([1.0, 2.0, 3.0], np.zeros(3), std=1.0), huber=huber)
    grid = np.linspace(-40, 40, 80001)
    at = Linearisation(Predicted(np.zeros(3), None, np.array(1.0)), np.zeros((1, 3)), None, np.ones(1))
    density = np.exp(observations.log_likelihood(Predicted(np.tile(grid[:, None], 3))))[:, 0]
    width = grid[1] - grid[0]
    assert density.sum() * width == pytest.approx(1.0, abs=1e-9)
    loss = observations.cost(Predicted(np.tile(grid[:, None], 3))) / 3
    score = grid * np.gradient(loss, grid) - 1
    _, sensitivity = observations.whiten(at)
    assert np.sum(score**2 * density) * width == pytest.approx(float(np.sum(sensitivity**2) / 3), rel=1e-4)


def test_noise_scale_against_quadrature():
    """Linear model, σ unknown: a and ln σ on a grid, against the ensemble and its evidence."""
    k = 60
    problem = make_problem(Vectorised(("a",)), [1.0], std=0.1, k=k, seed=4)
    noise = problem.observations.values - [problem.model.curve(np.array([1.0]), t) for t in problem.observations.times]
    values = problem.observations.values + 0.7 * noise  # the scatter is 1.7 times what is stated
    problem = with_errors(problem, values=values, sigma=0.7)
    analysis = assimilate(problem, AssimilationSettings(members=48), 1)
    a, log_sigma = np.linspace(0.85, 1.15, 301), np.linspace(-0.2, 1.2, 401)
    residual = values - a[:, None] * jacobian(problem.model, problem.observations.times)[:, 0]
    squares = np.sum((residual / 0.1) ** 2, axis=1)[:, None]
    log_density = (
        -0.5 * squares * np.exp(-2 * log_sigma) - k * (log_sigma + np.log(0.1 * np.sqrt(2 * np.pi)))
        - 0.5 * (a[:, None] - 0.8) ** 2 - 0.5 * (log_sigma / 0.7) ** 2 - np.log(2 * np.pi * 0.7)
    )  # fmt: skip
    weights = np.exp(log_density - log_density.max())
    evidence = np.log(weights.sum() * (a[1] - a[0]) * (log_sigma[1] - log_sigma[0])) + log_density.max()
    weights /= weights.sum()
    for marginal, grid, members in (
        (weights.sum(axis=1), a, analysis.posterior[:, 0]),
        (weights.sum(axis=0), log_sigma, np.log(analysis.posterior[:, 1])),
    ):
        mean = float(marginal @ grid)
        std = float(np.sqrt(marginal @ (grid - mean) ** 2))
        assert abs(members.mean() - mean) < 0.02 * std
        assert members.std(ddof=1) == pytest.approx(std, rel=0.05)
    # the centre is the mode: for n = 1 parameter and σ it lies (n + 1)/2k below the mean of ln σ
    mode = log_sigma[np.unravel_index(np.argmax(weights), weights.shape)[1]]
    assert np.log(analysis.centre[1]) == pytest.approx(mode, abs=0.004)
    assert np.log(analysis.posterior[:, 1]).mean() - mode == pytest.approx(1 / k, abs=0.004)
    assert analysis.log_evidence == pytest.approx(evidence, abs=0.05)
    assert analysis.converged
    assert analysis.error_std == pytest.approx(np.full(k, 0.1 * analysis.centre[1]))
    assert [p.name for p in analysis.parameters] == ["a", "sigma"]


def test_fixed_noise_scale_scales_the_errors():
    plain = make_problem(Vectorised(NAMES), TRUTH, std=0.2)
    scaled = replace(make_problem(Vectorised(NAMES), TRUTH, std=0.1), fixed={"sigma": 2.0})
    scaled = replace(scaled, observations=replace(scaled.observations, values=plain.observations.values))
    a, b = (assimilate(p, AssimilationSettings(members=12), 2) for p in (plain, scaled))
    assert a.posterior == pytest.approx(b.posterior, rel=1e-9)
    assert a.log_evidence == pytest.approx(b.log_evidence, rel=1e-9)


def test_a_models_own_sigma_is_not_the_noise_scale():
    problem = make_problem(Vectorised(("sigma",)), [1.0])
    run = forecast(problem, problem.prior.sample(4, 1))
    assert run.predicted.noise_scale is None
    assert run.active.all()


def outlier(problem, k=3, by=3.0):
    values = problem.observations.values.copy()
    values[k] += by
    return values


def test_an_outlier_leaves_the_robust_posterior_where_it_was():
    plain = make_problem(Vectorised(NAMES), TRUTH, k=61)
    spoilt = outlier(plain)
    settings = AssimilationSettings(members=20, cost_tolerance=1e-7)  # of a J that the outlier makes large
    clean = assimilate(plain, settings, 1)
    std = clean.posterior.std(axis=0, ddof=1)
    gaussian = assimilate(with_errors(plain, values=spoilt), settings, 1)
    robust_clean = assimilate(with_errors(plain, huber=1.345), settings, 1)
    robust = assimilate(with_errors(plain, values=spoilt, huber=1.345), settings, 1)
    further = assimilate(with_errors(plain, values=outlier(plain, by=3e3), huber=1.345), settings, 1)
    assert np.max(np.abs(gaussian.centre - clean.centre) / std) > 8
    # the pull of an outlier is that of one at the threshold, however far it lies
    assert np.max(np.abs(robust.centre - robust_clean.centre) / std) < 1
    assert np.max(np.abs(further.centre - robust.centre) / std) < 0.05
    costs = [record.cost for record in robust.iterations]
    assert len(costs) > 2
    assert all(b <= a for a, b in pairwise(costs))
    assert not any("does not explain" in words for words in robust.warnings)
    assert any("does not explain" in words for words in gaussian.warnings)
    assert robust.down_weights is not None
    assert np.argmin(robust.down_weights) == 3
    assert robust.down_weights[3] < 0.1
    assert gaussian.down_weights is None
    (words,) = [w for w in robust.warnings if "down-weighted" in w]
    off = abs(spoilt[3] - robust.centre_predictions[3]) / robust.observations.noise.std[3]
    assert off > 20
    worst = words.partition("down-weighted: at ")[2]
    assert worst.startswith(f"{plain.observations.times[3]:.4g} s ({off:.2g} std off, weight 0.0")


def test_robust_posterior_against_quadrature():
    plain = make_problem(Vectorised(("a",)), [1.0], std=0.1, k=60, seed=2)
    problem = with_errors(plain, values=outlier(plain, 5), huber=1.345)
    analysis = assimilate(problem, AssimilationSettings(members=48), 1)
    a = np.linspace(0.7, 1.3, 6001)
    h = jacobian(problem.model, problem.observations.times)[:, 0]
    z = np.abs(problem.observations.values - a[:, None] * h) / 0.1
    loss = np.where(z <= 1.345, 0.5 * z**2, 1.345 * z - 0.5 * 1.345**2).sum(axis=1)
    density = np.exp(-loss - 0.5 * (a - 0.8) ** 2 + loss.min())
    density /= density.sum()
    mean = float(density @ a)
    std = float(np.sqrt(density @ (a - mean) ** 2))
    assert abs(analysis.posterior.mean() - mean) < 0.1 * std
    assert 0.95 < analysis.posterior.std(ddof=1) / std < 1.05


def test_what_cannot_be_combined_is_refused():
    y = make_observations([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], weights=[1.0, 1.0, 0.5])
    c = exponential(y.times, 1.0)
    for kind, message in (
        ({"correlation": c}, "one weight for all"),
        ({"correlation": c[:2, :2], "weights": np.ones(3)}, r"correlation \(2, 2\) does not match 3"),
        ({"correlation": c + np.triu(c, 1), "weights": np.ones(3)}, "symmetric"),
        ({"correlation": 2 * np.eye(3), "weights": np.ones(3)}, "unit diagonal"),
        ({"correlation": np.ones((3, 3)), "weights": np.ones(3)}, "not positive definite"),
        ({"correlation": c, "weights": np.ones(3), "huber": 1.0}, "independent"),
        ({"huber": 0.0}, "threshold"),
    ):
        weights = kind.pop("weights", y.weights)
        with pytest.raises((DataError, ValueError), match=message):
            with_noise(replace(y, weights=weights), **kind)
    settings = AssimilationSettings(scheme="es-mda", members=8)
    for options in ({"huber": 1.345}, {"sigma": 0.5}):
        with pytest.raises(ConfigError, match="es-mda"):
            assimilate(with_errors(make_problem(Vectorised(NAMES), TRUTH), **options), settings, 1)


def test_es_mda_with_correlated_errors_is_the_smoother():
    problem = with_errors(make_problem(Vectorised(NAMES), TRUTH), correlation=block(K))
    settings = AssimilationSettings(scheme="es-mda", mda_form="square-root", members=20)
    analysis = assimilate(problem, settings, 1)
    h = jacobian(problem.model, problem.observations.times)
    precision = np.eye(3) + h.T @ np.linalg.solve(0.01 * block(K), h)
    mean = np.linalg.solve(precision, 0.8 * TRUTH + h.T @ np.linalg.solve(0.01 * block(K), problem.observations.values))
    assert analysis.posterior.mean(axis=0) == pytest.approx(mean, rel=1e-9)
    assert np.cov(analysis.posterior.T) == pytest.approx(np.linalg.inv(precision), rel=1e-9, abs=1e-12)


def test_mean_and_anomalies_of_a_scaled_problem_do_not_depend_on_sigma():
    """σ is drawn from its own stream: the other parameters keep their members."""
    plain = make_problem(Vectorised(NAMES), TRUTH)
    a, b = (p.prior.sample(10, 3, "random") for p in (plain, with_errors(plain, sigma=0.5)))
    assert np.array_equal(centre(a)[1], centre(b)[1][:, :3])


@pytest.mark.parametrize("kind", [list, "i4", "i8", "f4"])
def test_numbers_of_any_kind_are_observations(kind):
    def of(numbers):
        return numbers.tolist() if kind is list else numbers.astype(kind)

    times, values, ones = np.arange(1.0, 8.0), np.arange(3.0, 10.0), np.ones(7)
    problem = make_problem(Vectorised(), np.ones(2))
    floats = replace(problem, observations=Observations(times, values, noise_of(ones), ones))
    others = replace(problem, observations=Observations(of(times), of(values), noise_of(of(ones)), of(ones)))
    one, other = (assimilate(p, AssimilationSettings(members=8), seed=1) for p in (floats, others))
    assert np.array_equal(one.posterior, other.posterior)
    assert one.cautions == other.cautions
    for wrong in (values + 1j, ["1 m"] * 7, np.ones((7, 1)), 1.0):
        with pytest.raises(DataError):
            Observations(wrong, values, noise_of(ones), ones)
