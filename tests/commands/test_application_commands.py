"""The commands that the shipped applications add: help with an example, an interrupt that says how to go on."""

import inspect
import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.commands.plugin_commands import GROUP

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


def test_every_command_has_help_with_an_example() -> None:
    entries = {entry.name: entry for entry in entry_points(group=GROUP)}
    assert {"init", "laws", "study", "sweep"} <= set(entries)
    for name, entry in entries.items():
        text = inspect.cleandoc(entry.load().help or "")
        assert re.search(r"^Examples?:\n", text, re.MULTILINE), name
        assert f"en4dvar {name} " in text, name
        shown = CliRunner().invoke(main, [name, "--help"])
        assert (shown.exit_code, f"  en4dvar {name} " in shown.output) == (0, True), name


def test_an_interrupted_sweep_says_how_to_continue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("en4dvar.sampling.sweep.run_sweep", interrupt)
    call = ["sweep", str(CONFIG), "--trajectories", "64", "--out", str(tmp_path / "sweep"), "--force"]
    monkeypatch.setattr("sys.argv", ["en4dvar", *call])
    done = CliRunner().invoke(main, call)
    assert done.exit_code == 130
    assert done.stderr.splitlines() == [
        f"interrupted; finished chunks are kept in {tmp_path / 'sweep' / 'chunks'}",
        f"to continue: en4dvar {' '.join(call[:-1])} --resume",
    ]
    monkeypatch.undo()
    assert CliRunner().invoke(main, [*call[:-1], "--resume"]).exit_code == 0


def test_the_shell_completes_commands_options_and_laws() -> None:
    def offered(words: str) -> list[str]:
        typed = {
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split(" ")) - 1),
            "_EN4DVAR_COMPLETE": "bash_complete",
        }
        return CliRunner().invoke(main, env=typed, prog_name="en4dvar").output.split()

    assert "plain,rerun" in offered("en4dvar r")
    assert offered("en4dvar run --wo") == ["plain,--workers"]
    assert offered("en4dvar laws neo") == ["plain,neo-hookean-kelvin-voigt"]
    assert offered("en4dvar run ") == ["file,"]
