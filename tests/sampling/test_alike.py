"""Few draws that stand for many: on the posterior, with its moments and its quantiles."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar.sampling.alike import standing_for
from en4dvar.sampling.modes import WeightedDraws

WIDTH = 0.05


def bent(count, seed):
    """Draws about a parabola, of this width across it."""
    stream = np.random.default_rng(seed)
    along = stream.standard_normal(count)
    return np.column_stack([along, along**2 + WIDTH * stream.standard_normal(count), stream.standard_normal(count)])


def across(x):
    """How far draws lie from the parabola, on average, in squares of its width; 1 of all draws."""
    return float(np.mean((x[:, 1] - x[:, 0] ** 2) ** 2) / WIDTH**2)


def moments(x):
    return x.mean(axis=0), np.cov(x.T)


@pytest.mark.parametrize("seed", range(4))
def test_members_of_a_bent_posterior_stay_on_it(seed):
    x = bent(1000, seed)
    mean, covariance = moments(x)
    every = np.arange(0, 1000, 20)
    members = standing_for(x, every, mean, covariance)
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(members.mean(axis=0) / std, mean / std, atol=0.02)
    np.testing.assert_allclose(np.cov(members.T), covariance, atol=0.1 * np.max(std) ** 2)
    assert across(x) == pytest.approx(1, abs=0.2)
    assert across(members) < 1.7
    assert all(any(np.array_equal(member, draw) for draw in x) for member in members)


def test_as_many_members_lie_below_a_quantile_as_draws():
    x = bent(1000, 7)
    members = standing_for(x, np.arange(0, 1000, 20), *moments(x))
    for level in (0.05, 0.25, 0.75, 0.95):
        share = np.mean(members < np.quantile(x, level, axis=0), axis=0)
        assert share == pytest.approx(np.full(3, level), abs=0.031)  # one and a half of 50


@pytest.mark.parametrize("share", [0.5, 0.94, 0.995])
def test_each_mode_keeps_its_share_and_its_own_moments(share):
    """Two modes far apart, wide where the other is narrow: to match the moments of both together, which rounding of the
    number of members changes, led the members of each off it by up to its standard deviation.
    """
    stream = np.random.default_rng(1)
    mode = (np.arange(2000) >= 2000 * share).astype(np.intp)
    x = stream.standard_normal((2000, 2)) * np.where(mode[:, None], (0.02, 0.3), (0.3, 0.02)) + 3.0 * mode[:, None]
    draws = WeightedDraws(x, np.full(2000, 1 / 2000), mode, np.zeros(2000), 0.0, x[0], None)
    members = draws.members(48, np.random.default_rng(2), exact=True)
    for number, of_both in enumerate((share, 1 - share)):
        own, of_mode = members[(members[:, 0] > 1.5) == number], x[mode == number]
        assert len(own) == pytest.approx(48 * of_both, abs=1)
        if len(own) > 10:
            std = of_mode.std(axis=0)
            np.testing.assert_allclose(own.mean(axis=0) / std, of_mode.mean(axis=0) / std, atol=0.02)
            np.testing.assert_allclose(own.std(axis=0, ddof=1), std, rtol=0.05)


def test_too_few_members_are_the_chosen_draws():
    x = bent(100, 3)
    np.testing.assert_array_equal(standing_for(x, np.array([4, 7]), *moments(x)), x[[4, 7]])


def test_members_of_weighted_draws_are_the_same_in_any_units():
    """They are drawn evenly along the direction in which parameters vary most, not along that of the largest unit."""
    stream = np.random.default_rng(6)
    x, shares, sizes = stream.standard_normal((600, 2)), stream.dirichlet(np.ones(600)), np.array([2.0**20, 2.0**-40])
    x[:, 1] += 0.5 * x[:, 0]
    mode = (x[:, 0] > 1).astype(np.intp)
    alike, mixed = (
        WeightedDraws(x * of, shares, mode, np.zeros(600), 0.0, x[0], None).members(
            48, np.random.default_rng(7), exact=False
        )
        / of
        for of in (np.ones(2), sizes)
    )
    np.testing.assert_allclose(mixed, alike)
