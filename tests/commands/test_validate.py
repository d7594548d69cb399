"""``en4dvar validate``: every fault of file and data at once, in place; what a run costs; the prior over the data."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from toy_config import csv_text, write_toy
from toy_models import Fragile

import en4dvar
from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.commands.describe import cost_summary
from en4dvar.config import load_config
from en4dvar.descent.preview import preview
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.state import Array
from en4dvar.report.history import prior_predictive
from en4dvar.runs.checks import validate

ROOT = Path(__file__).resolve().parents[2]


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_every_fault_is_told_at_once_and_in_place(tmp_path: Path) -> None:
    path = write_toy(
        tmp_path, ("seed: 3", "sede: 3"), ("members: 8", "members: one"), ("toy.csv", "toi.csv"), ("log_std", "logstd")
    )
    done = call("validate", path)
    assert done.exit_code == 2
    found = [line.removeprefix(f"{path}:").split(": ", 2)[:2] for line in done.stderr.splitlines()]
    assert found == [
        ["2:1", "sede"],
        ["4:9", "data.path"],
        ["14:40", "parameters.k.logstd"],
        ["17:12", "assimilation.members"],
    ]
    assert "toi.csv: no such file; the folder holds toy.csv" in done.stderr
    assert done.stdout == ""


def test_priors_of_many_files_are_one_table(tmp_path: Path) -> None:
    """A row a data set only where a value comes from the data; ``A`` is the maximum of each."""
    path = write_toy(tmp_path, ("toy.csv", "'*.csv'"))
    (tmp_path / "toy2.csv").write_text("t_ms,x_um\n" + "\n".join(f"{5 * i},{300 - 2 * i}" for i in range(25)))
    printed = call("validate", path).stdout
    assert printed.count("estimated  data set") == 1
    rows = [line.split()[:2] for line in printed.partition("estimated  ")[2].partition("\n\n")[0].splitlines()[1:]]
    assert [row for row in rows if row[0] == "A"] == [["A", "toy"], ["A", "toy2"]]
    assert [row for row in rows if row[0] == "k"] == [["k", "all"]]


def test_a_fault_of_the_model_does_not_hide_those_of_the_data(tmp_path: Path) -> None:
    path = write_toy(tmp_path, ("mass: 2 g", "law: cubik"), ("unit: um", "unit: Pa"))
    done = call("validate", path)
    assert [line.split(": ")[1] for line in done.stderr.splitlines()] == ["data.columns.position.unit", "model.law"]


def test_faults_of_several_data_files(tmp_path: Path) -> None:
    """They are told; files that can be used are gone on with, as by a run."""
    path = write_toy(tmp_path, ("toy.csv", "'*.csv'"))
    (tmp_path / "odd.csv").write_text("a,b\n1,2\n")
    (tmp_path / "short.csv").write_text("t_ms,x_um\n0,1\n")
    done = call("validate", path, "--plot", "--set", f"output.directory={tmp_path}/runs/toy")
    assert done.exit_code == 0, done.output
    assert "from 1 data set" in done.stdout
    assert (tmp_path / "runs" / "toy_prior.png").exists()
    head, *faults = done.stderr.splitlines()
    assert head == "warning: a run goes on with 1 data set, without those that cannot be used:"
    assert [line.startswith(f"{path}:4:9: data.path: {tmp_path}") for line in faults] == [True, True]
    assert "odd.csv: no column 'x_um'" in done.stderr
    assert "short.csv: 1 usable observations" in done.stderr
    alone = call("validate", path, "--set", "data.path=[odd.csv, short.csv]")
    assert alone.exit_code == 2
    assert alone.stdout == ""
    assert len(alone.stderr.splitlines()) == 2
    with pytest.raises(en4dvar.ConfigError) as caught:
        en4dvar.validate(path, {"seed": -1})
    assert len(caught.value.problems) == 3
    assert en4dvar.validate(path, {"data.path": "toy.csv"}).name == "toy"


def test_a_prior_that_does_not_suit_the_data(tmp_path: Path) -> None:
    path = write_toy(tmp_path, ("A: {prior: normal, mean: maximum, std: 1 %}", "A: {from_file: A, unit: um}"))
    done = call("validate", path)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"{path}:13:6: parameters.A: ")
    assert "no scalar 'A'" in done.stderr


def test_the_cost_is_that_of_a_run(tmp_path: Path) -> None:
    """Typical numbers of runs, where nothing is left in doubt: within a factor of two of what these runs took."""
    for path in (write_toy(tmp_path), ROOT / "configs" / "quickstart.yaml"):
        done = call("validate", path)
        assert done.exit_code == 0, done.output
        pattern = r"^cost: about (\d+)(?: to \d+)? forward runs, ([\d.]+) (us|ms) each: "
        told = re.search(pattern, done.stdout, re.MULTILINE)
        assert told
        options = {"output.directory": str(tmp_path / "run"), "output.report": False}
        took = en4dvar.run(path, overrides=options, force=True).sample_stats.attrs["forward_runs"]
        assert 0.5 < int(told[1]) / took < 2
        assert float(told[2]) > 0
        sampled = "the most where a doubt is sampled" in done.stdout
        assert sampled == (path.name == "quickstart.yaml")  # the toy is not cheap
    two = tmp_path / "two.csv"
    two.write_text(csv_text(k=1.9))
    done = call("validate", write_toy(tmp_path), "--data", tmp_path / "t*.csv")
    told = re.search(r"cost: about (\d+) forward runs a data set, [\d.]+ .s each; in all (\d+), ", done.stdout)
    assert told
    assert int(told[2]) == pytest.approx(2 * int(told[1]), rel=0.05)


@pytest.mark.slow
def test_the_cost_of_a_doubt_is_told() -> None:
    """The larger number is, for a data set, within a factor of two of the runs of one that is sampled in doubt."""
    config = load_config(ROOT / "configs" / "combined_laser.yaml")
    problem = build(config)[0]
    words = cost_summary(config, preview(problem, config.assimilation, config.seed), 10)
    pattern = r"cost: about \d+ to (\d+) forward runs a data set, [\d.]+ .s each; in all \d+ to (\d+), .+"
    told = re.fullmatch(pattern, words)
    assert told
    analysis = assimilate(problem, config.assimilation, config.seed)
    assert "importance_draws" in analysis.refinement
    assert 0.5 < int(told[1]) / analysis.forward_runs < 2
    assert int(told[2]) == pytest.approx(10 * int(told[1]), rel=0.1)


def test_the_plot_is_written_where_the_run_will_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = call("validate", write_toy(tmp_path), "--plot")
    assert done.exit_code == 0, done.output
    assert done.stdout.rstrip().endswith("prior predictive: runs/toy_prior.png and .pdf")
    assert Path("runs/toy_prior.png").read_bytes().startswith(b"\x89PNG")
    assert Path("runs/toy_prior.pdf").read_bytes().startswith(b"%PDF")
    assert call("run", "toy.yaml", "--no-report").exit_code == 0  # the run directory is still free


def test_what_the_figure_shows(tmp_path: Path) -> None:
    config = load_config(write_toy(tmp_path))
    (problem,) = build(config)
    one = preview(problem, config.assimilation, config.seed)
    assert one.run.path.shape == (8, len(problem.observations))  # the model is not dense
    ((panel,),) = (row.panels for row in prior_predictive([one]).rows)
    assert panel.ylabel == "position $x$ (µm)"
    band = next(mark for mark in panel.marks if mark.kind == "band")
    assert band.top.max() == pytest.approx(1e6 * member_quantiles(one.run.path, 0.95, axis=0).max(), rel=1e-9)
    assert sum(len(row.panels) for row in prior_predictive([one] * 9).rows) == 6


def test_a_prior_far_from_the_data_and_lost_members_are_told(tmp_path: Path) -> None:
    done = call("validate", write_toy(tmp_path, ("3 N/m, log_std: 0.3", "300 N/m, log_std: 0.03")))
    assert done.exit_code == 0
    assert re.search(r"warning: toy: \d+ % of the observations lie outside everything", done.stderr)
    done = call("validate", write_toy(tmp_path, ("toy_models:Oscillator", "toy_models:Fragile")))
    assert "warning: toy: 8 of 8 prior members cannot be run, e.g.: ArithmeticError: no step succeeds" in done.stderr
    assert "lie outside" not in done.stderr  # of nothing


def test_a_model_is_not_asked_for_doubts_beside_no_member(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def doubts(self: Fragile, name: str, times: Array, values: Array, predicted: Array, members: object) -> list[str]:
        return ["too large"] if np.ptp(predicted) > 1e9 else []

    monkeypatch.setattr(Fragile, "doubts", doubts)
    done = call("validate", write_toy(tmp_path, ("toy_models:Oscillator", "toy_models:Fragile")))
    assert done.exit_code == 0, done.output


def test_a_slow_model_is_not_run_in_full_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(write_toy(tmp_path))
    (problem,) = build(config)
    monkeypatch.setattr("en4dvar.descent.preview.LONGEST", 0.0)
    monkeypatch.setattr("en4dvar.descent.preview.ENOUGH", 0.0)
    assert len(preview(problem, config.assimilation, 3).run.failures) == 1
    assert len(preview(problem, config.assimilation, 3, whole=True).run.failures) == 8


def test_a_twin_experiment_has_nothing_to_plot() -> None:
    twin = ROOT / "configs" / "linear_etkf.yaml"
    assert call("validate", twin).exit_code == 0
    assert call("validate", twin, "--plot").exit_code == 2
    assert isinstance(validate(twin), en4dvar.TwinConfig)
