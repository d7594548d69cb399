"""The commands that the shipped applications add: help with an example, an interrupt that says how to go on."""

import inspect
import re
from importlib.metadata import entry_points
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.commands.plugins import COMMANDS

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


def test_every_command_has_help_with_an_example() -> None:
    entries = {entry.name: entry for entry in entry_points(group=COMMANDS)}
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
        f"interrupted; finished parts are kept in {tmp_path / 'sweep'}",
        f"to continue: en4dvar {' '.join(call[:-1])} --resume",
    ]
    monkeypatch.undo()
    assert CliRunner().invoke(main, [*call[:-1], "--resume"]).exit_code == 0


def offered(*words: str) -> set[str]:
    """What the shell is told after these words, the last one unfinished; "file" stands for files and folders."""
    found = ShellComplete(main, {}, "en4dvar", "_EN4DVAR_COMPLETE").get_completions(list(words[:-1]), words[-1])
    return {item.value if item.type == "plain" else item.type for item in found}


def test_the_shell_completes_commands_choices_and_laws() -> None:
    assert offered("") == set(main.list_commands(click.Context(main)))
    assert offered("init", "--start", "") == {"acoustic", "laser"}
    assert offered("laws", "neo") == offered("init", "--law", "neo") == {"neo-hookean-kelvin-voigt"}


@pytest.mark.parametrize("command", main.list_commands(click.Context(main)))
def test_the_shell_completes_options_and_files(command: str) -> None:
    shown = CliRunner().invoke(main, [command, "--help"]).output
    options = set(re.findall(r"^ +(?:-\w, )?(--[\w-]+)", shown, re.M))
    assert offered(command, "--") == options
    words = re.findall(r"^ +(--[\w-]+) (?:FILE|PATH|RUN_DIR)\b", shown, re.M)
    assert [word for word in words if offered(command, word, "") != {"file"}] == []
    if re.search(r"^Usage: .* \[?(CONFIG|RUN_DIR|MOVIE)", shown):
        assert offered(command, "") == {"file"}
