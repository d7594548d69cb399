"""The population of a campaign with curved, cusped and twofold likelihoods against quadrature."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import halfnorm, norm
from toys import Toy, Vectorised, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.population import HyperPrior, Population, population_of
from en4dvar.model.forward import Batch
from en4dvar.priors.prior import Prior, PriorTerm

SETS, ERRORS, STD = 8, np.array([0.1, 0.5]), np.array([0.8, 0.6])  # errors of the readings, std of the prior of a and b
HYPER, LEVELS = HyperPrior(mean_std=1.0, spread=0.5, odd=0.0), (0.025, 0.5, 0.975)
FAR = HyperPrior(mean_std=3.0, spread=1.5, odd=0.0)  # farther than the prior of a data set


def curved(a, b):
    """One combination of a and b is sharp and curved, the other hardly told."""
    return a + b + 0.6 * b**2, 0.5 * a - 0.3 * a * b


def unread(a, b):
    """Each data set tells little of a, and that more above than below."""
    return 0.15 * np.exp(a) + b, 0.2 * a


def cusped(a, b):
    """The second reading has a cusp, as the radius at the end of a collapse."""
    return a + b + 0.6 * b**2, 1.5 * np.sqrt(np.abs(a - 0.4 * b - 0.5))


def twofold(a, b):
    """Each data set leaves two a open, on both sides of 0.2."""
    return (a - 0.2) ** 2 + 0.1 * b, 0.5 * a - 0.3 * b


class TwoReadings(Toy):
    """The first of a pair of functions of (a, b) is read before the time 0.5, the second after it."""

    def __init__(self, pair):
        super().__init__()
        self.pair = pair

    def initial_state(self, theta):
        return np.array([0.0, 0.0, theta["a"], theta["b"]])

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        first, second = self.pair(x[:, 2, None], x[:, 3, None])
        y = np.where(own < 0.5, first, second)
        states = np.stack([y, 0 * y, *np.broadcast_to(x[:, 2:].T[..., None], (2, *y.shape))], axis=-1)
        return Batch(own, states, self.layout)


@dataclass(frozen=True)
class Case:
    """``outlier``: how much further than the others the first a lies. The start of a twofold one is at the a that the
    data put less in.
    """

    pair: object
    middle: float = 0.4
    outlier: float = 0.0
    hyper: HyperPrior = HYPER

    def drawn(self):
        """Truths (S, 2) and readings (S, 2)."""
        rng = np.random.default_rng(0)
        truth = np.stack([self.middle + 0.3 * rng.standard_normal(SETS), 0.5 * rng.standard_normal(SETS)], axis=1)
        truth[0, 0] += self.outlier
        exact = np.stack(self.pair(*truth.T), axis=1)
        return truth, exact + ERRORS * rng.standard_normal(exact.shape)

    def estimated(self, seed) -> Population:
        truth, values = self.drawn()
        base, model = make_problem(Vectorised(), [0.0, 0.0]), TwoReadings(self.pair)
        prior = Prior(tuple(PriorTerm.normal(p, 0.0, s) for p, s in zip(model.parameters, STD, strict=True)))
        times, beside = np.array([0.2, 1.0]), [0.4, 0.0] if self.pair is twofold else [0.0, 0.0]
        problems, start = [], []
        for s, (at, y) in enumerate(zip(truth, values, strict=True)):
            observed = Observations(times, y, noise_of(ERRORS, np.zeros(2)), np.ones(2), name=f"set{s}")
            problems.append(replace(base, model=model, observations=observed, prior=prior))
            mirrored = at * [-1, 1] if self.pair is twofold else at
            spread = 0.2 * np.random.default_rng(100 * seed + s).standard_normal((30, 2))
            start.append((mirrored + beside + spread) / STD)
        return population_of(problems, start, ["a"], seed, hyper=self.hyper)


@functools.cache
def by_quadrature(case):
    """Quantiles and standard deviation of ν, mean of τ and ln p(data), by sums over fine grids."""
    _, values = case.drawn()
    a, b = np.linspace(-5, 5, 1001), np.linspace(-3, 3, 601)
    grid = np.stack(case.pair(*np.meshgrid(a, b, indexing="ij")), axis=-1)[:, :, None]
    log = -0.5 * np.sum(((values - grid) / ERRORS) ** 2, axis=-1)  # (a, b, S)
    of_a = np.einsum("abs,b->as", np.exp(log), norm(0, STD[1]).pdf(b)) * (b[1] - b[0])
    nu, tau = np.linspace(-4.0, 4.4, 421), np.geomspace(4e-3, 4.0, 55)
    total = np.empty((len(nu), len(tau)))
    for j, t in enumerate(np.maximum(tau, 0.02)):  # below the grid's spacing of 0.01 nothing changes any more
        total[:, j] = np.sum(np.log(norm.pdf(a, nu[:, None], t) @ of_a * (a[1] - a[0]) + 1e-300), axis=1)
    log = total + norm(0, case.hyper.mean_std * STD[0]).logpdf(nu)[:, None]
    log += halfnorm(scale=case.hyper.spread * STD[0]).logpdf(tau)
    weights = np.exp(log - log.max()) * (nu[1] - nu[0]) * np.gradient(tau)
    evidence = log.max() + np.log(weights.sum())
    weights /= weights.sum()
    of_nu = weights.sum(axis=1)
    std = np.sqrt(of_nu @ nu**2 - (of_nu @ nu) ** 2)
    return np.interp(LEVELS, np.cumsum(of_nu) - 0.5 * of_nu, nu), std, weights.sum(axis=0) @ tau, evidence


CASES = [
    pytest.param(Case(curved), id="curved", marks=pytest.mark.slow),
    pytest.param(Case(curved, outlier=2.0), id="outlier", marks=pytest.mark.slow),
    pytest.param(Case(cusped), id="cusped", marks=pytest.mark.slow),
    pytest.param(Case(twofold, middle=1.2), id="twofold", marks=[pytest.mark.slow, pytest.mark.long]),
    pytest.param(Case(unread, hyper=FAR), id="a wide hyperprior", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("case", CASES)
def test_a_population_of_such_likelihoods_against_quadrature(case):
    """The draws of each data set are worth 200: the median scatters by 0.15 std, ln p(y) by 0.25."""
    quantiles, std, spread, evidence = by_quadrature(case)
    found = case.estimated(3)
    nu = STD[0] * found.posterior.nu[:, 0]
    assert found.converged
    assert nu.mean() == pytest.approx(quantiles[1], abs=0.45 * std)
    assert nu.std() == pytest.approx(std, rel=0.15)
    assert STD[0] * found.posterior.tau.mean() == pytest.approx(spread, rel=0.15)
    assert found.log_evidence == pytest.approx(evidence, abs=0.75)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_repeated_estimates_have_no_bias(case):
    quantiles, std, _, evidence = by_quadrature(case)
    several = [case.estimated(seed) for seed in range(8)]
    below = np.mean([[np.mean(STD[0] * f.posterior.nu[:, 0] < value) for value in quantiles] for f in several], axis=0)
    assert below == pytest.approx(LEVELS, abs=0.07)
    assert np.mean([STD[0] * f.posterior.nu[:, 0].std() for f in several]) == pytest.approx(std, rel=0.08)
    assert np.mean([found.log_evidence for found in several]) == pytest.approx(evidence, abs=0.3)


def bent(a, b):
    """A sharp bent valley of a and b, along which hardly anything is told."""
    return 2 * a + 1.4 * b + 0.3 * (a - 0.7 * b) ** 2, 1.4 * b


@pytest.mark.slow
def test_along_a_bent_valley_intervals_are_hardly_too_short():
    """Six equal data sets, both parameters of the population, which hardly spreads: its density on a grid is the
    product of theirs. Of eight campaigns the standard deviations are within a fifth of the exact ones on average.
    """
    errors, hyper = np.array([0.1, 3.0]), HyperPrior(mean_std=1.0, spread=0.03, odd=0.0)
    base, model = make_problem(Vectorised(), [0.0, 0.0]), TwoReadings(bent)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    grid = np.stack(np.meshgrid(*[np.arange(-4.5, 4.5, 0.01)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    of_grid, times, ratios = np.stack(bent(*grid.T), axis=1), np.array([0.2, 1.0]), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        total, problems, start = -0.5 * np.sum(grid**2, axis=1), [], []
        for s, values in enumerate(np.array(bent(0.9, -1.1)) + errors * rng.standard_normal((6, 2))):
            own = -0.5 * np.sum(((values - of_grid) / errors) ** 2, axis=1)
            posterior = np.exp(own - 0.5 * np.sum(grid**2, axis=1))
            start.append(grid[rng.choice(len(grid), 48, p=posterior / posterior.sum())])
            observed = Observations(times, values, noise_of(errors, np.zeros(2)), np.ones(2), name=f"set{s}")
            problems.append(replace(base, model=model, observations=observed, prior=prior))
            total += own
        shares = np.exp(total - total.max())
        shares /= shares.sum()
        exact = np.sqrt(shares @ (grid - shares @ grid) ** 2)
        estimated = population_of(problems, start, ["a", "b"], seed, hyper=hyper)
        ratios.append(estimated.posterior.nu.std(axis=0) / exact)
    assert np.mean(ratios, axis=0) == pytest.approx(1.0, rel=0.2)
