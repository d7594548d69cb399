"""Ctrl-C at every step of ``en4dvar run``, and the words it is answered with, typed."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from toy_config import write_toy

import en4dvar.runs.cycles
import en4dvar.runs.runner  # noqa: F401 -- before a step is replaced, which they import by name
from en4dvar.cli import main

TWIN = """\
name: twin
model: {name: lorenz96, size: 12}
twin: {cycles: 5, burn_in: 1, interval: 0.05, error: {x_std: 1}, initial_std: {x: 0.1}}
assimilation: {scheme: etkf, members: 15, inflation: 1.02}
"""
STEPS = "runner.estimated_files", "runner.checked_problem", "engine.choose_executor"
EARLY = tuple(f"en4dvar.runs.{step}" for step in STEPS)
BEGUN = (
    *(f"en4dvar.runs.engine.{step}" for step in ("identity", "provenance", "RunDirectory.publish")),
    "en4dvar.runs.progress.without_control",  # of a line of the log
    *(f"en4dvar.runs.{step}" for step in ("engine.write_checkpoint", "runner.datasets", "worklist.summary_rows")),
    *(f"en4dvar.runs.{step}" for step in ("cycles.series_group", "cycles.conduct", "cycles.TwinKind.summary")),
)
pytestmark = pytest.mark.parametrize("before", ["", "--force", "--resume"])  # a first run, or one after another


def call(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments)


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def told_at(
    step: str, before: str, folder: Path, monkeypatch: pytest.MonkeyPatch, *later: str
) -> tuple[str, list[str], list[str]]:
    """What is kept and what to type, as told after interrupts at ``step`` and ``later``, and what was typed."""
    if ".cycles." in step:
        path = folder / "twin.yaml"
        path.write_text(TWIN)
    else:
        path = write_toy(folder)
    words = ["run", str(path), "--out", str(folder / "out"), "--no-report"]
    if before:
        assert call(*words).exit_code == 0
        (folder / "out" / "summary.csv").unlink()  # a finished run that is resumed has this left to do
        words.append(before)
    monkeypatch.setattr("sys.argv", ["en4dvar", *words])
    for each in (step, *later):
        monkeypatch.setattr(each, interrupt)
    outcome = call(*words)
    monkeypatch.undo()
    assert outcome.exit_code == 130
    kept, advice = outcome.stderr.splitlines()
    return kept, shlex.split(advice.partition(": en4dvar ")[2]), words


@pytest.mark.parametrize("step", EARLY)
@pytest.mark.fault("interrupt-early")
def test_before_the_run_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, before: str) -> None:
    kept, advice, words = told_at(step, before, tmp_path, monkeypatch)
    assert kept == "interrupted before the run began"
    assert advice == words
    assert call(*advice).exit_code == 0


@pytest.mark.parametrize("step", BEGUN)
@pytest.mark.fault("interrupt")
def test_a_run_that_has_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, before: str) -> None:
    kept, advice, words = told_at(step, before, tmp_path, monkeypatch)
    assert kept.startswith("interrupted; ")
    assert "kept" in kept
    assert advice == [*(w for w in words if w != before), "--resume"]
    assert call(*advice).exit_code == 0


@pytest.mark.fault("interrupt")
def test_a_second_one_while_the_first_is_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str) -> None:
    steps = "en4dvar.runs.worklist.summary_rows", "en4dvar.executor.base.SerialExecutor.__exit__"
    kept, advice, words = told_at(steps[0], before, tmp_path, monkeypatch, steps[1])
    assert kept.startswith("interrupted; ")
    assert advice == [*(w for w in words if w != before), "--resume"]
    assert call(*advice).exit_code == 0
