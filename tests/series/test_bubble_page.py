"""The page of a bubble followed in time, of the shipped synthetic readings."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import xarray as xr
import yaml

import en4dvar

CONFIGS = Path(__file__).parents[2] / "configs"


def test_the_state_of_a_bubble_has_symbols_and_units_that_suit_its_size(tmp_path: Path) -> None:
    config = yaml.safe_load((CONFIGS / "bubble_sequence.yaml").read_text())
    config["data"] = yaml.safe_load((CONFIGS / "laser_varying.yaml").read_text())["data"]
    config["data"] |= {"path": str(CONFIGS / "data" / "laser_halved.csv"), "window": {"to": "12 us"}}
    config["parameters"] |= {"R_eq": "35 um"}
    config |= {"assimilation": {"scheme": "etkf", "members": 12}, "output": {"directory": str(tmp_path / "run")}}
    result = en4dvar.run_sequence(config)
    page = (tmp_path / "run" / "report.html").read_text()
    table = page.partition("State and parameters at the end")[2].partition("</table>")[0]
    rows = [re.findall(r">([^<>]*(?:<[isu/][^<>]*>[^<>]*)*)</td>", row) for row in table.split("<tr>")[2:]]
    shown = {re.sub("<[^>]*>", "", row[0]): row[-1].removesuffix("</td>") for row in rows}
    assert shown == {"R": "µm", "Ṙ": "m/s", "pb": "kPa", "S": "kPa", "G": "kPa", "μ": "Pa·s", "Rmax": "µm"}
    assert all("<i>" in row[0] for row in rows)
    lines = [line.split(",") for line in (tmp_path / "run" / "summary.csv").read_text().splitlines()[1:]]
    units = {"R": "um", "Rdot": "m/s", "p_b": "kPa", "S": "kPa", "G": "kPa", "mu": "Pa s", "R_max": "um"}
    assert {line[0]: line[-1] for line in lines} == units
    with xr.open_dataset(tmp_path / "run" / "sequence.nc") as data:
        modulus = [float(data[f"analysis_{what}"].sel(state="G")[-1]) for what in ("mean", "std")]
    of_csv = next(line[1:3] for line in lines if line[0] == "G")
    assert [1e3 * float(value) for value in of_csv] == pytest.approx(modulus, rel=1e-4)
    assert re.search(r"^G +\S+ +\S+ +kPa$", str(result), re.M)
