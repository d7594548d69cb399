"""``en4dvar joint`` on finished runs of the toy oscillator."""

from __future__ import annotations

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from run_files import make_campaign
from same_bits import assert_same_groups
from toy_config import csv_text, write_toy

from en4dvar.cli import main
from en4dvar.plumbing.caution import caution, untrusted
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.report.result import load_result
from en4dvar.report.together import joint_lines
from en4dvar.results.together import load_joint
from en4dvar.runs.finished import carried
from en4dvar.runs.runner import run_campaign
from en4dvar.runs.together import SPOILT, join


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Three oscillators of one spring, whose amplitudes are their own."""
    folder = tmp_path_factory.mktemp("campaign")
    path = make_campaign(folder, n=3)
    for i in range(3):
        (folder / "data" / f"set{i}.csv").write_text(csv_text(k=2.4, nth=i))
    return run_campaign(path, overrides=_quiet(folder)).directory


def _quiet(folder):
    return {"output.report": False, "output.directory": str(folder / "run")}


def test_files_and_table(campaign, tmp_path):
    result = CliRunner().invoke(main, ["joint", str(campaign), "--share", "k", "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "k" in result.output
    found = load_joint(tmp_path / "out" / "joint.nc")
    posterior = found.group("posterior")
    assert found.shared == ("k",)
    assert posterior["k"].dims == ("chain", "draw")
    assert posterior["A"].dims == ("chain", "draw", "dataset")
    assert abs(posterior["k"].values.mean() - 2.4) < 0.05
    alone = found.group("alone")["k"].values
    width = np.subtract(*np.quantile(posterior["k"].values, (0.95, 0.05)))
    assert width < 0.8 * np.min(alone[:, 2] - alone[:, 0])  # three say more than one: 1/√3 = 0.58
    page = (tmp_path / "out" / "joint.html").read_text()
    assert "What they share" in page
    assert "set2" in page


def test_two_runs_with_one_name_of_a_data_set(campaign, tmp_path):
    runs = []
    for i, name in enumerate(("toy", "toy", "toy_2")):
        folder = tmp_path / f"day{i}"
        folder.mkdir()
        path = write_toy(folder, data=csv_text(nth=i))
        runs.append(run_campaign(path, overrides={**_quiet(folder), "data.name": name}).directory)
    found, _ = join(runs, ["k"], tmp_path / "out")
    assert found.datasets == ("toy", "toy_2", "toy_2_2")


def test_the_same_bits_again(campaign, tmp_path):
    first, _ = join([campaign], ["k"], tmp_path / "a")
    again, _ = join([campaign], ["k"], tmp_path / "b", workers=2)
    assert_same_groups(first.groups, again.groups, "/posterior")


def test_bad_questions(campaign, tmp_path):
    with pytest.raises(ConfigError, match=r"q: cannot be shared, for no two data sets.*"):
        join([campaign], ["q"], tmp_path)
    with pytest.raises(OutputError, match="no such file"):
        join([tmp_path / "nothing"], ["k"], tmp_path)
    result = CliRunner().invoke(main, ["joint", str(campaign), "--share", "c"])
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_what_more_than_a_third_of_the_data_sets_have_spoils_the_joint_intervals():
    several = [
        SimpleNamespace(name=f"set{i}", cautions=(caution("misfit", "χ²", "serious"),) * (i < 4)) for i in range(9)
    ]
    others = [replace(caution("members-lost", "9 of 9", "serious"), advice=""), caution("misfit", "χ²", "caution")]
    for count, severity in ((9, "serious"), (12, "caution")):
        sets = [*several, *[SimpleNamespace(name="more", cautions=others)] * (count - 9)]
        (told,) = carried(sets, SPOILT)
        assert (told.code, told.severity) == ("misfit", severity)
        assert untrusted([told], "k") == (("misfit",) if severity == "serious" else ())


def test_a_damaged_file_is_refused(campaign, tmp_path):
    join([campaign], ["k"], tmp_path)
    path = tmp_path / "joint.nc"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(OutputError, match=r"joint\.nc"):
        load_joint(path)


@pytest.mark.slow
def test_discrepancies_of_their_own(tmp_path):
    """Draws of a Matérn process, whose amplitude and length are each data set's own, hide the shared spring little."""
    rng, path = np.random.default_rng(2), make_campaign(tmp_path, n=3)
    for i in range(3):
        head, unit, *rows = csv_text(k=2.4).splitlines()
        t, x = np.array([row.split(",") for row in rows], dtype=float).T
        d = np.sqrt(5) * np.abs(t[:, None] - t) / 15  # ms
        root = np.linalg.cholesky(16 * (1 + d + d**2 / 3) * np.exp(-d) + 1e-6 * np.eye(len(t)))
        noisy = x + root @ rng.standard_normal(len(t)) + rng.standard_normal(len(t))
        lines = [head, unit, *(f"{time:g},{value:.6g}" for time, value in zip(t, noisy, strict=True)), ""]
        (tmp_path / "data" / f"set{i}.csv").write_text("\n".join(lines))
    error = "position_std: 1 um, discrepancy: {kernel: matern-5/2}"
    path.write_text(path.read_text().replace("position_std: 2 um", error).replace("members: 8", "members: 30"))
    found, _ = join([run_campaign(path, overrides=_quiet(tmp_path)).directory], ["k"], tmp_path / "out")
    posterior, alone = found.group("posterior"), found.group("alone")["k"].values
    assert posterior["discrepancy_amplitude"].dims == ("chain", "draw", "dataset")
    low, high = np.quantile(posterior["k"].values, (0.05, 0.95))
    assert abs(posterior["k"].values.mean() - 2.4) < high - low
    assert high - low < 0.9 * np.min(alone[:, 2] - alone[:, 0])
    assert np.all(np.median(posterior["discrepancy_amplitude"].values, axis=(0, 1)) > 1e-6)  # of 4 um, beside 1 um


