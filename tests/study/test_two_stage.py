"""Likelihood factors, pooled evidence and the population, against closed forms on linear Gaussian problems."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import halfnorm, multivariate_normal, norm

from en4dvar.prior import Prior, PriorTerm
from en4dvar.state import Parameter
from en4dvar_bubble.study.gaussian import divide_out, log_pooled_evidence
from en4dvar_bubble.study.population import HyperPrior, _Posterior, estimate_population, population_log_evidence

NAMES = ("a", "b", "c")
MEAN, STD = np.array([1.0, -2.0, 0.3]), np.array([0.5, 1.5, 0.7])


def normal_prior(names, means, stds):
    bounds = (-np.inf, np.inf)
    parameters = [Parameter(name, unit="1", transform="normal", bounds=bounds, label="", symbol="") for name in names]
    return Prior(tuple(PriorTerm.normal(p, m, s) for p, m, s in zip(parameters, means, stds, strict=True)))


def linear_problem(n_sets=6, k=4, seed=0, spread=0.0):
    """y_i = H_i x_i + noise with x_i = x + spread·N(0, 1): operators, data, and exact posterior of each set."""
    rng = np.random.default_rng(seed)
    H = rng.standard_normal((n_sets, k, 3))
    x = MEAN + STD * rng.standard_normal(3)
    each = x + spread * rng.standard_normal((n_sets, 3))
    y = np.einsum("ski,si->sk", H, each) + 0.3 * rng.standard_normal((n_sets, k))
    prior = np.diag(STD**-2.0)
    cov = np.linalg.inv(prior + np.einsum("ski,skj->sij", H, H) / 0.09)
    mean = np.einsum("sij,sj->si", cov, prior @ MEAN + np.einsum("ski,sk->si", H, y) / 0.09)
    evidence = np.array(
        [
            multivariate_normal(h @ MEAN, h @ np.diag(STD**2) @ h.T + 0.09 * np.eye(k)).logpdf(v)
            for h, v in zip(H, y, strict=True)
        ]
    )
    return H, y, divide_out(NAMES, mean, cov, evidence, MEAN, STD)


def test_factors_are_the_likelihood():
    H, y, factors = linear_problem()
    x = MEAN + 0.4
    for i in range(len(H)):
        exact = multivariate_normal(H[i] @ x, 0.09 * np.eye(4)).logpdf(y[i])
        told = factors.constant[i] + factors.linear[i] @ x - 0.5 * x @ factors.precision[i] @ x
        assert told == pytest.approx(exact, abs=1e-9)


def test_pooled_evidence_is_the_evidence_of_all_data_at_once():
    H, y, factors = linear_problem()
    all_H, all_y = H.reshape(-1, 3), y.ravel()
    covariance = all_H @ np.diag(STD**2) @ all_H.T + 0.09 * np.eye(len(all_y))
    exact = multivariate_normal(all_H @ MEAN, covariance).logpdf(all_y)
    assert log_pooled_evidence(factors) == pytest.approx(exact, abs=1e-8)


def test_marginal_density_of_the_spread_against_the_joint_gaussian():
    """p(y | τ), ν integrated out, is a Gaussian of all data; c is no property of the population."""
    H, y, factors = linear_problem(spread=0.4)
    hyper = HyperPrior(mean_std=0.8, spread=0.5)
    posterior = _Posterior(factors, [0, 1], hyper)
    n_sets, k = y.shape

    def exact(tau):
        within = np.diag([tau[0] ** 2, tau[1] ** 2, STD[2] ** 2])
        between = np.diag([0.64, 0.64, 0.0])
        blocks = [[H[i] @ (between + (i == j) * within) @ H[j].T for j in range(n_sets)] for i in range(n_sets)]
        covariance = np.block(blocks) + 0.09 * np.eye(n_sets * k)
        log_prior = sum(np.log(t) - 0.5 * (t / 0.5) ** 2 for t in tau)
        return multivariate_normal((H @ MEAN).ravel(), covariance).logpdf(y.ravel()) + log_prior

    taus = np.array([[0.1, 0.1], [0.5, 0.2], [0.03, 0.9]])
    told = posterior(np.log(taus))[0]
    reference = np.array([exact(t) for t in taus])
    np.testing.assert_allclose(told - told[0], reference - reference[0], atol=1e-7)


def test_population_evidence_against_quadrature():
    """One coordinate: p(y | ν, τ) is a product of normals, integrated by quadrature over ν and τ."""
    rng = np.random.default_rng(4)
    n, s, noise = 12, 0.8, 0.5
    y = 0.4 + 0.3 * rng.standard_normal(n) + noise * rng.standard_normal(n)
    variance = 1 / (1 / s**2 + 1 / noise**2)
    evidence = norm(0.0, np.hypot(s, noise)).logpdf(y)
    found = divide_out(
        ("a",), (variance * y / noise**2)[:, None], np.full((n, 1, 1), variance), evidence, np.zeros(1), np.array([s])
    )
    hyper = HyperPrior(mean_std=0.7, spread=0.4)
    told = population_log_evidence(found, normal_prior(("a",), [0.0], [s]), ["a"], 1, hyper)
    nu, tau = np.linspace(-3, 3, 1201)[:, None], np.linspace(1e-4, 3, 1500)[None, :]
    density = (
        sum(norm(nu, np.hypot(tau, noise)).logpdf(v) for v in y)
        + norm(0, 0.7).logpdf(nu)
        + halfnorm(scale=0.4).logpdf(tau)
    )
    exact = np.log(np.exp(density).sum() * (nu[1, 0] - nu[0, 0]) * (tau[0, 1] - tau[0, 0]))
    assert told == pytest.approx(exact, abs=0.02)


def test_population_is_recovered_and_the_prior_is_not():
    """300 sets, each hardly informative, drawn away from the prior: the population's mean and spread come back."""
    rng = np.random.default_rng(3)
    parameter = Parameter("a", unit="1", transform="lognormal", bounds=(0.0, np.inf), label="a", symbol="a")
    prior = Prior((PriorTerm.lognormal(parameter, 1.0, 0.4),))
    truth = 0.5 + 0.3 * rng.standard_normal(300)
    y = truth + 0.5 * rng.standard_normal(300)
    variance = 1 / (1 / 0.16 + 1 / 0.25)
    mean = (variance * y / 0.25)[:, None]
    factors = divide_out(("a",), mean, np.full((300, 1, 1), variance), np.zeros(300), np.zeros(1), np.array([0.4]))
    result = estimate_population(factors, prior, ["a"], seed=1)
    assert abs(result.nu.mean() - 0.5) < 0.1
    assert result.nu.std() == pytest.approx(np.sqrt(0.34 / 300), rel=0.2)
    assert abs(result.tau.mean() - 0.3) < 0.08
    low, high = result.interval()[:, 0]
    assert low < np.exp(0.5 + 0.045) < high
    assert mean.mean() < 0.25  # what stacking gives


def test_same_seed_same_population():
    _, _, factors = linear_problem()
    terms = [
        Parameter(name, unit="1", transform="normal", bounds=(-np.inf, np.inf), label="", symbol="") for name in NAMES
    ]
    prior = Prior(tuple(PriorTerm.normal(p, m, s) for p, m, s in zip(terms, MEAN, STD, strict=True)))
    short = HyperPrior(chains=8, steps=60, burn_in=20)
    a, b = (estimate_population(factors, prior, NAMES, 5, short) for _ in range(2))
    np.testing.assert_array_equal(a.nu, b.nu)
    few = divide_out(NAMES, np.zeros((2, 3)), np.tile(np.eye(3) * 0.01, (2, 1, 1)), np.zeros(2), MEAN, STD)
    with pytest.raises(ValueError, match="at least 3"):
        estimate_population(few, prior, NAMES, 5, short)
