"""The page of a calibration writes quantities as other pages do."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from en4dvar.report.calibration import (
    COLUMNS,
    CURVES,
    ERRORS,
    Judged,
    curves,
    load_calibration,
    write_calibration,
    write_sets,
)

QUANTITIES = [("mu", "Pa s", r"$\mu$"), ("R_max", "um", r"$R_{\mathrm{max}}$"), (ERRORS, "1", "")]


def written(folder: Path) -> Path:
    """Forty sets whose truths all lie above the members."""
    numbers = np.array([[9.0, 1.0, 2.0, 3.0, 4.0, 2.5, 24.0]] * len(QUANTITIES))
    sets = [Judged(n, "a", numbers, 24) for n in range(1, 40)]
    write_sets(folder / "calibration.csv", QUANTITIES, [*sets, Judged(40, "a", failure="lost")])
    return write_calibration(folder)


@pytest.mark.parametrize("width", [2.0, 0.5])
def test_a_curve_means_what_its_caption_says(tmp_path: Path, width: float) -> None:
    """The words of intervals that are too wide stood beside the curve of too narrow ones."""
    places = norm.ppf((np.arange(400) + 0.5) / 400, scale=1 / width)  # of truths, the posterior being N(0, 1)
    ranks = np.round(24 * norm.cdf(places))
    sets = [Judged(n, "a", np.array([[0.0] * 6 + [rank]]), 24) for n, rank in enumerate(ranks)]
    write_sets(tmp_path / "calibration.csv", [("G", "Pa", "")], sets)
    (panel,) = curves(load_calibration(tmp_path)).rows[0].panels[:1]
    (curve,) = (mark for mark in panel.marks if mark.kind == "line")
    signs = ["below" if height < 0 else "above" for height in curve.y[[5, -5]]]
    assert (
        f"first {signs[0]}, then {signs[1]}: {'its intervals are too wide' if width > 1 else 'too narrow'}"
        in " ".join(CURVES.split())
    )


def test_quantities_have_their_symbols(tmp_path: Path) -> None:
    page = written(tmp_path).read_text()
    for words in ("<i>μ</i></td>", "<i>R</i><sub>max</sub></td>", "<li><i>μ</i>: values are too low", ">errors</td>"):
        assert words in page
    assert not re.search(r"\bmu\b", page.partition("<main>")[2])
    result = load_calibration(tmp_path)
    assert result.remarks[0].startswith("mu: values are too low")  # of the terminal
    assert [judged.failure for judged in result.sets if judged.failure] == ["lost"]


def test_a_table_of_an_earlier_version_has_names(tmp_path: Path) -> None:
    written(tmp_path)
    table = tmp_path / "calibration.csv"
    assert COLUMNS[-1] == "symbol"
    table.write_text("".join(f"{line.rpartition(',')[0]}\n" for line in table.read_text().splitlines()))
    assert "mu</td>" in write_calibration(tmp_path).read_text()
    assert dataclasses.asdict(load_calibration(tmp_path))["written"] == {}
