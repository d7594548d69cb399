"""Commands of application packages: listed without being imported, run like ours, faults told in one line."""

import re
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from click.testing import CliRunner

from en4dvar import cli
from en4dvar.cli import main
from en4dvar.commands import plugins

MODULE = '''
import click
@click.command()
@click.argument("word")
def shout(word):
    """Say it
    aloud. And more.

    Details.
    """
    click.echo(word.upper())
not_a_command = 3
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    folder = tmp_path / "shouting"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "commands.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    entries = {
        "shout": "shouting.commands:shout",
        "lost": "shouting.nowhere:shout",
        "gone": "no_such_package:x",
        "three": "shouting.commands:not_a_command",
        "run": "shouting.commands:shout",
    }
    found = {name: EntryPoint(name, value, plugins.COMMANDS) for name, value in entries.items()}
    monkeypatch.setattr(cli, "installed", lambda group: found)
    yield "shouting"
    for name in ("shouting", "shouting.commands"):
        sys.modules.pop(name, None)


def test_help_lists_commands_without_importing_them(package: str) -> None:
    listing = CliRunner().invoke(main, ["--help"]).output
    told = dict(re.findall(r"^  (\S+) +(\S.*)$", listing, re.M))
    assert told["shout"].startswith("Say it aloud.")
    assert told["gone"].startswith("From no_such_package.")
    assert told["run"].startswith("Estimate the parameters")  # a package cannot replace a command of ours
    assert package not in sys.modules


def test_a_command_runs(package: str) -> None:
    outcome = CliRunner().invoke(main, ["shout", "hello"])
    assert (outcome.exit_code, outcome.output) == (0, "HELLO\n")
    assert "Details." in CliRunner().invoke(main, ["shout", "--help"]).output
    assert CliRunner().invoke(main, ["shout"]).exit_code == 2


@pytest.mark.parametrize(
    ("name", "reason"),
    [("lost", "No module named 'shouting.nowhere'"), ("gone", "no_such_package"), ("three", "not a click command")],
)
def test_a_broken_command_is_named(package: str, name: str, reason: str) -> None:
    outcome = CliRunner().invoke(main, [name])
    assert outcome.exit_code == 1
    assert outcome.stderr.startswith(f"command '{name}'")
    assert reason in outcome.stderr
    assert len(outcome.stderr.splitlines()) == 1
