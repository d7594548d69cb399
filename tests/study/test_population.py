"""The population of curved likelihoods against quadrature; its stages against what they stand for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import halfnorm, multivariate_normal, norm

from en4dvar.config import load_config
from en4dvar.ensemble.forecast import cost
from en4dvar.errors import ConfigError
from en4dvar.inputs.build import build
from en4dvar.prior import Prior, PriorTerm, member_stream
from en4dvar.state import Parameter
from en4dvar_bubble.study.emulator import design_matrix, draw_interim, fit_emulators, monomials
from en4dvar_bubble.study.gaussian import divide_out
from en4dvar_bubble.study.mixture import fit_mixtures
from en4dvar_bubble.study.population import Effort, HyperPrior, estimate_population
from en4dvar_bubble.study.set_runs import SetRuns, log_likelihood

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SMALL = Effort(rounds=80, refits=2, components=8, chains=24, block=400, blocks=4, draws=1500, inner=16, exact=400)


def prior_of(names, means, stds, transform="lognormal"):
    bounds = (0.0 if transform == "lognormal" else -np.inf, np.inf)
    parameters = [Parameter(name, unit="1", transform=transform, bounds=bounds, label="", symbol="") for name in names]
    return Prior(tuple(PriorTerm(p, transform, m, s) for p, m, s in zip(parameters, means, stds, strict=True)))


class Curved:
    """m = (a + b + 0.6 b², 0.5 a − 0.3 a b): one combination of a and b is sharp and curved, the other hardly told."""

    def __init__(self, n_sets=8, seed=0):
        rng = np.random.default_rng(seed)
        self.truth = np.stack([0.4 + 0.3 * rng.standard_normal(n_sets), 0.5 * rng.standard_normal(n_sets)], axis=1)
        self.weight = np.tile(1 / np.array([0.1, 0.5]) ** 2, (n_sets, 1))
        exact = self.predictions(self.truth[None])[0]
        self.values = exact + rng.standard_normal(exact.shape) / np.sqrt(self.weight)

    def predictions(self, x):
        a, b = x[..., 0], x[..., 1]
        return np.stack([a + b + 0.6 * b**2, 0.5 * a - 0.3 * a * b], axis=-1)


def by_quadrature(runs, prior, hyper):
    """Quantiles of exp(ν + τ²/2) of the first coordinate, and ln p(data), by sums over fine grids."""
    a, b = np.linspace(-5, 5, 1001), np.linspace(-3, 3, 601)
    x = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1)[..., None, :]
    grid = runs.predictions(np.broadcast_to(x, (len(a), len(b), len(runs.values), 2)))
    log = -0.5 * np.sum(runs.weight * (runs.values - grid) ** 2, axis=-1)  # (a, b, S)
    of_a = np.einsum("abs,b->as", np.exp(log), norm(prior.mean[1], prior.std[1]).pdf(b)) * (b[1] - b[0])
    nu, tau = np.linspace(-2.0, 2.0, 101), np.geomspace(4e-3, 2.0, 50)
    total = np.empty((len(nu), len(tau)))
    for i, v in enumerate(nu):
        for j, t in enumerate(tau):
            fine = norm(v, max(t, 0.02)).pdf(a)  # below the grid's spacing of 0.01 nothing changes any more
            total[i, j] = np.sum(np.log(fine @ of_a * (a[1] - a[0]) + 1e-300))
    log = total + norm(prior.mean[0], hyper.mean_std).logpdf(nu)[:, None] + halfnorm(scale=hyper.spread).logpdf(tau)
    width = (nu[1] - nu[0]) * np.gradient(tau)
    weights = np.exp(log - log.max()) * width
    evidence = log.max() + np.log(weights.sum())
    mean = np.exp(nu[:, None] + tau**2 / 2)
    order = np.argsort(mean.ravel())
    cdf = np.cumsum(weights.ravel()[order]) / weights.sum()
    return np.interp([0.025, 0.5, 0.975], cdf, mean.ravel()[order]), evidence


def test_a_population_of_curved_likelihoods_against_quadrature():
    runs, prior, hyper = Curved(), prior_of(("a", "b"), (0.0, 0.0), (0.8, 0.6)), HyperPrior(mean_std=0.8, spread=0.4)
    rng = np.random.default_rng(1)
    start = runs.truth[:, None] + 0.2 * rng.standard_normal((len(runs.truth), 30, 2))
    found = estimate_population(runs, start, prior, ["a"], 3, hyper, SMALL)
    quantiles, evidence = by_quadrature(runs, prior, hyper)
    assert found.converged
    for level, value in zip((0.025, 0.5, 0.975), quantiles, strict=True):
        error = np.sqrt(level * (1 - level) / found.size)
        assert np.mean(found.mean[:, 0] < value) == pytest.approx(level, abs=3 * error), level
    assert found.size > 150
    assert found.log_evidence == pytest.approx(evidence, abs=0.1)
    again = estimate_population(runs, start, prior, ["a"], 3, hyper, SMALL)
    np.testing.assert_array_equal(again.nu, found.nu)
    with pytest.raises(ValueError, match="at least 3"):
        estimate_population(runs, start[:2], prior, ["a"], 3, hyper, SMALL)


def test_monomials_are_all_of_them():
    parents = monomials(3, 4)
    assert len(parents) == 35  # (3 + 4)! / (3! 4!)
    z = np.random.default_rng(0).standard_normal((60, 3))
    assert np.linalg.matrix_rank(design_matrix(z, parents)) == 35


def test_emulators_return_polynomials_as_they_are():
    runs, rng = Curved(), np.random.default_rng(2)
    n_sets = len(runs.truth)
    x = runs.truth[:, None] + 0.4 * rng.standard_normal((n_sets, 300, 2))
    seen = runs.predictions(x.transpose(1, 0, 2)).transpose(1, 0, 2)
    emulators = fit_emulators(x, seen, runs.values, runs.weight, x, degree=2)
    other = runs.truth + 0.7 * rng.standard_normal((50, n_sets, 2))
    exact = log_likelihood(runs, runs.predictions(other))
    np.testing.assert_allclose(emulators.log_likelihood(other), exact, rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match="monomials"):
        fit_emulators(x[:, :20], seen[:, :20], runs.values, runs.weight, x, degree=4)


def test_interim_draws_have_the_moments_of_quadrature():
    runs, rng = Curved(n_sets=3), np.random.default_rng(2)
    x = runs.truth[:, None] + 0.6 * rng.standard_normal((3, 600, 2))
    seen = runs.predictions(x.transpose(1, 0, 2)).transpose(1, 0, 2)
    emulators = fit_emulators(x, seen, runs.values, runs.weight, x, degree=2)
    mean, std = np.zeros(2), np.array([0.9, 0.7])
    draws = draw_interim(emulators, mean, std, seed=4, count=400)
    a, b = np.meshgrid(np.linspace(-4, 4, 801), np.linspace(-3, 3, 601), indexing="ij")
    at = np.stack([a, b], axis=-1)
    for s in range(3):
        predictions = runs.predictions(at)
        log = -0.5 * np.sum(runs.weight[s] * (runs.values[s] - predictions) ** 2, axis=-1)
        density = np.exp(log - 0.5 * (a / std[0]) ** 2 - 0.5 * (b / std[1]) ** 2)
        density /= density.sum()
        for values, j in ((a, 0), (b, 1)):
            middle = np.sum(density * values)
            spread = np.sqrt(np.sum(density * (values - middle) ** 2))
            assert draws[s, :, j].mean() == pytest.approx(middle, abs=0.1 * spread)
            assert draws[s, :, j].std() == pytest.approx(spread, rel=0.1)


def test_a_gaussian_likelihood_has_the_marginal_of_a_gaussian():
    """Linear likelihoods: mixture draws of one component each against the normal density of the data."""
    rng = np.random.default_rng(5)
    H, y, std = rng.standard_normal((4, 5, 2)), rng.standard_normal((4, 5)), 0.7
    mean, wide = np.array([0.2, -0.1]), np.array([1.0, 1.3])
    cov = np.linalg.inv(np.diag(wide**-2.0) + np.einsum("ski,skj->sij", H, H) / std**2)
    middle = np.einsum("sij,sj->si", cov, mean / wide**2 + np.einsum("ski,sk->si", H, y) / std**2)
    draws = np.stack([rng.multivariate_normal(m, c, 20_000) for m, c in zip(middle, cov, strict=True)])
    mixtures = fit_mixtures(draws, mean, wide, rng, components=1)
    nu, variance = np.array([[0.0, 0.0], [0.5, -0.4]]), np.array([[0.3, 0.2], [0.05, 0.4]])
    exact = [
        sum(
            multivariate_normal(H[s] @ v, H[s] @ np.diag(d) @ H[s].T + std**2 * np.eye(5)).logpdf(y[s])
            for s in range(4)
        )
        for v, d in zip(nu, variance, strict=True)
    ]
    told = mixtures.log_marginal(nu, variance)
    assert told[1] - told[0] == pytest.approx(exact[1] - exact[0], abs=0.1)
    x = mixtures.draw(rng, nu[1:], variance[1:], 20_000)[0, :, 0]
    precision = np.diag(1 / variance[1]) + H[0].T @ H[0] / std**2
    expected = np.linalg.solve(precision, nu[1] / variance[1] + H[0].T @ y[0] / std**2)
    np.testing.assert_allclose(x.mean(axis=0), expected, atol=0.02)
    np.testing.assert_allclose(np.cov(x.T), np.linalg.inv(precision), atol=0.01)


def test_prior_divided_out_is_the_likelihood():
    rng = np.random.default_rng(0)
    H, y = rng.standard_normal((4, 3)), rng.standard_normal(4)
    mean, std = np.array([1.0, -2.0, 0.3]), np.array([0.5, 1.5, 0.7])
    cov = np.linalg.inv(np.diag(std**-2.0) + H.T @ H / 0.09)
    middle = cov @ (mean / std**2 + H.T @ y / 0.09)
    evidence = multivariate_normal(H @ mean, H @ np.diag(std**2) @ H.T + 0.09 * np.eye(4)).logpdf(y)
    found = divide_out(("a", "b", "c"), middle[None], cov[None], np.array([evidence]), mean, std)
    x = mean + 0.4
    told = found.constant[0] + found.linear[0] @ x - 0.5 * x @ found.precision[0] @ x
    assert told == pytest.approx(multivariate_normal(H @ x, 0.09 * np.eye(4)).logpdf(y), abs=1e-9)


def test_runs_of_all_sets_are_those_of_each():
    problems = build(load_config(CONFIGS / "agarose_03_qlkv.yaml"))[:3]
    prior = problems[0].prior
    x = prior.mean + 0.3 * prior.std * member_stream(1, "x").standard_normal((4, 3, len(prior.names)))
    runs = SetRuns(problems, workers=2)
    told = log_likelihood(runs, runs.predictions(x))
    for s, problem in enumerate(problems):
        z = (x[:, s] - prior.mean) / prior.std
        np.testing.assert_allclose(-told[:, s], cost(problem, x[:, s]) - 0.5 * np.sum(z**2, axis=1), rtol=1e-6)


def test_errors_that_a_population_cannot_take():
    config = load_config(CONFIGS / "agarose_03_qlkv.yaml", {"data.error.time_std": "0.2 us"})
    with pytest.raises(ConfigError, match="independent Gaussian errors"):
        SetRuns(build(config))
