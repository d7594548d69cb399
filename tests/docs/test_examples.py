"""Every example of README and docs runs, page by page; what cannot is marked on the page, and its commands exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest
from doc_pages import PAGES, ROOT, Block, Session, blocks, command_lines, matches, merged

from en4dvar.cli import main

LANGUAGES = {"python", "yaml", "console", "sh", "text", "bibtex"}
MOST_NOT_RUN = 6  # blocks of all pages together


def run_here(page: Path) -> list[Block]:
    """The blocks of a page that this module runs."""
    return [b for b in blocks(page) if b.language not in ("text", "bibtex") and not b.not_run and not b.tested_by]


def marked(page: Path) -> object:
    """The page, a long test where its examples take a minute or more and other tests do much the same."""
    slowest = page.stem in (
        "cluster",
        "tutorial_own_forward_model",
        "own_model_further",
        "polyacrylamide",
        "collapse_times",
        "collapse_times_measured",
    )
    return pytest.param(page, marks=pytest.mark.long) if slowest else page


@pytest.mark.slow
@pytest.mark.parametrize("page", [marked(p) for p in PAGES if run_here(p)], ids=lambda p: p.stem)
def test_the_examples_of_a_page_run(page, tmp_path):
    session = Session(tmp_path, ROOT / "configs" / "quickstart.yaml")
    for block in run_here(page):
        if block.missing:
            pytest.skip(f"{page.relative_to(ROOT)}:{block.line} and what follows need {block.missing}")
        try:
            session.run(block)
        except Exception as error:
            pytest.fail(f"{page.relative_to(ROOT)}:{block.line}: {error}")


def long_commands() -> list[str]:
    """The commands of README's table of those that take a minute or more, in the order printed."""
    table = (
        (ROOT / "README.md").read_text(encoding="utf-8").partition("What takes a minute or more:")[2].split("\n\n")[1]
    )
    return re.findall(r"^\| `(en4dvar [^`]+)` \|", table, re.M)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("command", long_commands(), ids=lambda c: "_".join(c.split()[1:3]))
def test_the_long_commands_of_readme_run(command, tmp_path):
    session = Session(tmp_path, ROOT / "configs" / "quickstart.yaml")
    for name in re.findall(r"\w+\.mat\b", command):  # a public recording that is not shipped
        measured = ROOT.parent / "shared" / "data" / name
        if not measured.exists():
            pytest.skip(f"{name} is not there (../shared/data)")
        (session.folder / name).symlink_to(measured)
    session.call(command)


def test_readme_has_long_commands():
    assert len(long_commands()) == 7


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_every_block_says_what_it_is(page):
    for block in blocks(page):
        where = f"{page.name}:{block.line}"
        assert block.language in LANGUAGES, f"{where}: say the language; text where it is none"
        assert not block.tested_by or (ROOT / block.tested_by).is_file(), f"{where}: {block.tested_by} is not there"
        assert not block.mark or block.not_run or block.tested_by or "needs:" in block.mark, (
            f"{where}: mark {block.mark!r} is not understood"
        )


def test_few_examples_are_not_run():
    reasons = [block.not_run for page in PAGES for block in blocks(page) if block.not_run]
    assert len(reasons) <= MOST_NOT_RUN, reasons


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_every_command_exists(page):
    """Also those in the text, and those too long to be run: command, options, script."""
    for line, command in command_lines(page):
        words = shlex.split(command)
        where = f"{page.name}:{line}: {command}"
        if words[0] == "python":
            assert (ROOT / words[1]).is_file(), where
            continue
        context = click.Context(main, info_name="en4dvar")
        found = main.get_command(context, words[1])
        assert found is not None, where
        if words[2:]:
            try:
                found.make_context(words[1], words[2:], parent=context)
            except click.UsageError as error:
                pytest.fail(f"{where}: {error.format_message()}")


def test_every_benchmark_is_on_the_page_of_figures():
    text = (ROOT / "docs" / "figures.md").read_text(encoding="utf-8")
    scripts = [p for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text(encoding="utf-8")]
    assert scripts
    assert [p.name for p in scripts if f"benchmarks/{p.name}" not in text] == []


def test_every_figure_names_its_commit():
    text = (ROOT / "docs" / "figures.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("|") and "`" in line]
    assert len(rows) > 30
    commit = re.compile(r"\| (?:[0-9a-f]{7}|tests|–)(?:[,;] (?:[0-9a-f]{7}|tests))* \|$")
    assert [row for row in rows if not commit.search(row)] == []


def test_merged_keeps_what_is_not_named():
    assert merged({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 4}, "d": 5}) == {"a": {"b": 4, "c": 2}, "d": 5}


@pytest.mark.parametrize(("shown", "same"), [("G 1.…\nend\n", True), ("G 2.…\nend\n", False), ("G 1.", False)])
def test_output_is_compared(shown, same):
    assert matches(shown, "G 1.234 kPa\nend\n") is same


def test_a_failing_example_is_seen(tmp_path):
    session = Session(tmp_path, ROOT / "configs" / "quickstart.yaml")
    with pytest.raises(AssertionError, match="exit code 3"):
        session.run(Block("console", "$ exit 3\n", "", 1))
    with pytest.raises(AssertionError, match="printed"):
        session.run(Block("console", "$ echo one\ntwo\n", "", 1))
    with pytest.raises(Exception, match="nonsense"):
        session.run(Block("yaml", "model: {nonsense: 1}\n", "", 1))
