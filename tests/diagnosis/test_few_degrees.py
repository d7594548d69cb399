"""What is told of residuals of few degrees of freedom beside errors of unknown size."""

import numpy as np
import pytest

import en4dvar
from en4dvar.diagnosis.residuals import Residuals

OF_RESIDUALS = {"misfit", "overstated-error", "odd-residuals", "residual-structure"}
STD = 0.2


def doubts(n, k, seed, within=True, outlier=0.0):
    """Codes of the warnings about the residuals of a sum of n cosines with k readings, and where one is off."""
    random, t = np.random.default_rng([seed, n, k]), np.linspace(0, 1, k)
    values = np.full(n, 0.5) if within else 3 * random.standard_normal(n)
    y = np.cos(np.pi * np.outer(t, np.arange(n))) @ values + STD * random.standard_normal(k)
    y[k // 3] += outlier * STD
    priors = {f"c{i}": {"prior": "normal", "mean": 0, "std": 3} for i in range(n)}
    estimated = en4dvar.estimate(
        lambda p, t: sum(p[f"c{i}"] * np.cos(i * np.pi * t) for i in range(n)),
        (t, y),
        priors | {"sigma": {"prior": "lognormal", "median": 1, "log_std": 1}},
        error=STD,
        seed=seed,
        progress=False,
    )
    stats = estimated.sample_stats
    return OF_RESIDUALS & set(stats.attrs["warning_codes"].split()), stats.attrs


@pytest.mark.parametrize(("n", "k"), [(12, 14), (6, 8), (8, 12)])
def test_where_all_is_right_nothing_is_doubted(n, k):
    """With the noise scale of the minimum, which is too small by the degrees of freedom that the fit uses up, half of
    such estimates were doubted.
    """
    for seed in range(6):
        codes, stats = doubts(n, k, seed, within=seed % 2 == 0)
        assert codes == set()
        assert stats["chi2_per_observation"] * k < 3 * (k - n)
        assert stats["dfs"] < n


@pytest.mark.parametrize(("n", "k"), [(3, 30), (10, 40)])
def test_a_reading_six_standard_deviations_off_is_told(n, k):
    """With its own error it is 4 to 8 off, and the fit takes a share of it."""
    codes = [doubts(n, k, seed, outlier=6.0)[0] for seed in range(6)]
    assert sum("odd-residuals" in told for told in codes) >= 4
    assert not any("misfit" in told for told in codes)


def test_no_reading_is_odd_because_the_prior_is_wide():
    """Where the truth lies at the prior mean the residuals have few large squares and many that are small."""
    t = np.linspace(0, 1, 14)
    design = 15 * np.cos(np.pi * np.outer(t, np.arange(12)))
    sensitivity, random = np.sqrt(47) * design, np.random.default_rng(0)
    fitted = design @ np.linalg.solve(np.eye(12) + design.T @ design, design.T)
    chances = []
    for _ in range(300):
        noise = random.standard_normal(14)
        chances.append(Residuals.of(noise - fitted @ noise, sensitivity, 47, np.ones(14), np.arange(14)).outlier[1])
    assert np.mean(np.array(chances) < 0.05) < 0.05
