"""Twin experiments on the command line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.config import load_config, load_twin
from en4dvar.plumbing.errors import ConfigError

YAML = """\
name: twin
seed: 4
model: {name: lorenz96, size: 12}
twin:
  cycles: 30
  burn_in: 10
  interval: 0.05
  error: {x_std: 1}
  initial_std: {x: 0.1}
assimilation:
  scheme: ienks
  lag: 2
  members: 15
  inflation: 1.02
"""


def call(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def write(folder: Path, *replacements: tuple[str, str]) -> Path:
    text = YAML
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "twin.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("twin")
    outcome = call("run", write(folder), "--out", folder / "run")
    assert outcome.exit_code == 0, outcome.output
    return folder / "run", outcome


def test_run_prints_and_writes_the_scores(finished):
    directory, outcome = finished
    with xr.open_dataset(directory / "twin.nc") as data:
        data.load()
    assert data.sizes == {"time": 30, "state": 13, "observation": 12}
    assert data.observation.values.tolist() == [f"x_{j}" for j in range(12)]
    assert data.observation_units.values.tolist() == ["1"] * 12
    error = (data.analysis_mean - data.truth)[:, :12]
    rmse = np.sqrt((error**2).mean("state"))
    assert np.allclose(rmse, data.analysis_rmse)
    shown = re.search(r"^analysis +(\S+) +(\S+)$", outcome.stdout, re.MULTILINE)
    assert shown
    assert float(shown[1]) == pytest.approx(float(rmse[10:].mean()), rel=1e-3)
    assert data.attrs["seed"] == 4
    assert data.attrs["configuration"] == YAML
    assert outcome.stdout.splitlines()[-2:] == [
        f"result: {directory / 'twin.nc'}",
        f"report: {directory / 'report.html'}",
    ]
    lines = (directory / "summary.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["estimate", "forecast", "analysis", "smoothed"]
    names = {p.name for p in directory.iterdir()}
    assert {"twin.nc", "summary.csv", "run.log", "config.yaml", "config.resolved.yaml"} <= names


def test_resolved_configuration_gives_the_same_result(finished, tmp_path):
    directory, outcome = finished
    again = call("run", directory / "config.resolved.yaml", "--out", tmp_path / "again", "--no-report")
    assert again.exit_code == 0, again.output
    assert again.stdout.splitlines()[:-1] == outcome.stdout.splitlines()[:-2]


@pytest.mark.slow
def test_report_again_from_the_file(finished):
    directory, _ = finished
    page = (directory / "report.html").read_text()
    for words in ("Twin experiment", "ienks", '<td class="words">smoothed</td>', "lag: 2", "10 of them do not count"):
        assert words in page
    assert "://" not in re.sub(r'<(pre|table class="pairs")>.*?</(pre|table)>', "", page, flags=re.DOTALL)
    (directory / "report.html").unlink()
    assert not (directory / "figures").exists()
    again = call("report", directory, "--figures")
    assert again.exit_code == 0, again.output
    assert (directory / "figures" / "scores.png").stat().st_size > 10_000
    assert call("report", directory).exit_code == 0
    damaged = (directory / "twin.nc").read_bytes()
    (directory / "twin.nc").write_bytes(damaged.replace(b"analysis", b"analisys", 1))
    refused = call("report", directory)
    assert refused.exit_code == 2
    assert "twin.nc" in refused.stderr
    (directory / "twin.nc").write_bytes(damaged)
    strip = lambda text: re.sub(r"20\d\d-\S+", "", text)  # noqa: E731
    assert strip((directory / "report.html").read_text()) == strip(page)


def test_interrupted_run_says_how_to_continue(tmp_path, monkeypatch):
    monkeypatch.setattr("en4dvar.runs.cycles.conduct", _interrupt)
    outcome = call("run", write(tmp_path), "--out", tmp_path / "run")
    assert outcome.exit_code == 130
    assert "to continue: en4dvar" in outcome.stderr
    assert outcome.stderr.rstrip().endswith("--resume")
    monkeypatch.undo()
    assert call("run", tmp_path / "twin.yaml", "--out", tmp_path / "run", "--resume", "--no-report").exit_code == 0
    assert not (tmp_path / "run" / "report.html").exists()
    assert call("run", tmp_path / "twin.yaml", "--out", tmp_path / "run", "--resume", "--force").exit_code == 2


def _interrupt(*_):
    raise KeyboardInterrupt


def test_run_directory_is_not_replaced_without_force(finished):
    directory, _ = finished
    path = directory / "config.yaml"
    refused = call("run", path, "--out", directory)
    assert refused.exit_code == 2
    assert "not empty" in refused.stderr
    assert call("run", path, "--out", directory, "--force", "--workers", "2", "--no-report").exit_code == 0


def test_validate(tmp_path):
    outcome = call("validate", write(tmp_path))
    assert outcome.exit_code == 0, outcome.output
    assert "ienks, 15 members, seed 4" in outcome.stdout
    assert "30 cycles every 0.05 (10 not counted), observed: x (std 1)" in outcome.stdout


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{x_std: 1}", "{x_sd: 1}", r"twin\.yaml:8:\d+: twin\.error\.x_sd: unknown key 'x_sd'; did you mean 'x_std'"),
        ("{x_std: 1}", "{x_std: 0}", r"twin\.yaml:8:\d+: twin\.error\.x_std: must be positive"),
        ("{x: 0.1}", "{x: 1 m}", r"twin\.yaml:9:\d+: twin\.initial_std\.x: "),
        ("interval: 0.05", "interval: -1", r"twin\.yaml:7:\d+: twin\.interval: must be positive"),
        ("burn_in: 10", "burn_in: 30", r"twin: burn_in \(30\) leaves none of 30 cycles"),
        ("scheme: ienks", "scheme: etkf", r"assimilation\.lag: scheme etkf does not read it; it is a key of ienks"),
        ("scheme: ienks", "scheme: best", r"twin\.yaml:11:\d+: assimilation\.scheme: 'best' is not one of etkf, denkf"),
        (
            "inflation: 1.02",
            "smoother: {method: enks}",
            r"twin\.yaml:11:\d+: assimilation: a smoother goes behind a filter that is cycled, not behind a smoother",
        ),
        ("inflation: 1.02", "smoother: {method: enrts, lag: 3}", r"twin\.yaml:14:\d+: .*lag: only with method enks"),
        ("inflation: 1.02", "smoother: {method: enks, lag: 0}", r"twin\.yaml:14:\d+: assimilation\.smoother\.lag: "),
        (
            "inflation: 1.02",
            "smoother: {method: rts}",
            r"twin\.yaml:14:\d+: assimilation\.smoother\.method: 'rts' is not",
        ),
        (
            "inflation: 1.02",
            "jitter: 0.1",
            r"twin\.yaml:14:\d+: assimilation\.jitter: scheme ienks does not read it; it is a key of particle-filter",
        ),
        (
            "scheme: ienks\n  lag: 2",
            "scheme: particle-filter\n  localisation: {radius: 2}",
            r"twin\.yaml:11:\d+: assimilation: .*it takes no localisation",
        ),
        (
            "scheme: ienks\n  lag: 2",
            "scheme: etkf\n  smoother: {method: enrts}\n  localisation: {radius: 2}",
            r"twin\.yaml:11:\d+: assimilation: .*scheme ienks smooths with it",
        ),
        ("model: {name: lorenz96, size: 12}", "model: {name: lorenz69}", r"unknown model 'lorenz69'; did you mean"),
        (
            "burn_in: 10",
            "error_correlation: c.csv",
            r"twin\.yaml:6:\d+: twin\.error_correlation: .*c\.csv: no such file",
        ),
        (
            "burn_in: 10",
            "error_correlation: two.csv",
            r"twin\.yaml:6:\d+: twin\.error_correlation: correlation \(2, 2\) does not match 12 observations",
        ),
        ("seed: 4", "sed: 4", r"twin\.yaml:2:1: sed: unknown key 'sed'; did you mean 'seed'"),
        ("seed: 4", "parameters: {F: {from_file: F, unit: '1'}}", r"parameters\.F: a twin experiment has no data file"),
    ],
)
def test_faults_are_located(tmp_path, old, new, message):
    path = write(tmp_path, (old, new))
    (tmp_path / "two.csv").write_text("1,0.5\n0.5,1\n")
    with pytest.raises(ConfigError, match=message):
        load_twin(path)
    outcome = call("validate", path)
    assert outcome.exit_code == 2


def test_localisation_needs_one_observed_field(tmp_path):
    path = write(
        tmp_path,
        ("{name: lorenz96, size: 12}", "{name: lorenz63}"),
        ("{x: 0.1}", "{x: 0.1, y: 0.1}"),
        ("scheme: ienks\n  lag: 2", "scheme: etkf\n  localisation: {radius: 2}"),
    )
    with pytest.raises(ConfigError, match=r"assimilation\.localisation: needs a model whose state is one field"):
        load_twin(path)


def test_other_commands_and_functions_say_what_it_is(tmp_path):
    path = write(tmp_path)
    with pytest.raises(ConfigError, match=r"twin\.yaml:4:1: twin: it makes the file a twin experiment, for"):
        load_config(path)
    assert call("simulate", path).exit_code == 2
    plain = tmp_path / "plain.yaml"
    plain.write_text("name: a\nmodel: {name: lorenz96}\nparameters: {F: 8}\n")
    with pytest.raises(ConfigError, match="twin: required, but not given; without it the file is for 'en4dvar run'"):
        load_twin(plain)
