"""Chances of residuals: uniform where the model is right, against draws, and small where they have a structure."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.provoked import bent, run, spiked
from scipy.special import digamma, fdtrc, fdtri
from toys import with_discrepancy

from en4dvar.diagnosis.honesty.checks import fit
from en4dvar.diagnosis.residuals import Residuals, positive_chance
from en4dvar.report.page import judge_chi2

K = 20


def designed():
    sensitivity = np.sqrt(45) * np.vstack([np.cos(np.linspace(0, 2, K) * j) for j in range(4)]).T
    expected = np.eye(K) - sensitivity @ np.linalg.solve(47 * np.eye(4) + sensitivity.T @ sensitivity, sensitivity.T)
    return sensitivity, np.linalg.cholesky(expected)


def looked_at(white, sensitivity):
    return Residuals.of(white, sensitivity, 47, np.linspace(0, 1, K) ** 2, np.arange(K))


def test_chances_are_uniform_where_the_model_is_right():
    sensitivity, root = designed()
    rng = np.random.default_rng(0)
    found = [looked_at(root @ rng.standard_normal(K), sensitivity) for _ in range(600)]
    for chances in ([r.lag_one_chance for r in found], [r.collapse_chance for r in found]):
        for level in (0.1, 0.5, 0.9):
            assert np.mean(np.array(chances) < level) == pytest.approx(
                level, abs=4 * np.sqrt(level * (1 - level) / 600)
            )
    for chances in ([r.runs_chance for r in found], [r.outlier[1] for r in found]):  # never too often
        assert np.mean(np.array(chances) < 0.05) < 0.09


def test_weights_make_no_reading_odd():
    """Residuals times √β were judged: of 40 readings of weights from 0.1 to 10 one was odd in a fourth of the fits."""
    rng = np.random.default_rng(4)
    weights = np.exp(rng.normal(0, 1.5, K))
    plain = designed()[0] / np.sqrt(47)
    sensitivity = np.sqrt(47 * weights)[:, None] * plain
    fitted = sensitivity @ np.linalg.solve(47 * np.eye(4) + sensitivity.T @ sensitivity, sensitivity.T)
    found = []
    for _ in range(300):
        y = np.sqrt(weights) * (plain @ rng.standard_normal(4) + rng.standard_normal(K))
        about = np.linspace(0, 1, K) ** 2, np.arange(K)
        found.append(Residuals.of(y - fitted @ y, sensitivity, 47, *about, weights=weights))
    drawn = np.array([r.white for r in found])
    assert np.mean(drawn**2, axis=0) == pytest.approx(np.diag(found[0].expected), rel=0.35)
    size = np.array([r.studentised for r in found])
    told = np.flatnonzero(size[0] != 0)
    assert np.mean(size[:, told] ** 2) == pytest.approx(1, abs=0.06)
    for chances in ([r.lag_one_chance for r in found], [r.collapse_chance for r in found]):
        assert np.mean(np.array(chances) < 0.1) == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 300))
    assert np.mean([r.outlier[1] < 0.05 for r in found]) < 0.09


def test_a_fit_of_small_weights_is_no_misfit():
    """`weights: mean`: the prior holds the fit, so that χ² is larger. One of 20 right fits was called a misfit here."""
    rng, k = np.random.default_rng(6), 50
    weights, times = np.full(k, 1 / k), np.linspace(0.2, 2, k)
    plain = 2.0 * np.column_stack([times, times**2])
    sensitivity = np.sqrt(47 * weights)[:, None] * plain
    fitted = sensitivity @ np.linalg.solve(47 * np.eye(2) + sensitivity.T @ sensitivity, sensitivity.T)
    squares = []
    for _ in range(2000):
        y = np.sqrt(weights) * (plain @ rng.standard_normal(2) + rng.standard_normal(k))
        found = Residuals.of(y - fitted @ y, sensitivity, 47, times, np.arange(k), weights=weights)
        squares.append(found.white @ found.white)
    factor, degrees = found.chi2_like
    assert np.mean(squares) == pytest.approx(factor * degrees, rel=0.03)
    assert np.var(squares) == pytest.approx(2 * factor**2 * degrees, rel=0.15)
    assert factor * degrees > 1.2 * (k - found.dfs)
    told = [[c.code for c in fit(square, k, k - degrees, factor)] for square in squares]
    assert sum(map(bool, told)) < 20  # of 2 expected of a χ²; its tail is heavier
    assert sum(bool([*fit(square, k, found.dfs)]) for square in squares) > 60
    assert found.runs_chance == 1


def test_imhof_of_few_numbers():
    assert positive_chance(np.array([1.0, -1.0])) == pytest.approx(0.5, abs=1e-6)
    assert positive_chance(np.array([1.0, 1.0, -1.0])) == pytest.approx(np.sqrt(0.5), abs=1e-4)


def test_imhof_against_draws():
    weights = np.random.default_rng(1).standard_normal(12)
    z = np.random.default_rng(2).standard_normal((200_000, 12))
    assert positive_chance(weights) == pytest.approx(np.mean(z**2 @ weights > 0), abs=0.004)


@pytest.mark.parametrize("count", [6, 300, 500])
@pytest.mark.parametrize("ratio", [0.9, 1.0, 1.3])
def test_imhof_against_the_distribution_of_a_ratio_of_squares(count, ratio):
    weights = np.repeat([1.0, -ratio], [count // 2, count - count // 2])
    assert positive_chance(weights) == pytest.approx(fdtrc(count / 2, count / 2, ratio), abs=1e-4)


@pytest.mark.parametrize("chance", [1e-2, 1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("counts", [(2, 1), (3, 2), (8, 8), (2, 40), (250, 250)])
def test_imhof_of_what_is_improbable(counts, chance):
    """Below 1e-6 stood where it was 1e-5, and with two directions left no chance was below 0.02."""
    more, less = counts
    weights = np.repeat([1 / more, -fdtri(more, less, 1 - chance) / less], counts)
    assert positive_chance(weights) == pytest.approx(chance, rel=0.02, abs=2e-6)


def test_leverages_add_up_to_the_degrees_of_freedom():
    analysis = run(bent())
    assert analysis.residuals is not None
    assert analysis.residuals.leverage.sum() == pytest.approx(analysis.iterations[-1].dfs, rel=1e-9)
    squares = float(analysis.residuals.white @ analysis.residuals.white)
    assert squares / 40 == pytest.approx(analysis.iterations[-1].chi2_per_observation, rel=1e-9)


def test_a_reading_that_alone_tells_a_parameter_is_no_outlier():
    """Its residual is what the linearisation errs by, over as good as nothing."""
    sensitivity = np.zeros((K, 1))
    sensitivity[7] = 1e7
    white = np.random.default_rng(3).standard_normal(K)
    white[7] = 0.15
    found = looked_at(white, sensitivity)
    assert found.leverage[7] == pytest.approx(1)
    assert np.max(np.abs(found.studentised)) < 4
    assert found.outlier[0] != 7


def test_size_and_structure_are_told_apart():
    analysis = run(bent())
    codes = {c.code for c in analysis.cautions}
    assert "residual-structure" in codes
    assert "misfit" not in codes  # its size is as stated
    assert "agrees" in judge_chi2(1.0, 40, 2.0)[0]
    words, attention = judge_chi2(1.0, 40, 2.0, structured=True)
    assert "agrees" not in words
    assert attention


def test_no_scale_is_offered_as_a_cure_of_structure():
    problem = bent()
    problem.observations.std[:] *= 4
    cautions = {c.code: c for c in run(problem).cautions}
    assert "parameters.sigma" not in cautions["overstated-error"].advice
    assert "discrepancy" in cautions["overstated-error"].advice
    found = run(with_discrepancy(problem, amplitude=(0.05, 1.0), length=(0.3, 0.7)))
    (told,) = (c for c in found.cautions if c.code == "overstated-error")
    assert "parameters.sigma" in told.advice  # beside a discrepancy it is the cure


def test_a_discrepancy_takes_the_structure():
    analysis = run(with_discrepancy(bent(), amplitude=(0.05, 1.0), length=(0.3, 0.7), smoothness=1.5, sigma=0.7))
    assert "residual-structure" not in {c.code for c in analysis.cautions}
    found = analysis.discrepancy
    assert found is not None
    residual = analysis.observations.values - analysis.centre_predictions
    assert np.sum((residual - found.mean) ** 2) < 0.5 * np.sum(residual**2)
    assert found.shares.sum(axis=1) == pytest.approx(np.ones(5))
    assert np.all(found.shares > -1e-12)
    assert found.shares[0, 1] > 0.3  # most of what is left unknown of a is the discrepancy's


def test_an_outlier_is_named():
    """When the clock of its file says, which the model's need not be."""
    problem = spiked()
    late = replace(problem, observations=replace(problem.observations, zero=10.0))
    words = next(c.words for c in run(late).cautions if c.code == "odd-residuals")
    assert f"the reading at {problem.observations.times[12] + 10:.6g} s on the clock of the data" in words
    assert "than the scatter of the residuals explains (probability" in words  # and not than its own error does
    assert "by its own error it is" in words


