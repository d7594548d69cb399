"""Progress: a live line on terminals only; a log that says why a run failed."""

from pathlib import Path

import pytest

from en4dvar.errors import OutputError
from en4dvar.problem import Analysis
from en4dvar.progress import RunLog, describe, terminal_progress


def test_terminal_only(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, analysis: Analysis) -> None:
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    with terminal_progress(1) as progress:
        assert progress is None
    assert capsys.readouterr() == ("", "")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    with terminal_progress(2) as progress:
        assert progress is not None
        progress("gel", analysis.iterations[-1])
    out, err = capsys.readouterr()
    assert out == ""
    assert "gel: iteration 5, J " in err


def test_log(tmp_path: Path, analysis: Analysis) -> None:
    record = analysis.iterations[0]

    def broken_run() -> None:
        with RunLog(tmp_path / "run.log") as log:
            log.write(describe("gel", record))
            assert "active 23" in (tmp_path / "run.log").read_text()  # written at once
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        broken_run()
    lines = (tmp_path / "run.log").read_text().splitlines()
    assert len(lines) == 2
    assert f"J {record.cost:.6g} = {record.background:.4g} + {record.observation:.6g}" in lines[0]
    assert lines[1].endswith("failed: ValueError: broken")
    with pytest.raises(OutputError, match="cannot be written"):
        RunLog(tmp_path / "no" / "run.log")
