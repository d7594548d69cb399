"""The page of a calibration writes quantities as other pages do."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np

from en4dvar.report.calibration import COLUMNS, ERRORS, Judged, load_calibration, write_calibration, write_sets

QUANTITIES = [("mu", "Pa s", r"$\mu$"), ("R_max", "um", r"$R_{\mathrm{max}}$"), (ERRORS, "1", "")]


def written(folder: Path) -> Path:
    """Forty sets whose truths all lie above the members."""
    numbers = np.array([[9.0, 1.0, 2.0, 3.0, 4.0, 2.5, 24.0]] * len(QUANTITIES))
    sets = [Judged(n, "a", numbers, 24) for n in range(1, 40)]
    write_sets(folder / "calibration.csv", QUANTITIES, [*sets, Judged(40, "a", failure="lost")])
    return write_calibration(folder)


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