def test_the_outlier_of_an_exact_fit_is_that_of_least_squares():
    """Two parameters fitted to rounding: Q has rank K − 2, and r²/(K − 2) of a residual is Beta(½, (K − 3)/2)."""
    from scipy.stats import beta

    design = np.vander(np.linspace(-1, 1, K), 2)
    y = np.random.default_rng(7).normal(size=K)
    y[4] += 6
    fit, (squares,) = np.linalg.lstsq(design, y)[:2]
    left = y - design @ fit
    own = 1 - np.sum(np.linalg.qr(design)[0] ** 2, axis=1)
    chance = K * beta.sf(left[4] ** 2 / own[4] / squares, 0.5, (K - 3) / 2)
    residuals = Residuals.of(left, 1e9 * design, 19, np.ones(K), np.arange(K))
    assert residuals.outlier == (4, pytest.approx(chance, rel=1e-6))


@pytest.mark.parametrize("freedom", [3.43, *(pytest.param(of, marks=pytest.mark.slow) for of in (12.0, 30.0)), 110.0])
@pytest.mark.parametrize("count", [8, pytest.param(30, marks=pytest.mark.slow), 100])
def test_a_right_reading_is_odd_no_more_often_than_told_where_the_size_of_the_errors_is_estimated(freedom, count):
    """A posterior of more squares than there are residuals holds these and what was known before; one of fewer, as
    beside a discrepancy, is of another size than that of the residuals, each of which may be larger than it allows.
    """
    rng, chances, squares = np.random.default_rng(11), [], 2 * np.exp(digamma(freedom / 2))
    for _ in range(1500):
        white = rng.standard_normal(count)
        before = freedom - count
        size = (rng.chisquare(before) + white @ white) / squares if before > 0 else rng.chisquare(freedom) / squares
        white /= np.sqrt(size)
        at = np.arange(count)
        chances.append(Residuals(white, np.zeros((count, 1)), np.ones(count), at, 0 * at, 0.0, freedom).outlier[1])
    assert 0.02 < np.mean(np.array(chances) < 0.05) < 0.07
    assert np.sum(np.array(chances) < 1e-3) <= 6


def test_a_reading_beyond_what_the_size_of_the_errors_allows_need_not_be_odd():
    white, at = np.full(31, 0.3), np.arange(31)
    for worst, odd in ((0.9, False), (2.66, True)):
        white[5] = worst
        residuals = Residuals(white, np.zeros((31, 1)), np.ones(31), at, 0 * at, 0.0, 3.43)
        assert (residuals.outlier[1] < 1e-3) == odd
        assert residuals.outlier[1] > 1e-12
