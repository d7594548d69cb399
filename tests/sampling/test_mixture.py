"""Mixtures of Student t: normalised, and drawn as they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from en4dvar.sampling.importance import ClosingDraws
from en4dvar.sampling.mixture import StudentMixture


def test_a_proposal_is_normalised_and_as_heavy_as_it_says():
    rng = np.random.default_rng(3)
    draws = np.concatenate([rng.standard_normal((3000, 3)), 4 + 0.3 * rng.standard_normal((1000, 3))])
    proposal = StudentMixture.fitted(draws, rng, components=2)
    h = proposal.draw(50_000, rng)
    wide = multivariate_normal(np.ones(3), 9 * np.eye(3))
    x = wide.rvs(50_000, random_state=rng)
    assert np.mean(np.exp(proposal.log_density(x) - wide.logpdf(x))) == pytest.approx(1, abs=0.05)
    weights = np.exp(multivariate_normal(np.zeros(3), np.eye(3)).logpdf(h) - proposal.log_density(h))
    assert weights.mean() == pytest.approx(1, abs=0.02)
    np.testing.assert_allclose(weights @ h**2 / weights.sum(), 1, atol=0.05)
    assert weights.max() < 10


def test_an_integral_far_narrower_than_where_the_draws_begin():
    """A likelihood 1000 times as narrow as the prior in four directions: proposals close in on it, none is singular."""
    prior = StudentMixture(np.ones(1), np.zeros((1, 4)), np.eye(4)[None])
    found, narrow = ClosingDraws(prior, np.random.default_rng(0), 200, 1.8), 1e6
    for _ in range(12):
        z = found.draw()
        found.add(z, -0.5 * narrow * np.sum((z - 0.3) ** 2, axis=1))
    apart = np.linalg.norm(found.z - 0.3, axis=1)
    assert apart[-200:].min() < 0.2 * apart[:200].min()
    few = ClosingDraws(prior, np.random.default_rng(0), 200, 1.8)
    few.add(few.draw(), np.where(np.arange(200) < 3, 0.0, -np.inf))
    assert few.next_proposal() is few.proposals[0]
