"""A short series of readings of :mod:`linear_drift`, one of them missing, with its configuration and its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

TIMES = np.array([0.2, 0.5, 1.1, 1.3, 2.0, 2.2, 3.1])
VALUES = np.array([0.3, 0.1, np.nan, 0.9, 1.4, 0.8, 2.0])
STD = 0.4  # of the readings

BASE = {
    "name": "drift",
    "seed": 3,
    "model": {"name": "linear_drift:Drift"},
    "data": {
        "path": "drift.csv",
        "columns": {"time": {"name": "t", "unit": "1"}, "x": {"name": "x", "unit": "1"}},
        "error": {"x_std": STD},
    },
    "parameters": {"c": {"prior": "normal", "mean": 0.5, "std": 0.3}},
    "sequence": {"initial_std": {"x": 0.5}},
    "model_error": {"x": {"std": 0.2, "every": 0.5}},
    "assimilation": {"scheme": "etkf", "members": 8},
    "output": {"report": False},
}


def write_readings(folder: Path) -> None:
    """The readings as ``drift.csv``."""
    rows = "".join(f"{t},{'' if np.isnan(v) else v}\n" for t, v in zip(TIMES, VALUES, strict=True))
    (folder / "drift.csv").write_text(f"t,x\n{rows}")


def write(folder: Path) -> Path:
    """Readings and configuration; returns the path of the latter."""
    write_readings(folder)
    (folder / "drift.yaml").write_text(yaml.safe_dump(BASE))
    return folder / "drift.yaml"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where we are: the readings as ``drift.csv``."""
    write_readings(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path
