"""The examples inside the package are those of the repository, and can be written anywhere."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.plumbing.errors import OutputError
from en4dvar_bubble.examples import EXAMPLES, write_example

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_that_of_the_repository(name, tmp_path):
    config = write_example(name, tmp_path / "new folder")
    for file in (tmp_path / "new folder").rglob("*.*"):
        original = ROOT / "configs" / file.relative_to(tmp_path / "new folder")
        assert file.read_bytes() == original.read_bytes()
    (problem,) = build(load_config(config))
    assert len(problem.observations) > 3


def test_nothing_is_replaced_unasked(tmp_path):
    write_example("quickstart", tmp_path)
    (tmp_path / "quickstart.yaml").write_text("mine")
    with pytest.raises(OutputError, match=r"agarose_synthetic.csv: exists"):
        write_example("quickstart", tmp_path)
    assert (tmp_path / "quickstart.yaml").read_text() == "mine"
    write_example("quickstart", tmp_path, force=True)
    assert (tmp_path / "quickstart.yaml").read_text() != "mine"


def test_from_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, ["init", "--example", "quickstart"])
    assert done.exit_code == 0, done.output
    assert "quickstart.yaml" in done.output
    assert (tmp_path / "data" / "agarose_synthetic.csv").is_file()
    first, _ = (tmp_path / "quickstart.yaml").read_text().split("\n", 1)
    assert first == "# yaml-language-server: $schema=en4dvar.schema.json"
    assert (tmp_path / "en4dvar.schema.json").read_bytes() == (ROOT / "configs" / "en4dvar.schema.json").read_bytes()
    for again in (["init", "--example", "quickstart"], ["init", "--example", "quickstart", "--data", "x.csv"]):
        refused = CliRunner().invoke(main, again)
        assert refused.exit_code == 2
        assert "Traceback" not in refused.output
