"""Warnings are part of the result: in the files, in the table, in the log and on the terminal."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from diagnosis.provoked import TWO, Violent, run
from run_files import configuration, make_campaign
from toy_config import csv_text, write_toy
from toys import make_problem

from en4dvar.cli import main
from en4dvar.report.result import Result, load_result
from en4dvar.runs.runner import run_campaign


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Two data sets with the noise they state, the second also with points far off the curve."""
    folder = tmp_path_factory.mktemp("campaign")
    path = make_campaign(folder, 2)
    title, header, *rows = csv_text(k=2.8).splitlines()
    times = [row.split(",")[0] for row in rows]
    x = np.array([float(row.split(",")[1]) for row in rows]) + np.random.default_rng(1).normal(0, 2.0, len(rows))
    for name, offset in (("set0", 0.0), ("set1", 30.0)):
        x[7:9] += offset
        lines = [f"{t},{value}" for t, value in zip(times, x, strict=True)]
        (folder / "data" / f"{name}.csv").write_text("\n".join([title, header, *lines, ""]))
    return run_campaign(configuration(path, folder / "run"))


def test_file_keeps_code_severity_words_and_advice(tmp_path):
    analysis = run(make_problem(Violent(TWO), (1.0, 0.5), k=9))
    assert analysis.cautions
    loaded = load_result(Result.from_analysis(analysis, {}).save(tmp_path / "posterior.nc"))
    assert loaded.cautions == analysis.cautions
    assert loaded.sample_stats.attrs["warning_codes"] == "model-validity"
    reached = loaded.sample_stats["y_reached"]
    assert reached.attrs["limit"] == 0.9
    assert reached.attrs["long_name"] == "largest excursion"
    assert np.array_equal(reached.values[0], analysis.extremes[:, 0])


def test_campaign_tells_them_by_data_set(campaign):
    good, bad = campaign.outcomes
    assert good.warnings == ()
    assert "misfit" in {c.code for c in bad.warnings}
    assert campaign["set1"].cautions == bad.warnings
    with xr.open_datatree(campaign.directory / "posterior.nc") as tree:
        stats = tree["sample_stats"]
        codes = dict(zip(stats["dataset"].values, stats["warning_codes"].values, strict=True))
    assert codes["set0"] == ""
    assert codes["set1"].split() == list(dict.fromkeys(c.code for c in bad.warnings))
    rows = list(csv.DictReader((campaign.directory / "summary.csv").read_text(encoding="utf-8").splitlines()))
    assert {r["dataset"]: r["warnings"] for r in rows} == codes
    log = (campaign.directory / "run.log").read_text(encoding="utf-8")
    assert f"set1: serious: {bad.warnings[0]}" in log


def test_terminal_tells_what_was_found_and_what_to_do(tmp_path):
    path = write_toy(tmp_path, ("median: 3 N/m", "median: 9 N/m"))
    told = CliRunner().invoke(main, ["run", str(path), "--out", str(tmp_path / "run"), "--no-report"])
    assert told.exit_code == 0
    assert "make the prior of k about " in told.stderr
    assert "times as wide (parameters.k) and say so [prior-conflict]" in told.stderr
