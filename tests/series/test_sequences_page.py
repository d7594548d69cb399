"""The page "Follow a series in time" does what it says, and its spread covers the truth."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from en4dvar.assembly.build import build_sequence
from en4dvar.config import load_sequence
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.runs.checks import validate
from en4dvar.series.problem import assimilate_series

PAGE = (Path(__file__).parents[2] / "docs" / "sequences.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"```(?:python|yaml)\n# ([\w.]+)\n(.*?)```", PAGE, re.S))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    runpy.run_path("make_l63.py")


def covered(moments, truth):
    return np.mean(np.abs(moments.mean - truth)[:, :3] <= 2 * moments.std[:, :3], axis=0)


def test_the_spread_covers_the_truth():
    assert set(FILES) == {"make_l63.py", "l63.yaml", "from_arrays.py"}
    config = validate("l63.yaml")
    result = assimilate_series(build_sequence(config), config.seed)
    truth = np.loadtxt("truth.csv", delimiter=",")[:, 1:]
    shares = covered(result.run.smoothed, truth)
    assert np.all((shares >= 0.9) & (shares <= 0.99))
    assert f"in {100 * shares.mean():.0f} of 100" in PAGE
    mean, std = (float(values[-1, 4]) for values in (result.run.analysis.mean, result.run.analysis.std))
    assert f"ρ ends at {mean:.2f} ± {std:.2f}" in PAGE
    assert abs(mean - 28.5) < 2.5 * std


@pytest.mark.parametrize("scheme", [{"scheme": "etkf", "members": 20, "inflation": 1.01},
                                    {"scheme": "enkf-n", "members": 20},
                                    {"scheme": "ienks", "members": 20, "lag": 3, "mda_weights": [1, 1, 1],
                                     "inflation": 1.01}], ids=str)  # fmt: skip
def test_every_scheme_covers_it(scheme):
    config = load_sequence("l63.yaml", {"assimilation": scheme})
    result = assimilate_series(build_sequence(config), config.seed)
    truth = np.loadtxt("truth.csv", delimiter=",")[:, 1:]
    assert covered(result.run.analysis, truth).mean() > 0.87
    assert np.sqrt(np.nanmean(result.normalised**2)) == pytest.approx(1, abs=0.15)


def test_a_share_of_what_changes_its_sign_is_told_with_what_to_write():
    config = load_sequence("l63.yaml", {"sequence.initial_std": {"x": "10 %", "y": 1, "z": 1}})
    with pytest.raises(
        TooFewMembersError, match=r"x is not positive, and .* logarithm: give its initial_std in its unit"
    ):
        assimilate_series(build_sequence(config), config.seed)


def test_from_arrays(capsys):
    result = runpy.run_path("from_arrays.py")["result"]
    mean, std = (float(moment[-1, 4]) for moment in (result.run.analysis.mean, result.run.analysis.std))
    assert f"ρ ends at {mean:.2f} ± {std:.2f} here" in PAGE
    assert abs(mean - 28.5) < 2.5 * std
    assert np.sqrt(np.nanmean(result.normalised**2)) == pytest.approx(1, abs=0.15)
    assert "innovations over their spread" in capsys.readouterr().out
