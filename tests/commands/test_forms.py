"""Forms of a simulation that application packages add as options of ``simulate``; nothing is imported before."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.commands import plugins

MODULE = '''
def poem(config, times, out, settings, seed):
    """Write verses too. With care.

    Details.
    """
    out.write_text(f"{config.name} {len(times)} {sorted(settings.items())} {seed}")
    return f"poem: {out}"
'''
CONFIG = """
name: rose
seed: 5
model: {name: linear}
parameters: {}
simulate: {times: {from: 0, to: 3, step: 1}}
"""


@pytest.fixture(autouse=True)
def _package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "verses.py").write_text(MODULE)
    (tmp_path / "rose.yaml").write_text(CONFIG)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    entries = {"poem": "verses:poem", "gone": "no_such_package:x", "out": "verses:poem"}
    found = {name: EntryPoint(name, value, plugins.FORMS) for name, value in entries.items()}
    monkeypatch.setattr(plugins, "installed", lambda group: found)
    monkeypatch.delitem(sys.modules, "verses", raising=False)


def test_help_tells_forms_without_importing_them() -> None:
    shown = " ".join(CliRunner().invoke(main, ["simulate", "--help"]).output.split())
    assert "--poem FILE Write verses too." in shown
    assert "--poem-set KEY=VALUE" in shown
    assert "--gone FILE From no_such_package." in shown
    assert "CSV file to write" in shown  # a package cannot replace an option of ours
    assert "verses" not in sys.modules


def test_a_form_gets_what_the_command_was_given() -> None:
    words = ["simulate", "rose.yaml", "--times", "0:4:1", "--poem", "p.txt", "--poem-set", "rhyme = abba"]
    outcome = CliRunner().invoke(main, words)
    assert (outcome.exit_code, outcome.output) == (0, "poem: p.txt\n")
    assert Path("p.txt").read_text() == "rose 5 [('rhyme', 'abba')] 5"
    again = CliRunner().invoke(main, words)
    assert again.exit_code == 2
    assert "p.txt: exists" in again.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--poem-set", "a=1"], "--poem-set needs --poem FILE"),
        (["--poem", "p", "--poem-set", "a"], "'a' is not KEY=VALUE"),
        (["--poem", "p", "--out", "./p"], "p: is to hold two things"),
        (["--out", "rose.yaml", "--force"], "rose.yaml: is what the command reads"),
        (["--poem", "p", "--noise", "1 m"], "name its file with --out"),
        (["--gone", "p"], "cannot be loaded"),
    ],
)
def test_faults(words: list[str], message: str) -> None:
    outcome = CliRunner().invoke(main, ["simulate", "rose.yaml", *words])
    assert outcome.exit_code != 0
    assert message in outcome.output
