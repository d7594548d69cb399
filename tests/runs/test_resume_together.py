"""``en4dvar joint`` and ``population`` of finished runs, stopped and continued."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from execution_models import Stops
from run_files import assert_same_results, configuration, make_campaign

from en4dvar.cli import main
from en4dvar.estimation.population import Effort
from en4dvar.runs.runner import run_campaign

WORDS = {"joint": ("--share", "k"), "population": ("--of", "k")}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three oscillators, of which every forward run is kept."""
    folder = tmp_path_factory.mktemp("campaign")
    path = make_campaign(folder, 3, "execution_models:Stops")
    return run_campaign(configuration(path, folder / "done")).directory


@pytest.fixture(params=WORDS)
def command(request: pytest.FixtureRequest, campaign: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    small = Effort(hyper_walkers=16, hyper_rounds=20, hyper_components=2, draws=200, effective=20.0)
    monkeypatch.setattr("en4dvar.estimation.population.campaign.Effort", lambda: small)
    monkeypatch.setattr("en4dvar.estimation.population.own._emulated", lambda *of: None)
    return [request.param, str(campaign), *WORDS[request.param]]


def call(words: list[str], *more: object, stop_at: int = 0) -> tuple[Result, int]:
    """What came of a command, and how often it has called the model, which stops it at a call."""
    Stops.calls, Stops.stop_at = 0, stop_at
    with pytest.MonkeyPatch.context() as patch:
        words = [*words, *map(str, more)]
        patch.setattr("sys.argv", ["en4dvar", *words])
        done = CliRunner().invoke(main, words)
    Stops.stop_at = 0
    return done, Stops.calls


@pytest.mark.fault("kill-commands")
@pytest.mark.parametrize("again", ["as told", pytest.param("given again", marks=pytest.mark.slow)])
def test_stopped_anywhere_it_continues_to_the_same_bits(command: list[str], tmp_path: Path, again: str) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    done, calls = call(command, "--out", whole)
    assert done.exit_code == 0, done.output
    made, share = 0, max(1, calls // 4)
    for part in range(1, 4):
        stopped, at = call(command, "--out", cut, *["--resume"] * (again == "as told" and part > 1), stop_at=share)
        assert stopped.exit_code == 130
        kept, advice = stopped.stderr.splitlines()[-2:]
        assert kept == f"interrupted; the forward runs are kept in {cut}"
        assert shlex.split(advice) == ["to", "continue:", "en4dvar", *command, "--out", str(cut), "--resume"]
        assert ("continued after" in stopped.stderr) == (part > 1)
        made += at - 1  # the last call was not answered
    words = shlex.split(advice)[3:] if again == "as told" else [*command, "--out", str(cut)]
    done, at = call(words)
    assert done.exit_code == 0, done.output
    assert made + at <= calls + 3  # what was stopped was perhaps begun with others
    assert_same_results(whole, cut)
    assert sorted(p.name for p in cut.rglob("*")) == sorted(p.name for p in whole.rglob("*"))


@pytest.mark.slow
def test_what_is_whole_is_kept_if_asked_for_and_never_by_force(command: list[str], tmp_path: Path) -> None:
    done, calls = call(command, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    whole = {path: path.read_bytes() for path in tmp_path.rglob("*.nc")}
    resumed, made = call(command, "--out", tmp_path, "--resume", "--workers", 2)
    assert (resumed.stdout, made) == (done.stdout, 0)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.nc")} == whole
    assert call(command, "--out", tmp_path)[1] == calls
    assert call(command, "--out", tmp_path, stop_at=calls - 2)[0].exit_code == 130
    assert call(command, "--out", tmp_path, "--force")[1] == calls
    both, _ = call(command, "--out", tmp_path, "--force", "--resume")
    assert both.exit_code == 2
    assert "force replaces a run, resume continues it; give one of them" in both.stderr


@pytest.mark.slow
def test_another_question_is_not_answered_by_what_was_kept(command: list[str], tmp_path: Path) -> None:
    other = [*command, command[-2], "A"]
    _, alone = call(other, "--out", tmp_path / "alone")
    _, calls = call(command, "--out", tmp_path / "whole")
    assert call(command, "--out", tmp_path / "cut", stop_at=calls - 2)[0].exit_code == 130
    done, made = call(other, "--out", tmp_path / "cut", "--resume")
    assert (done.exit_code, made) == (0, alone)
    assert "belongs to another run (other configuration, data or model)" in done.stderr
    assert_same_results(tmp_path / "alone", tmp_path / "cut")


def test_a_question_without_an_answer_leaves_no_folder(campaign: Path, tmp_path: Path) -> None:
    done, _ = call(["joint", str(campaign), "--share", "q"], "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert not (tmp_path / "out").exists()
