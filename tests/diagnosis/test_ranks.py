"""The test of uniform ranks: against a closed form, on uniform ranks, and on ranks that are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from en4dvar.diagnosis.ranks import uniform_ranks

SETS, MEMBERS = 100, 48


def test_with_one_member_it_is_the_test_of_a_fair_coin():
    uniform = uniform_ranks(20, 1)
    for heads in (4, 7, 10, 15):
        ranks = np.array([1] * heads + [0] * (20 - heads))
        exact = binomtest(heads, 20, 0.5).pvalue
        assert uniform.p_value(ranks) == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / 4000) + 1e-3)


def test_of_uniform_ranks_as_many_are_rejected_as_is_said():
    stream = np.random.default_rng(5)
    uniform = uniform_ranks(SETS, MEMBERS)
    ranks = stream.integers(0, MEMBERS + 1, size=(1000, SETS))
    p = np.array([uniform.p_value(each) for each in ranks])
    for level in (0.05, 0.5):
        assert binom.cdf(np.sum(p <= level), 1000, level) == pytest.approx(0.5, abs=0.499)
    low, high = uniform.band
    shares = np.array([uniform.distribution(each) for each in ranks])
    inside = np.all((low <= shares) & (shares <= high), axis=1)
    assert 0.92 < inside.mean() < 0.985


@pytest.mark.parametrize(
    ("mean", "std"), [(0.5, 1.0), (-0.5, 1.0), (0.0, 1.6), (0.0, 0.6)], ids=["low", "high", "narrow", "wide"]
)
def test_ranks_that_are_not_uniform_are_seen(mean, std):
    """Truths of N(mean, std²) among members of N(0, 1)."""
    stream = np.random.default_rng(6)
    truths, members = mean + std * stream.standard_normal(SETS), stream.standard_normal((SETS, MEMBERS))
    assert uniform_ranks(SETS, MEMBERS).p_value(np.sum(members < truths[:, None], axis=1)) < 0.01
