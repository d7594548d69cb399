"""What is told of residuals of few degrees of freedom beside errors of unknown size."""

import numpy as np
import pytest
from toys import cosines_estimated

from en4dvar.diagnosis.residuals import Residuals

OF_RESIDUALS = {"misfit", "overstated-error", "odd-residuals", "residual-structure"}
STD = 0.2


def doubts(n, k, seed, within=True, outlier=0.0):
    """Codes of the warnings about the residuals of a sum of n cosines with k readings, and where one is off."""
    random, t = np.random.default_rng([seed, n, k]), np.linspace(0, 1, k)
    values = np.full(n, 0.5) if within else 3 * random.standard_normal(n)
    y = np.cos(np.pi * np.outer(t, np.arange(n))) @ values + STD * random.standard_normal(k)
    y[k // 3] += outlier * STD
    stats = cosines_estimated(n, y, STD, seed).sample_stats
    return OF_RESIDUALS & set(stats.attrs["warning_codes"].split()), stats.attrs


@pytest.mark.slow
@pytest.mark.parametrize(("n", "k"), [(12, 14), (6, 8), (8, 12)])
def test_where_all_is_right_nothing_is_doubted(n, k):
    """With the noise scale of the minimum, which is too small by the degrees of freedom that the fit uses up, half of
    such estimates were doubted.
    """
    for seed in range(6):
        codes, stats = doubts(n, k, seed, within=seed % 2 == 0)
        assert codes == set()
        assert 0.2 * (k - n) < stats["chi2_per_observation"] * k < 1.5 * (k - n)
        assert n - 0.5 < stats["dfs"] < n


@pytest.mark.parametrize(("n", "k"), [(3, 30), pytest.param(10, 40, marks=pytest.mark.slow)])
def test_a_reading_six_standard_deviations_off_is_told(n, k):
    """With its own error it is 4 to 8 off, and the fit takes a share of it."""
    codes = [doubts(n, k, seed, outlier=6.0)[0] for seed in range(6)]
    assert sum("odd-residuals" in told for told in codes) >= 4
    assert not any("misfit" in told for told in codes)


def test_no_reading_is_odd_because_the_prior_is_wide():
    """Where the truth lies at the prior mean the residuals have few large squares and many that are small; but one is
    that is 30 standard deviations off.
    """
    t = np.linspace(0, 1, 14)
    design = 15 * np.cos(np.pi * np.outer(t, np.arange(12)))
    sensitivity, random = np.sqrt(47) * design, np.random.default_rng(0)
    fitted = design @ np.linalg.solve(np.eye(12) + design.T @ design, design.T)
    chances = []
    for off in (0.0, 30.0):
        noise = random.standard_normal((300, 14)) + off * (np.arange(14) == 7)
        each = [Residuals.of(e - fitted @ e, sensitivity, 47, np.ones(14), np.arange(14)) for e in noise]
        chances.append(np.array([residuals.outlier[1] for residuals in each]))
    right, wrong = chances
    assert np.mean(right < 0.05) < 0.05
    assert wrong.max() < 0.01
