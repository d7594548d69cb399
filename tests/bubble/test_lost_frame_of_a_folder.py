"""A folder of bubbles, one of which has a frame twice, by the two commands of a user; another solver made them."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from init_files import call
from oracle_full import Bubble

TWICE, SIMPLER = 1, ("model.vapour=none", "model.medium_heat=cold")


def filmed(folder):
    """Three bubbles of one gel; of one the frame at the first collapse stands twice, and the others are numbered on."""
    rng = np.random.default_rng(31)
    for i, (R_max, ratio) in enumerate(((270e-6, 6.5), (300e-6, 6.0), (240e-6, 7.0))):
        times = (np.arange(58) + rng.uniform(0.2, 0.8)) * 1.83e-6
        radius = Bubble(8e3, 0.09, R_max, R_max / ratio, vapour="none", conducting=False, nodes=14).solve(times)
        radius = radius + 0.01 * R_max * rng.standard_normal(len(times))
        if i == TWICE:
            k = int(np.argmin(radius[:25])) + 1
            radius = np.insert(radius, k, radius[k - 1])
        rows = [f"{1.83 * k:.4f},{1e6 * r:.3f}" for k, r in enumerate(radius)]
        (folder / f"b{i}.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))


@pytest.mark.slow
def test_the_bubble_is_named_by_itself_and_beside_the_value_of_the_gel(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gel").mkdir()
    filmed(tmp_path / "gel")
    assert call("init", "--data", "gel").exit_code == 0
    done = call("run", "gel.yaml", *(part for change in SIMPLER for part in ("--set", change)))
    assert done.exit_code == 0, done.output
    (told,) = (line for line in done.output.splitlines() if "lost-frame" in line and line.startswith("warning"))
    assert told.startswith(f"warning: the population and b{TWICE}: after the reading at ")
    assert "too late, as if a frame was counted twice" in told
    assert "leave this recording out" in told
    words = "Counted only as far as the others bear them out, since warnings say that their readings are wrong"
    assert f"{words}: b{TWICE}." in done.output
    rows = list(csv.DictReader((tmp_path / "runs/gel/summary.csv").read_text().splitlines()))
    spoilt = {row["dataset"] for row in rows if row["name"] == "G" and "lost-frame" in row["untrusted"]}
    assert spoilt == {f"b{TWICE}"}
    for page in ("report.html", "population.html"):
        assert "as if a frame was counted twice" in (tmp_path / "runs/gel" / page).read_text()
