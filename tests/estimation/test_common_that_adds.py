"""Positive parameters to which a common quantity adds, as a pressure adds to a modulus: populations of soft gels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.contrast import Centre, drawn_together
from en4dvar.estimation.population.following import Following
from en4dvar.estimation.population.hierarchy import Hierarchy
from en4dvar.estimation.population.own import OwnDraws, empirical, own_likelihoods
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import PriorTerm

LOG_STD, ADDED, ERROR, SETS = 1.5, 0.25, 0.05, 6  # e^{sx} has the median 1
HYPER = HyperPrior(1.0, 0.25, odd=0.0)
X, THETA = np.linspace(-4.5, 2.2, 403), np.linspace(-4, 4, 121)
OF_X, OF_THETA = np.meshgrid(X, THETA, indexing="ij")


def likelihoods_on_grid(level, seed):
    """Of y = e^{sx} + 0.25 θ + e, of six data sets whose e^{sx} varies by a tenth about ``level`` (6, x, θ)."""
    rng = np.random.default_rng(seed)
    y = level * np.exp(0.1 * rng.standard_normal(SETS)) + ERROR * rng.standard_normal(SETS)
    return [norm(np.exp(LOG_STD * OF_X) + ADDED * OF_THETA, ERROR).pdf(reading) for reading in y]


def drawn(likely, seed):
    """Draws of the posterior of a data set under x, θ ~ N(0, 1)."""
    rng = np.random.default_rng(seed)
    shares = (likely * norm.pdf(OF_X) * norm.pdf(OF_THETA)).ravel()
    taken = rng.choice(OF_X.size, size=2000, p=shares / shares.sum())
    within = np.array([X[1] - X[0], THETA[1] - THETA[0]]) * rng.uniform(-0.5, 0.5, (2000, 2))
    return OwnDraws(np.stack([OF_X.ravel()[taken], OF_THETA.ravel()[taken]], axis=1) + within, 0.0, 2000.0, 0)


def sampled(likely, seed=1):
    names = [f"set{s}" for s in range(SETS)]
    sets = [drawn(like, seed + 10 * s) for s, like in enumerate(likely)]
    likelihoods = own_likelihoods(sets, [0], [1], seed, names, np.array([LOG_STD]))
    return likelihoods[0].following, Hierarchy(likelihoods, HYPER).sampled(seed, Effort())


NU, TAU = np.linspace(-3.5, 1.5, 101), np.geomspace(0.01, 1.2, 30)


def by_quadrature(likely):
    """Shares (ν, θ) of the posterior."""
    log = -0.5 * (NU[:, None, None] / HYPER.mean_std) ** 2 - 0.5 * (TAU[:, None] / HYPER.spread) ** 2 - 0.5 * THETA**2
    within = norm(NU[:, None, None], TAU[:, None]).pdf(X)
    within /= np.maximum(within.sum(axis=2, keepdims=True), 1e-300)
    for like in likely:
        log = log + np.log(within @ like + 1e-300)
    shares = (np.exp(log - log.max()) * np.gradient(TAU)[:, None]).sum(axis=1)
    return shares / shares.sum()


def quantiles(values, shares):
    """5, 50 and 95 % of values with these shares."""
    order = np.argsort(values, axis=None)
    ordered = shares.ravel()[order]
    return np.interp([0.05, 0.5, 0.95], np.cumsum(ordered) - 0.5 * ordered, values.ravel()[order])


def test_where_what_is_common_is_all_there_is():
    """e^{sx} of a very soft gel is nothing beside it: y has a value, and the density of such a population is one."""
    sets = [drawn(like, s) for s, like in enumerate(likelihoods_on_grid(0.5, 6))]
    likelihoods = own_likelihoods(sets, [0], [1], 1, [f"set{s}" for s in range(SETS)], np.array([LOG_STD]))
    h = np.array([[-40.0, np.log(2e-3), theta] for theta in np.linspace(-3.0, 3.0, 61)])
    assert np.isfinite(Hierarchy(likelihoods, HYPER).log_density(h)).all()


@pytest.mark.parametrize(("level", "seed"), [(0.25, 1), pytest.param(3.0, 3, marks=pytest.mark.slow)])
def test_what_adds_to_a_positive_parameter_is_that_of_quadrature(level, seed):
    """The common quantity is as large as the softest level: with slopes of ln G its 95 % would be twice as large."""
    likely = likelihoods_on_grid(level, seed)
    following, draws = sampled(likely)
    assert following.slopes[0, 0] == pytest.approx(-ADDED, rel=0.1)
    exact = np.exp(LOG_STD * quantiles(NU, by_quadrature(likely).sum(axis=1)))
    ours = np.exp(LOG_STD * np.quantile(draws.nu, [0.05, 0.5, 0.95]))
    np.testing.assert_allclose(ours, exact, rtol=0, atol=0.06 * (exact[2] - exact[0]))


@pytest.mark.slow
def test_the_difference_of_two_gels_is_not_that_of_their_common_error():
    """Both e^{sν} rise with θ by as much, so that their difference is known well though each is not."""
    centres, of_each = [], []
    for level, seed in ((0.5, 4), (0.9, 5)):
        likely = likelihoods_on_grid(level, seed)
        _, draws = sampled(likely)
        centres.append(Centre(draws.nu[:, 0], draws.theta, ("camera",), log=LOG_STD))
        of_each.append(by_quadrature(likely))
    together = of_each[0][:, None] * of_each[1] / norm.pdf(THETA)  # (ν, ν, θ), the prior of θ once
    level = np.exp(LOG_STD * NU)
    exact = quantiles(level - level[:, None], together.sum(axis=2) / together.sum())
    first, second = np.exp(LOG_STD * drawn_together(centres, 1)).T
    ours = np.quantile(second - first, [0.05, 0.5, 0.95])
    np.testing.assert_allclose(ours, exact, rtol=0, atol=0.1 * (exact[2] - exact[0]))
    assert exact[2] - exact[0] < 0.5 * np.subtract(*np.quantile(first, [0.95, 0.05]))


def test_there_and_back():
    """x of y of x; what is common takes all but a hundredth at most."""
    following = Following(np.array([[0.4, -0.2], [0.3, 0.1]]), np.array([0.0, 1.2]))
    rng = np.random.default_rng(0)
    x, theta = rng.standard_normal((100, 2)), rng.standard_normal((100, 2))
    y = following.own(x, theta)
    kept = np.exp(1.2 * x[:, 1]) - theta @ following.slopes[1] > 0.01 * np.exp(1.2 * x[:, 1])
    np.testing.assert_allclose(following.together(y, theta)[kept], x[kept], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(y[:, 0], x[:, 0] - theta @ following.slopes[0])
    np.testing.assert_allclose(np.exp(1.2 * (y - x)[~kept, 1]), 0.01)


def test_far_along_what_is_common_no_two_values_become_one():
    """A slope of −0.3 (y − 1) shrinks distances by e^{−0.3 θ}; as one step of 1 − 0.3 θ it ends at none, and beyond."""
    following = Following(np.zeros((1, 1)), np.zeros(1), np.full((1, 1, 1), -0.3), np.ones(1))
    theta = np.array([[0.5], [3.0], [4.0]])
    apart = following.together(np.full((3, 1), 2.0), theta) - following.together(np.zeros((3, 1)), theta)
    np.testing.assert_allclose(apart, 2 * np.exp(-0.3 * theta), rtol=0.06)
    np.testing.assert_allclose(following.own(following.together(np.zeros((3, 1)), theta), theta), 0.0, atol=1e-12)


def test_the_median_one_by_one_of_soft_gels_reaches_as_far_as_what_is_common():
    """Level 0.5, of which what is common may take or add 0.25 for a standard deviation, or all of it."""
    term = PriorTerm.lognormal(Parameter("G", "Pa"), 1.0, LOG_STD)
    following = Following(np.array([[-ADDED]]), np.array([LOG_STD]))
    middle = np.log(0.5) / LOG_STD + 1e-3 * np.arange(-3, 4)
    low, level, high = empirical(term, middle, np.full(7, 1e-3), following, 1).quantiles
    assert (low, level, high) == pytest.approx((0.5 - 1.645 * ADDED, 0.5, 0.5 + 1.645 * ADDED), abs=0.01)
    assert (
        empirical(term, middle, np.full(7, 1e-3), replace(following, slopes=3 * following.slopes), 1).quantiles[0] > 0
    )


def test_moments_and_prior_are_those_of_draws():
    following, rng = Following(np.array([[0.5], [0.25]]), np.array([0.0, 1.5])), np.random.default_rng(1)
    mean, variance, theta = np.array([[0.3, 0.2]]), np.array([[0.04, 0.01]]), np.array([[0.8]])
    y = following.own(mean + np.sqrt(variance) * rng.standard_normal((40_000, 2)), theta)
    of_y = following.moments(mean, variance, theta)
    np.testing.assert_allclose(of_y[0][0], y.mean(axis=0), atol=2e-3)
    np.testing.assert_allclose(1 / np.diag(of_y[1][0]), y.var(axis=0), rtol=0.02)
    centre, scale = np.array([0.4, -0.3]), np.array([0.7, 0.9])
    y = following.own(centre + scale * rng.standard_normal((40_000, 2)), rng.standard_normal((40_000, 1)))
    std, logs = following.prior(y, centre, scale)
    assert std[0] == pytest.approx(y[:, 0].std(), rel=0.01)
    for low, high in ((-2.0, -1.0), (-1.0, 0.0), (0.0, 1.0)):  # normal shares from draws that are weighed
        within = (y[:, 1] > low) & (y[:, 1] < high)
        share = norm.cdf(high, -0.3, 0.9) - norm.cdf(low, -0.3, 0.9)
        assert np.exp(logs)[within].sum() / len(y) == pytest.approx(share, rel=0.03)
