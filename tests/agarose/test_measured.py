"""The study's calibration that benchmarks measured: what it says is asserted here, in its documentation, too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import study_population
import study_reliability
from study_population import coverage
from study_reliability import bins, reliability


def test_bins_by_hand():
    difference = np.log(np.array([0.55, 0.58, 0.8, 0.8, 0.8]) / np.array([0.45, 0.42, 0.2, 0.2, 0.2]))
    difference *= np.array([1, -1, 1, 1, -1])
    made_by_quadratic = np.array([True, True, True, False, False])
    low, high = bins(difference, made_by_quadratic)
    assert (low.count, high.count) == (2, 3)
    assert low.stated == pytest.approx(0.565)
    assert (low.right, high.right) == pytest.approx((0.5, 2 / 3))
    assert high.error == pytest.approx(np.sqrt(3 * 0.16) / 3)


def test_model_probabilities_of_the_papers_experiment_are_calibrated():
    difference, quadratic = reliability("paper")
    assert len(difference) >= 200
    assert np.mean(quadratic) == pytest.approx(0.5, abs=0.01)
    for b in bins(difference, quadratic):
        assert abs(b.right - b.stated) < 2 * b.error, b


def test_an_experiment_that_decides():
    difference, quadratic = reliability("deciding")
    assert len(difference) >= 100
    assert np.mean((difference > 0) == quadratic) >= 0.95
    assert np.mean(np.abs(difference) < 3) < 0.05


def test_population_means_are_covered():
    """95 % intervals: 18 or more of the first 20 campaigns hold the true mean, and a share of all that fits 95 %."""
    rows = coverage()
    assert len(rows) == 8
    for c in rows:
        assert c.campaigns >= 20
        assert c.of_first >= 18, c
        assert c.held / c.campaigns > 0.95 - 2.5 * c.error, c
        assert c.of_drawn / c.campaigns > 0.95 - 2.5 * c.error, c


def test_the_documentation_shows_these_tables():
    page = Path(__file__).resolve().parents[2] / "docs" / "agarose_study.md"
    text = page.read_text(encoding="utf-8")
    for line in study_population.table() + study_reliability.table():
        assert line in text.splitlines()
