"""Progress: a live line on terminals only; a log that says why a run failed."""

import re
from pathlib import Path

import pytest
from numba.core.event import trigger_event
from toy_config import csv_text, write_toy

from en4dvar.config import load_config
from en4dvar.diagnosis.analysis import Analysis, ChainRecord, StartRecord
from en4dvar.plumbing.errors import OutputError
from en4dvar.runs.progress import describe, run_log, terminal_progress, time_left
from en4dvar.runs.runner import run_campaign


def test_terminal_only(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, analysis: Analysis) -> None:
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    with terminal_progress() as progress:
        assert progress is None
    assert capsys.readouterr() == ("", "")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    with terminal_progress() as progress:
        assert progress is not None
        progress.begin(0, 2)
        progress("gel", last := analysis.iterations[-1])
        progress._bar.refresh()
        progress("gel", ChainRecord(150, 1.02, 812.3))
        progress._bar.refresh()
        progress("gel", StartRecord(3, (14.25, 11.5), 1))
    out, err = capsys.readouterr()
    assert out == ""
    assert f"gel iteration 5: J {last.cost:.4g}, χ²/K {last.chi2_per_observation:.3g}, step 0" in err
    assert "gel start, round 3 of 2 descents: lowest J 11.5" in err
    assert "gel chain of 150 steps: R-hat 1.020, 812 independent draws" in err
    assert "0/2" in err
    assert "\x1b[3" in err  # colours


def test_no_color(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, analysis: Analysis) -> None:
    for name, value in {"FORCE_COLOR": "1", "NO_COLOR": "1", "COLUMNS": "120"}.items():
        monkeypatch.setenv(name, value)
    with terminal_progress() as progress:
        assert progress is not None
        progress.begin(0, 1)
        progress("gel", analysis.iterations[-1])
        progress.ended("gel", 1)
    err = capsys.readouterr().err
    assert "files and report" in err
    assert not re.search(r"\x1b\[[0-9;]*(3|4|9)\d*m", err)


def test_what_is_compiled_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"FORCE_COLOR": "1", "COLUMNS": "120"}.items():
        monkeypatch.setenv(name, value)
    with terminal_progress() as progress:
        assert progress is not None
        with trigger_event("numba:compile", {}):  # numba's own, as where it compiles
            pass
        assert progress._bar.tasks[0].description == "first use of this model: compiling, once"


def test_data_sets_are_counted_as_they_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, analysis: Analysis
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "90")
    with terminal_progress() as progress:
        assert progress is not None
        progress.begin(1, 3)
        progress("a very long name of a data set", analysis.iterations[3])
        progress.ended("a very long name of a data set", 2, "G 0.42 ± 0.12 kPa")
        assert "a very long name of a d… iteration 3" in progress._bar.tasks[0].description
        assert progress._bar.tasks[0].completed == 2
    assert "a very long name of a data set: G 0.42 ± 0.12 kPa" in capsys.readouterr().err


def test_iterations_of_data_sets_side_by_side_are_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, int]] = []
    monkeypatch.setenv("FORCE_COLOR", "1")
    for n in (1, 2, 3):
        (tmp_path / f"set{n}.csv").write_text(csv_text(k=1.5 + n / 4))
    config = load_config(
        write_toy(tmp_path),
        {"data.path": "set*.csv", "output.directory": str(tmp_path / "run"), "output.report": False,
         "execution.executor": "threads", "execution.workers": 2},
    )  # fmt: skip
    with terminal_progress() as progress:
        assert progress is not None
        monkeypatch.setattr(progress, "_show", lambda _: told.append((" ".join(progress._open), progress._done)))
        campaign = run_campaign(config, progress=progress)
        assert progress._open == {}
        assert len(progress._lengths) == 3
    log = (tmp_path / "run" / "run.log").read_text()
    iterations = [one.iterations.sizes["iteration"] for one in campaign]
    assert log.count(": iteration ") == sum(iterations)
    rounds = log.count(": start, ") + log.count(": search for another minimum, ")
    assert rounds >= 3
    searched = log.count(" descents ended at J ")
    assert searched == 3
    assert len(told) == 1 + rounds + sum(iterations) + searched + 3  # begin, each round and iteration, each end
    assert told[-1] == ("", 3)


@pytest.mark.parametrize(
    ("gone", "done", "total", "iterations", "lengths", "told"),
    [
        (0.5, 1, 2, [], [5], ""),  # too early to tell
        (9.0, 0, 3, [], [], ""),  # nothing done yet
        (10.0, 1, 3, [], [6], "about 20 s left"),
        (10.0, 0, 1, [4], [], "about 10 s left"),  # half of eight iterations
        (10.0, 1, 3, [3], [6], "about 10 s left"),
        (10.0, 0, 1, [30], [], "about 1 s left"),  # longer than expected: nearly done
        (600.0, 1, 4, [], [6], "about 30 min left"),
        (6000.0, 1, 9, [], [6], "about 13 h left"),
        (10.0, 2, 2, [], [6, 6], ""),
    ],
)
def test_time_left(gone: float, done: int, total: int, iterations: list[int], lengths: list[int], told: str) -> None:
    assert time_left(gone, done, total, iterations, lengths) == told


def test_log(tmp_path: Path, analysis: Analysis) -> None:
    record = analysis.iterations[0]

    def broken_run() -> None:
        with run_log(tmp_path / "run.log") as log:
            log(describe("gel", record))
            assert "active 23" in (tmp_path / "run.log").read_text()  # written at once
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        broken_run()
    lines = (tmp_path / "run.log").read_text().splitlines()
    assert len(lines) == 2
    assert f"J {record.cost:.6g} = {record.background:.4g} + {record.observation:.6g}" in lines[0]
    assert lines[1].endswith("failed: ValueError: broken")
    with pytest.raises(OutputError, match="cannot be written"), run_log(tmp_path / "no" / "run.log"):
        pass


def test_a_notebook_without_widgets_has_no_line_and_no_warning(monkeypatch):
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("en4dvar.runs.progress.find_spec", lambda name: None)
    with terminal_progress() as progress:
        assert progress is None