ERRORS = {
    "timing": "position_std: 2 um, time_std: 0.1 ms",
    "robust": "position_std: 2 um, robust: huber",
    "correlated": "position_std: 2 um, correlation_time: 5 ms",
    "discrepancy": "position_std: 2 um, time_std: 0.1 ms, discrepancy: estimated",
    "robust discrepancy": "position_std: 2 um, robust: huber, discrepancy: estimated",
}


@pytest.mark.parametrize("error", [*(pytest.param(name, marks=pytest.mark.slow) for name in ERRORS), "sigma"])
def test_errors_of_every_kind(error, tmp_path):
    """One of five oscillators has a spring 15 % stiffer: it is named, and the estimate without it finds that of the
    others.
    """
    rng, path = np.random.default_rng(1), make_campaign(tmp_path, n=5)
    for i in range(5):
        clean = csv_text(k=2.76 if i == 2 else 2.4).splitlines()
        noisy = [f"{t},{float(x) + 2 * rng.standard_normal():.6g}" for t, x in (line.split(",") for line in clean[2:])]
        (tmp_path / "data" / f"set{i}.csv").write_text("\n".join([*clean[:2], *noisy]) + "\n")
    text = path.read_text()
    if error == "sigma":
        text = text.replace("  A: {", "  sigma: {prior: lognormal, median: 1, log_std: 0.5}\n  A: {")
    else:
        text = text.replace("position_std: 2 um", ERRORS[error])
    path.write_text(text.replace("members: 8", "members: 24"))
    run = run_campaign(path, overrides=_quiet(tmp_path)).directory
    found, page = join([run], ["k"], tmp_path / "out")
    assert found.odd == ("set2",)
    rest = found.group("without")["k"].values
    assert abs(float(rest.mean()) - 2.4) < 3 * float(rest.std())
    assert float(rest.std()) < 0.03
    assert "without set2" in page.read_text()
    assert joint_lines(found)[0].endswith(", one value in 4 data sets, without set2")
    with pytest.raises(OutputError, match=r"joint\.nc: what several data sets say together, .* are in joint\.csv"):
        load_result(tmp_path / "out" / "joint.nc")
    first, *others = csv.DictReader((tmp_path / "out" / "joint.csv").read_text().splitlines())
    assert (first["name"], first["without"], first["warnings"]) == ("k", "set2", "")
    own = {row["dataset"]: row for row in others if row["name"] == "A"}
    assert [name for name, row in own.items() if row["warnings"]] == ["set2"]
    assert {row["without"] for name, row in own.items() if name != "set2"} == {"set2"}
