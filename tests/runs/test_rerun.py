"""A run repeated from its result files alone: the same bits, or what has changed."""

import numpy as np
import pytest
from run_files import add_to_pack, configuration, make_campaign, run_cli
from toy_config import write_toy

from en4dvar.plumbing.errors import OutputError
from en4dvar.report.result import load_result
from en4dvar.results.pack import PACK
from en4dvar.runs.rerun import differences, rerun
from en4dvar.runs.runner import run, run_campaign


@pytest.fixture
def campaign(tmp_path):
    path = make_campaign(tmp_path, 2)
    (tmp_path / "data" / "empty.csv").write_text("t_ms,x_um\n")
    run_campaign(configuration(path, tmp_path / "run", executor="serial"))
    return tmp_path


def test_a_campaign_is_repeated(campaign):
    found = rerun(campaign / "run", workers=2)
    assert found.same
    assert (found.changed, found.surroundings) == ("", ())
    assert [one.name for one in found.sets] == ["set0", "set1"]
    assert all(one.variables > 40 for one in found.sets)
    assert list(found.failures) == ["empty"]
    assert str(found).splitlines()[-1] == "not repeated, for they have no result: empty"


@pytest.mark.parametrize(
    ("again", "words"),
    [
        ([1.0, np.nan, 4.0], ()),
        ([1.0, np.nan, 3.0], ("/x differs by up to 0.25 of its largest value",)),
        ([np.nan, 2.0, 4.0], ("/x differs: other values are missing (NaN)",)),
    ],
)
def test_what_differs_is_said(again, words):
    assert differences({"/x": np.array([1.0, np.nan, 4.0])}, {"/x": np.array(again)}) == words


@pytest.mark.slow
def test_without_the_data_and_with_other_data(campaign):
    (campaign / "data" / "set0.csv").unlink()
    (campaign / "data" / "set1.csv").write_text("t_ms,x_um\n0,1\n1,2\n2,3\n")
    (campaign / "toy.yaml").unlink()
    done = run_cli("rerun", campaign / "run")
    assert done.returncode == 0, done.stderr
    first, second, *_ = done.stdout.splitlines()
    gone = f"{campaign}/data/set0.csv is gone, the recorded observations were used"
    assert first.startswith("set0: the same bits (")
    assert first.endswith(f"; {gone}")
    assert "set1.csv has changed since, the recorded observations were used" in second


@pytest.mark.slow
def test_what_differs_is_named(campaign):
    file = campaign / "run" / PACK / "set1"
    result = load_result(file)
    result.tree["posterior/k"].values[0, 2] *= 1 + 1e-9
    add_to_pack(campaign / "run", "set1", result)
    done = run_cli("rerun", campaign / "run")
    assert done.returncode == 1
    assert "set0: the same bits" in done.stdout
    assert "set1: /posterior/k differs by up to" in done.stdout
    assert done.stderr == "the run is not reproduced\n"


def test_what_has_changed_is_told(campaign, monkeypatch):
    monkeypatch.setattr("en4dvar.results.provenance.source_digest", lambda module: f"another {module}")
    monkeypatch.setattr("en4dvar.results.provenance.cpu_model", lambda: "another processor")
    found = rerun(campaign / "run")
    assert found.same
    assert "+  toy_models: another toy_models" in found.changed
    assert any(line.startswith("cpu: ") and "→ another processor" in line for line in found.surroundings)


@pytest.mark.parametrize(
    "changes",
    [
        [("{position_std: 2 um}", "{position_std: 2 um, time_std: 0.01 ms}")],
        [("{position_std: 2 um}", "{position_std: 2 um, correlation_time: 3 ms}")],
        [("{position_std: 2 um}", "{position_std: 2 um, robust: huber, threshold: 1.5}")],
        [("  c: 0.02 N s/m", "  c: 0.02 N s/m\ninitial_state:\n  v: {std: 1 mm/s}")],
        [("members: 8", "weights: mean\n  members: 8"), ("seed: 3", "seed: 123456789012")],
    ],
    ids=["timing error", "correlation", "robust", "initial state", "weights"],
)
def test_everything_that_decides_the_numbers_is_recorded(tmp_path, changes):
    path = write_toy(tmp_path, *changes)
    run(configuration(path, tmp_path / "run", executor="serial"))
    (tmp_path / "toy.csv").unlink()
    found = rerun(tmp_path / "run")
    assert found.same, str(found)
    assert found.changed == ""


def test_no_run(tmp_path):
    with pytest.raises(OutputError, match=r"holds no posterior\.nc; is it the directory of a finished run"):
        rerun(tmp_path)
