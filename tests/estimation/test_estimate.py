"""The population of curved likelihoods against quadrature; its stages against what they stand for."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import halfnorm, multivariate_normal, norm

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.ensemble.forecast import cost
from en4dvar.estimation.population import Effort, HyperPrior, estimate_population
from en4dvar.estimation.population.estimate import _Estimate
from en4dvar.estimation.population.likelihoods import draw_interim, fit_likelihood
from en4dvar.estimation.population.marginals import DEFENSIVE, SetPosterior, marginals
from en4dvar.estimation.population.mixtures import Mixture, fit_mixtures, log_marginal
from en4dvar.estimation.population.training import Training
from en4dvar.estimation.population.weights import Weighed
from en4dvar.executor import ThreadsExecutor
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm, member_stream
from en4dvar.sampling.forward_runs import ForwardRuns, log_likelihood

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SMALL = Effort(rounds=80, refits=2, components=8, hyper_walkers=32, draws=1500, exact=600)


def prior_of(names, means, stds, transform="lognormal"):
    bounds = (0.0 if transform == "lognormal" else -np.inf, np.inf)
    parameters = [Parameter(name, unit="1", transform=transform, bounds=bounds, label="", symbol="") for name in names]
    return Prior(tuple(PriorTerm(p, transform, m, s) for p, m, s in zip(parameters, means, stds, strict=True)))


class Curved:
    """m = (a + b + 0.6 b², 0.5 a − 0.3 a b): one combination of a and b is sharp and curved, the other hardly told.

    ``outlier``: how much further than the others the first bubble's a lies.
    """

    def __init__(self, n_sets=8, seed=0, outlier=0.0, middle=0.4):
        rng = np.random.default_rng(seed)
        self.truth = np.stack([middle + 0.3 * rng.standard_normal(n_sets), 0.5 * rng.standard_normal(n_sets)], axis=1)
        self.truth[0, 0] += outlier
        self.weight = np.tile(1 / np.array([0.1, 0.5]) ** 2, (n_sets, 1))
        exact = self.predictions(self.truth[None])[0]
        self.values = exact + rng.standard_normal(exact.shape) / np.sqrt(self.weight)

    def predictions(self, x, sets=None):
        a, b = x[..., 0], x[..., 1]
        return np.stack([a + b + 0.6 * b**2, 0.5 * a - 0.3 * a * b], axis=-1)

    def start(self, seed):
        noise = np.random.default_rng(seed).standard_normal((len(self.truth), 30, 2))
        return self.truth[:, None] + 0.2 * noise


class Cusped(Curved):
    """The second prediction has a cusp that no polynomial follows, as the radius at the end of a collapse."""

    def predictions(self, x, sets=None):
        a, b = x[..., 0], x[..., 1]
        return np.stack([a + b + 0.6 * b**2, 1.5 * np.sqrt(np.abs(a - 0.4 * b - 0.5))], axis=-1)


class Twofold(Curved):
    """Each set leaves two a open, on both sides of 0.2; ``start`` is at the one that the data put less in."""

    def predictions(self, x, sets=None):
        a, b = x[..., 0], x[..., 1]
        return np.stack([(a - 0.2) ** 2 + 0.1 * b, 0.5 * a - 0.3 * b], axis=-1)

    def start(self, seed):
        noise = np.random.default_rng(seed).standard_normal((len(self.truth), 30, 2))
        return self.truth[:, None] * [-1, 1] + [0.4, 0.0] + 0.02 * noise


@functools.cache
def by_quadrature(runs, prior, hyper):
    """Quantiles of exp(ν + τ²/2) of the first coordinate, and ln p(data), by sums over fine grids."""
    a, b = np.linspace(-5, 5, 1001), np.linspace(-3, 3, 601)
    x = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1)[..., None, :]
    grid = runs.predictions(np.broadcast_to(x, (len(a), len(b), len(runs.values), 2)))
    log = -0.5 * np.sum(runs.weight * (runs.values - grid) ** 2, axis=-1)  # (a, b, S)
    of_a = np.einsum("abs,b->as", np.exp(log), norm(prior.mean[1], prior.std[1]).pdf(b)) * (b[1] - b[0])
    nu, tau = np.linspace(-2.0, 2.0, 101), np.geomspace(4e-3, 2.0, 50)
    total = np.empty((len(nu), len(tau)))
    for j, t in enumerate(np.maximum(tau, 0.02)):  # below the grid's spacing of 0.01 nothing changes any more
        fine = norm.pdf(a, nu[:, None], t)
        total[:, j] = np.sum(np.log(fine @ of_a * (a[1] - a[0]) + 1e-300), axis=1)
    log = total + norm(prior.mean[0], hyper.mean_std).logpdf(nu)[:, None] + halfnorm(scale=hyper.spread).logpdf(tau)
    width = (nu[1] - nu[0]) * np.gradient(tau)
    weights = np.exp(log - log.max()) * width
    evidence = log.max() + np.log(weights.sum())
    mean = np.exp(nu[:, None] + tau**2 / 2)
    order = np.argsort(mean.ravel())
    cdf = np.cumsum(weights.ravel()[order]) / weights.sum()
    return np.interp([0.025, 0.5, 0.975], cdf, mean.ravel()[order]), evidence


CURVED, OUTLIER, CUSPED = Curved(), Curved(outlier=2.0), Cusped()
LEVELS = (0.025, 0.5, 0.975)
CURVED_PRIOR, CURVED_HYPER = prior_of(("a", "b"), (0.0, 0.0), (0.8, 0.6)), HyperPrior(mean_std=0.8, spread=0.4)


@functools.cache
def estimated(runs, seed):
    return estimate_population(runs, runs.start(seed), CURVED_PRIOR, ["a"], seed, CURVED_HYPER, SMALL)


@pytest.mark.parametrize(
    "runs",
    [
        pytest.param(CURVED, id="curved", marks=pytest.mark.slow),
        pytest.param(OUTLIER, id="outlier", marks=pytest.mark.slow),
        pytest.param(CUSPED, id="cusped", marks=pytest.mark.slow),
        pytest.param(Twofold(middle=1.2), id="twofold", marks=pytest.mark.slow),
    ],
)
def test_a_population_of_curved_likelihoods_against_quadrature(runs):
    found = estimated(runs, 3)
    quantiles, evidence = by_quadrature(runs, CURVED_PRIOR, CURVED_HYPER)
    assert found.converged
    assert found.size > 200
    for level, value in zip(LEVELS, quantiles, strict=True):
        error = np.sqrt(level * (1 - level) / found.size)
        assert np.mean(found.mean[:, 0] < value) == pytest.approx(level, abs=3 * error), level
    assert found.log_evidence == pytest.approx(evidence, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "runs",
    [
        pytest.param(CURVED, id="curved"),
        pytest.param(OUTLIER, id="outlier", marks=pytest.mark.long),
        pytest.param(CUSPED, id="cusped", marks=pytest.mark.long),
    ],
)
def test_repeated_estimates_are_as_good_as_they_say(runs):
    """No bias, and no more scatter than the effective number of draws: a degenerate weight would show in either."""
    quantiles, evidence = by_quadrature(runs, CURVED_PRIOR, CURVED_HYPER)
    several = [estimated(runs, seed) for seed in range(8)]
    size = np.mean([found.size for found in several])
    below = np.array([[np.mean(found.mean[:, 0] < value) for value in quantiles] for found in several])
    for j, level in enumerate(LEVELS):
        error = np.sqrt(level * (1 - level) / size)
        assert below[:, j].mean() == pytest.approx(level, abs=3 * error / np.sqrt(len(several))), level
        assert below[:, j].std() < 1.5 * error
    assert np.mean([found.log_evidence for found in several]) == pytest.approx(evidence, abs=0.05)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_with_any_number_of_threads():
    runs = CURVED
    found = estimated(runs, 3)
    again = estimate_population(runs, runs.start(3), CURVED_PRIOR, ["a"], 3, CURVED_HYPER, SMALL, workers=3)
    np.testing.assert_array_equal(again.nu, found.nu)
    assert again.log_evidence == found.log_evidence
    with pytest.raises(ValueError, match="at least 3"):
        estimate_population(runs, runs.start(3)[:2], CURVED_PRIOR, ["a"], 3, CURVED_HYPER, SMALL)


def test_ensembles_in_a_minimum_that_is_not_the_lowest_are_left():
    """a³ − 3a = 4 has the root 2.196; walkers close about the local maximum at −1, where it is 2, stay there."""

    class Folded:
        values, weight = np.array([[4.0, 0.0]] * 3), np.array([[100.0, 1.0]] * 3)

        def predictions(self, x, sets=None):
            return np.stack([x[..., 0] ** 3 - 3 * x[..., 0], x[..., 1]], axis=-1)

    runs, rng = Folded(), np.random.default_rng(2)
    start = np.array([-1.0, 0.0]) + 0.01 * rng.standard_normal((3, 30, 2))
    start[2, :, 0] += 3.196  # the third is where it should be, and stays
    training = Training(runs, start, np.zeros(2), np.array([1.2, 1.0]), 1, replace(SMALL, refits=0))
    root = np.array([2.196, 0.0])
    for s in range(3):
        assert np.median(np.abs(training.at[s] - root)[:, 0]) < 0.2
    assert training.count < 3 * 81 * 16 + 3 * 8 * 400


def test_walkers_start_as_draws_of_the_posterior():
    """The data determine a + b to 0.02, and neither a nor b by itself."""

    class Sheet:
        values, weight = np.full((3, 1), 1.0), np.full((3, 1), 0.02**-2)

        def predictions(self, x, sets=None):
            return x.sum(axis=-1, keepdims=True)

    start = np.array([0.5, 0.5]) + 0.01 * np.random.default_rng(3).standard_normal((3, 30, 2))
    training = Training(Sheet(), start, np.zeros(2), np.ones(2), 1, replace(SMALL, rounds=1, refits=0))
    assert np.median(np.abs(training.outputs - 1.0)) < 0.1
    assert training.at[..., 0].std() > 0.3  # all along the sheet


def test_where_hardly_a_draw_is_left_no_proposal_is_fitted_to_it(monkeypatch):
    h = np.random.default_rng(0).standard_normal((3000, 2))
    logs = np.where(np.arange(3000) == 7, 0.0, -np.inf)
    monkeypatch.setattr(
        "en4dvar.estimation.population.estimate.with_emulators", lambda *rest: Weighed(h, logs, h[:, None, None])
    )
    one = object.__new__(_Estimate)
    one.effort, one.seed, one.tries, one.hyper, one.workers = SMALL, 1, 0, None, 1
    assert one._weighed([], h).effective == 1.0


def fitted(x, predictions, values, weight, degree, must=0):
    """One emulated likelihood a set, every run counting by its likelihood alone."""
    log_prior = np.zeros(x.shape[1])
    parts = zip(x, predictions, values, weight, strict=True)
    return [fit_likelihood(at, m, log_prior, y, w, at, degree, must) for at, m, y, w in parts]


def test_emulators_return_polynomials_as_they_are():
    runs, rng = Curved(), np.random.default_rng(2)
    n_sets = len(runs.truth)
    x = runs.truth[:, None] + 0.4 * rng.standard_normal((n_sets, 300, 2))
    seen = runs.predictions(x.transpose(1, 0, 2)).transpose(1, 0, 2)
    other = runs.truth + 0.7 * rng.standard_normal((50, n_sets, 2))
    exact = log_likelihood(runs, runs.predictions(other))
    for s, likelihood in enumerate(fitted(x, seen, runs.values, runs.weight, degree=2)):
        np.testing.assert_allclose(likelihood.log(other[:, s]), exact[:, s], rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match="monomials"):
        fit_likelihood(x[0, :5], seen[0, :5], np.zeros(5), runs.values[0], runs.weight[0], x[0], degree=4)


def test_what_an_emulator_misses_widens_its_likelihood():
    """Degree 1 on a parabola at evenly spread points: the error of the reading is known, and adds to its variance."""
    line = np.linspace(-1, 1, 101)
    x = np.stack(np.meshgrid(line, line), axis=-1).reshape(1, -1, 2)
    seen = np.stack([0.3 * x[..., 0], x[..., 0] ** 2], axis=2)
    # log-likelihoods all but equal, so that every point counts the same
    (likelihood,) = fitted(x, seen, np.zeros((1, 2)), np.full((1, 2), 1e-4), degree=1)
    error = 1 / likelihood.weight - 1e4
    np.testing.assert_allclose(error, [0, np.var(line**2)], atol=1e-3)
    at = np.array([1.0, 3.4, 4.6])
    told = likelihood.log(np.stack([at, 0 * at], axis=1))
    np.testing.assert_allclose(told[:2], 0, atol=1e-3)  # 3.4 is 5.9 standard deviations of the points
    assert told[2] == pytest.approx(-10 * (4.6 / (2 * line.std()) - 3) ** 2, rel=0.01)


@pytest.mark.slow
def test_interim_draws_have_the_moments_of_quadrature():
    runs, rng = Curved(n_sets=3), np.random.default_rng(2)
    x = runs.truth[:, None] + 0.6 * rng.standard_normal((3, 600, 2))
    seen = runs.predictions(x.transpose(1, 0, 2)).transpose(1, 0, 2)
    emulators = fitted(x, seen, runs.values, runs.weight, degree=2)
    mean, std = np.zeros(2), np.array([0.9, 0.7])
    draws = draw_interim(emulators, mean, std, 4, "x", count=400)
    a, b = np.meshgrid(np.linspace(-4, 4, 401), np.linspace(-3, 3, 301), indexing="ij")
    predictions = runs.predictions(np.stack([a, b], axis=-1))
    for s in range(3):
        log = -0.5 * np.sum(runs.weight[s] * (runs.values[s] - predictions) ** 2, axis=-1)
        density = np.exp(log - 0.5 * (a / std[0]) ** 2 - 0.5 * (b / std[1]) ** 2)
        density /= density.sum()
        for values, j in ((a, 0), (b, 1)):
            middle = np.sum(density * values)
            spread = np.sqrt(np.sum(density * (values - middle) ** 2))
            assert draws[s, :, j].mean() == pytest.approx(middle, abs=0.1 * spread)
            assert draws[s, :, j].std() == pytest.approx(spread, rel=0.1)


class LinearSets:
    """y_i = H_i x_i + noise: marginals over x ~ N(ν, D), posteriors given ν and D, all known."""

    def __init__(self):
        self.rng = np.random.default_rng(5)
        self.H, self.y, self.std = self.rng.standard_normal((4, 5, 2)), self.rng.standard_normal((4, 5)), 0.7
        self.nu, self.variance = np.array([[0.0, 0.0], [0.5, -0.4]]), np.array([[0.3, 0.2], [0.05, 0.4]])

    def log_marginals(self, b, power=1):
        """(S,) of population b; ∫ L(x)^power N(x; ν, D) dx with ln L = −½ Σ (y − Hx)²/std²."""
        H, d, std = self.H, np.diag(self.variance[b]), self.std / np.sqrt(power)
        covariance = [H[s] @ d @ H[s].T + std**2 * np.eye(5) for s in range(4)]
        logs = [multivariate_normal(H[s] @ self.nu[b], covariance[s]).logpdf(self.y[s]) for s in range(4)]
        return np.array(logs) + 5 * np.log(std * np.sqrt(2 * np.pi))

    def posterior(self, b, s):
        """Mean and covariance of x_s given population b."""
        covariance = np.linalg.inv(np.diag(1 / self.variance[b]) + self.H[s].T @ self.H[s] / self.std**2)
        return covariance @ (self.nu[b] / self.variance[b] + self.H[s].T @ self.y[s] / self.std**2), covariance

    def interim(self, mean, wide):
        """Moments of the posteriors under N(mean, wide²)."""
        cov = np.linalg.inv(np.diag(wide**-2.0) + np.einsum("ski,skj->sij", self.H, self.H) / self.std**2)
        return np.einsum("sij,sj->si", cov, mean / wide**2 + np.einsum("ski,sk->si", self.H, self.y) / self.std**2), cov

    def emulators(self):
        """Exact ones, trusted everywhere that counts."""
        x = 2 * self.rng.standard_normal((4, 200, 2))
        seen, weight = np.einsum("skj,sbj->sbk", self.H, x), np.full((4, 5), self.std**-2.0)
        return fitted(x, seen, self.y, weight, degree=1, must=200)


def test_a_gaussian_likelihood_has_the_marginal_of_a_gaussian():
    """Linear likelihoods: mixture draws of one component each against the normal density of the data."""
    case = LinearSets()
    mean, wide = np.array([0.2, -0.1]), np.array([1.0, 1.3])
    draws = np.stack(
        [case.rng.multivariate_normal(m, c, 20_000) for m, c in zip(*case.interim(mean, wide), strict=True)]
    )
    mixtures = fit_mixtures(draws, mean, wide, 5, "mixtures", components=1)
    exact = [case.log_marginals(b).sum() for b in (0, 1)]
    told = log_marginal(mixtures, case.nu, case.variance)
    assert told[1] - told[0] == pytest.approx(exact[1] - exact[0], abs=0.1)


@pytest.mark.parametrize(
    ("shift", "shrink"),
    [pytest.param(0, 1, marks=pytest.mark.slow), (0, 0.2), (1, 0.5)],
    ids=["fitting", "narrow", "beside"],
)
def test_marginals_are_unbiased_and_their_draws_the_posterior_however_bad_the_mixtures(shift, shrink):
    """Mixtures of a fifth of the standard deviation, or beside the likelihood, alone would give unbounded weights."""
    case, count, repeats = LinearSets(), 60, 4000
    centre, covariance = case.interim(np.zeros(2), np.full(2, 1.2))
    centre = centre + shift * np.sqrt(np.einsum("sii->si", covariance))
    mixtures = [
        Mixture.divided(centre[[s]], shrink**2 * covariance[[s]], np.zeros(1), np.zeros(2), np.full(2, 1.2))
        for s in range(4)
    ]
    sets = [SetPosterior(*parts) for parts in zip(case.emulators(), mixtures, mixtures, strict=True)]
    for b in (0, 1):
        mean, variance = np.tile(case.nu[b], (repeats, 1)), np.tile(case.variance[b], (repeats, 1))
        told = marginals(sets, mean, variance, [count] * 4, 1, 7, f"x{b}", workers=2)
        ratio = np.exp(told.logs - case.log_marginals(b))
        variance_of = ratio.var(axis=0)
        np.testing.assert_array_less(np.abs(ratio.mean(axis=0) - 1), 4 * np.sqrt(variance_of / repeats) + 1e-6)
        few = round(DEFENSIVE * count)  # ∫ L² N²/q ≤ ∫ L² N/ε: no weight decides
        np.testing.assert_array_less(variance_of, np.exp(case.log_marginals(b, 2) - 2 * case.log_marginals(b)) / few)
        if (shift, shrink) == (0, 1):  # where a few draws tell their own variance; less, for they are stratified
            np.testing.assert_array_less(variance_of, 1.1 * told.variance.mean(axis=0) / count)
        for s in range(4):  # a pick given its estimate, weighted by that, is a draw of the posterior
            middle, cov = case.posterior(b, s)
            weights, x = ratio[:, s] / ratio[:, s].sum(), told.x[:, s, 0]
            error = 4 * np.sqrt(np.diag(cov) * np.sum(weights**2))
            np.testing.assert_array_less(np.abs(weights @ x - middle), error)
            np.testing.assert_allclose(weights @ (x - middle) ** 2, np.diag(cov), rtol=0.15)


def test_prior_divided_out_is_the_likelihood():
    rng = np.random.default_rng(0)
    H, y = rng.standard_normal((4, 3)), rng.standard_normal(4)
    mean, std = np.array([1.0, -2.0, 0.3]), np.array([0.5, 1.5, 0.7])
    cov = np.linalg.inv(np.diag(std**-2.0) + H.T @ H / 0.09)
    middle = cov @ (mean / std**2 + H.T @ y / 0.09)
    evidence = multivariate_normal(H @ mean, H @ np.diag(std**2) @ H.T + 0.09 * np.eye(4)).logpdf(y)
    found = Mixture.divided(middle[None], cov[None], np.array([evidence]), mean, std)
    x = mean + 0.4
    told = found.constant[0] + found.linear[0] @ x - 0.5 * x @ found.precision[0] @ x
    assert told == pytest.approx(multivariate_normal(H @ x, 0.09 * np.eye(4)).logpdf(y), abs=1e-9)


def test_runs_of_all_sets_are_those_of_each():
    problems = build(load_config(CONFIGS / "agarose_03_qlkv.yaml"))[:3]
    prior = problems[0].prior
    x = prior.mean + 0.3 * prior.std * member_stream(1, "x").standard_normal((4, 3, len(prior.names)))
    with ThreadsExecutor(2) as executor:
        runs = ForwardRuns(problems, executor)
        told = log_likelihood(runs, runs.predictions(x))
    for s, problem in enumerate(problems):
        z = (x[:, s] - prior.mean) / prior.std
        np.testing.assert_allclose(-told[:, s], cost(problem, x[:, s]) - 0.5 * np.sum(z**2, axis=1), rtol=1e-6)


def test_errors_that_a_population_cannot_take():
    config = load_config(CONFIGS / "agarose_03_qlkv.yaml", {"data.error.time_std": "0.2 us"})
    with pytest.raises(ConfigError, match="independent Gaussian errors"):
        ForwardRuns(build(config))
