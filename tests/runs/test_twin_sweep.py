"""Sweeps of twin experiments: the table, what is kept and taken over, faults."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
from click.testing import CliRunner
from twin_models import Ring

import en4dvar
from en4dvar.cli import main
from en4dvar.config import load_twin
from en4dvar.plumbing.errors import ConfigError, En4dvarError, OutputError, TooFewMembersError
from en4dvar.runs.interrupt import Interrupted
from en4dvar.series.twin import conduct

CONFIG = {
    "name": "ring",
    "seed": 4,
    "model": {"name": "twin_models:Ring"},
    "twin": {
        "cycles": 12,
        "burn_in": 3,
        "interval": 0.5,
        "error": {"x_std": 0.5},
        "initial_std": {"x": 0.3, "v": 0.3},
    },
    "assimilation": {"scheme": "etkf", "members": 8},
}
VARY = {"assimilation.scheme": ["etkf", "esrf"], "assimilation.inflation": "[1.0, 1.1]"}


def sweep(out, **options):
    return en4dvar.sweep_twin(CONFIG, VARY, out=out, **{"seeds": 3, "workers": 1} | options)


def test_averages_are_those_of_the_runs(tmp_path):
    found = sweep(tmp_path / "a")
    assert found.values == (("etkf", 1.0), ("etkf", 1.1), ("esrf", 1.0), ("esrf", 1.1))
    assert found.seeds == (4, 5, 6)
    changes = {"assimilation.scheme": "esrf", "assimilation.inflation": 1.1}
    experiment = load_twin(CONFIG, changes).experiment
    rmse = [conduct(experiment, seed).scores["analysis"].mean_rmse for seed in (4, 5, 6)]
    row = found.rows[-1]
    assert (row["assimilation.scheme"], row["estimate"], row["runs"]) == ("esrf", "analysis", 3)
    assert row["rmse"] == np.mean(rmse)
    assert row["rmse_error"] == pytest.approx(np.std(rmse, ddof=1) / np.sqrt(3))
    with open(tmp_path / "a" / "runs.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    own = [float(line["rmse"]) for line in lines if line["assimilation.scheme"] == "esrf"
           and line["assimilation.inflation"] == "1.1" and line["estimate"] == "analysis"]  # fmt: skip
    assert own == rmse
    assert str(found).splitlines()[0].split() == ["scheme", "inflation", "estimate", "runs", "RMSE", "spread"]
    decimals = {len(a) - len(b) for a, b in re.findall(r"\.(\d+) ± \d+\.(\d+)", str(found))}
    assert decimals == {0}  # "0.227 ± 0.0022"


def test_interrupted_resumed_and_extended(tmp_path):
    quiet = sweep(tmp_path / "quiet", seeds=4)
    Ring.calls, Ring.stop_at = 0, 150
    with pytest.raises(Interrupted, match="the finished runs are kept in"):
        sweep(tmp_path / "a")
    Ring.calls = Ring.stop_at = 0
    told = []
    again = sweep(tmp_path / "a", seeds=4, resume=True, progress=lambda done, of: told.append((done, of)))
    assert 4 <= told[0][0] < 12
    assert told[-1] == (16, 16)
    assert again.runs == quiet.runs
    assert (tmp_path / "a" / "sweep.csv").read_bytes() == (tmp_path / "quiet" / "sweep.csv").read_bytes()
    Ring.calls = 0
    sweep(tmp_path / "a", seeds=4, resume=True)
    assert Ring.calls == 0
    with pytest.raises(OutputError, match="not empty"):
        sweep(tmp_path / "a")


@pytest.mark.slow  # two processes begin
def test_workers_do_not_change_the_bits(tmp_path):
    assert sweep(tmp_path / "one", seeds=1).runs == sweep(tmp_path / "two", seeds=1, workers=2).runs


@pytest.mark.parametrize("kind", [TooFewMembersError, MemoryError])
def test_a_run_that_fails_ends_no_sweep(tmp_path, monkeypatch, kind):
    def fail(experiment, seed):
        if seed == 5 or experiment.sequential.inflation.multiplicative > 1:
            raise kind("all are lost")
        return conduct(experiment, seed)

    monkeypatch.setattr("en4dvar.runs.twin_sweep.conduct", fail)
    found = sweep(tmp_path / "a")
    assert [(row["runs"], row["failed"]) for row in found.rows if row["estimate"] == "analysis"] == [
        (2, 1), (0, 3), (2, 1), (0, 3)
    ]  # fmt: skip
    assert "all are lost" in (tmp_path / "a" / "runs.csv").read_text()
    assert "esrf, 1.0, seed 5: " in (tmp_path / "a" / "run.log").read_text()
    assert "2 (1 failed)" in str(found)


def test_a_sweep_whose_runs_all_fail_ends_with_the_first_reason(tmp_path, monkeypatch):
    def fail(experiment, seed):
        raise TooFewMembersError(f"all are lost with seed {seed}")

    monkeypatch.setattr("en4dvar.runs.twin_sweep.conduct", fail)
    with pytest.raises(En4dvarError, match="all 12 runs failed, the first: all are lost with seed 4"):
        sweep(tmp_path / "a")


def test_warnings_of_single_runs_are_told(tmp_path):
    path = tmp_path / "ring.yaml"
    path.write_text(str(CONFIG))
    vary = ["--vary", "assimilation.inflation=[0.5, 1.0]", "--seeds", "2", "--workers", "1"]
    told = CliRunner().invoke(main, ["sweep-twin", str(path), *vary, "--out", str(tmp_path / "a")])
    assert told.exit_code == 0, told.output
    assert re.search(r"^0\.5 +analysis +2 \(2 doubted\)", told.stdout, re.MULTILINE)
    assert "warning: 2 of 4 runs, the first is 0.5, seed 4: the spread of the analysis is" in told.stderr
    with open(tmp_path / "a" / "runs.csv", newline="") as file:
        doubts = {(line["assimilation.inflation"], line["warnings"][:27]) for line in csv.DictReader(file)}
    assert doubts == {("0.5", "the spread of the analysis "), ("1.0", "")}


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({"assimilation.inflation": "1.1"}, r"--vary assimilation\.inflation: give a list of values, e\.g\."),
        ({"assimilation.inflation": []}, "give a list of values"),
        ({"assimilation.inflation": "[1, 2"}, r"--vary assimilation\.inflation:1:"),
        ({"assimilation.scheme": ["etkf", "best"]}, r"--set assimilation\.scheme.*'best' is not one of"),
        ({"assimilation.schema": ["etkf"]}, "unknown key 'schema'"),
        ({"assimilation.inflation": [1.1, 1.1]}, r"--vary assimilation\.inflation: 1\.1 occurs twice; .* --seeds"),
        ({"seed": [1, 2]}, r"^--vary seed: .* --seeds"),
        ({}, "at least one key to vary"),
    ],
)
def test_faults_are_told_before_any_run(tmp_path, vary, message):
    with pytest.raises(ConfigError, match=message):
        en4dvar.sweep_twin(CONFIG, vary, out=tmp_path / "a", workers=1)
    assert not (tmp_path / "a").exists()


def test_on_the_command_line(tmp_path):
    path = tmp_path / "ring.yaml"
    path.write_text(str(CONFIG))
    arguments = [
        "sweep-twin",
        path,
        "--vary",
        "assimilation.scheme=[etkf, climatology]",
        "--seeds",
        "2",
        "--workers",
        "1",
    ]
    told = CliRunner().invoke(main, [str(a) for a in (*arguments, "--out", tmp_path / "a")])
    assert told.exit_code == 0, told.output
    assert "climatology  analysis  2 " in told.stdout
    assert f"averages: {tmp_path / 'a' / 'sweep.csv'}" in told.stdout
    assert "4 of 4 runs" in told.stderr
    wrong = CliRunner().invoke(main, ["sweep-twin", str(path), "--vary", "members"])
    assert wrong.exit_code == 2
    assert "'members' is not KEY=VALUE" in wrong.stderr
