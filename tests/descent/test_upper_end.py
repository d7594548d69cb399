"""The upper end of errors of unknown size beside few degrees of freedom: the default estimate against a sum over σ."""

import numpy as np
import pytest
from toys import cosines_estimated

from en4dvar.diagnosis.diagnostics import member_quantiles

STD, PRIOR = 0.2, 3.0
SCORES = np.linspace(-5, 5, 1001)


def ratios(n, k, seed, truth=1.0):
    """5, 50 and 95 % of σ over those of its posterior, for a sum of n cosines with k readings."""
    random, t = np.random.default_rng([seed, n, k]), np.linspace(0, 1, k)
    design = np.cos(np.pi * np.outer(t, np.arange(n)))
    y = design @ np.full(n, 0.5) + truth * STD * random.standard_normal(k)
    along, lengths, _ = np.linalg.svd(PRIOR * design)
    variance = np.square(np.append(lengths, np.zeros(k - n)))[:, None] + (STD * np.exp(SCORES)) ** 2
    logs = -0.5 * np.sum((along.T @ y)[:, None] ** 2 / variance + np.log(variance), axis=0) - 0.5 * SCORES**2
    below = np.cumsum(np.exp(logs - logs.max()))
    levels = np.array([0.05, 0.5, 0.95])
    exact = np.exp(np.interp(levels, below / below[-1], SCORES))
    return member_quantiles(cosines_estimated(n, y, STD, seed).posterior["sigma"].values.ravel(), levels) / exact


@pytest.mark.slow
@pytest.mark.parametrize(("n", "k"), [(12, 14), (8, 12)])
def test_ends_of_the_noise_scale_are_those_of_its_posterior(n, k):
    """Draws of the noise scale in no order, and mixed with the other parameters', leave the ends off by 7 to 14 %."""
    logs = np.log([ratios(n, k, seed) for seed in range(8)])
    assert np.all(np.abs(logs.mean(axis=0)) < 0.04)
    assert np.all(np.sqrt(np.mean(logs**2, axis=0)) < 0.05)


def test_a_posterior_far_from_the_mode_is_drawn_from_where_the_first_draws_say_it_is():
    """Errors five times as large as stated, of which two degrees of freedom tell: the Gaussian about the mode has a
    third of the upper end.
    """
    for seed in range(4):
        assert np.all(np.abs(np.log(ratios(12, 14, seed, truth=5.0))) < 0.15)
