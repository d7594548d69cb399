"""One word, one meaning: identifiers keep to the glossary (docs/glossary.md)."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from syntax import nodes

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(p for top in ("en4dvar", "models") for p in (ROOT / top).rglob("*.py"))

# word in a name → the word of the glossary
FORBIDDEN = {
    "taken": "move, or record",
    "scout": "descent",
    "seen": "predictions, or what it is",
    "told": "what was said",
    "teller": "what passes it on",
    "ending": "analysis, or outcome",
    "particle": "member",
    "sample_size": "members, or ensemble size",
    "background_ensemble": "prior",
    "deviation": "anomaly (of members), std (of errors)",
    "deviations": "anomalies",
    "perturbed_member": "member",
    "posterior_mode": "mode",
    "hyperparams": "parameters",
    "obs": "observations",
}


VAGUE = {"found", "one", "given"}  # of a variable or an argument: they say how it came to be, not what it is


def words(name: str) -> list[str]:
    """The words of an identifier, lower case: of snake_case and CamelCase."""
    return [w.lower() for part in name.split("_") for w in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", part)]


def names(source: str) -> set[str]:
    """Every class, function and parameter that a file defines."""
    found = set()
    for node in nodes(source):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
    return found


def odd(source: str) -> set[str]:
    return {name for name in names(source) if set(words(name)) & FORBIDDEN.keys()}


def vague(source: str) -> list[int]:
    """Lines on which a variable or an argument is bound to a vague name."""
    return sorted(
        node.lineno
        for node in nodes(source)
        if (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE)
        or (isinstance(node, ast.arg) and node.arg in VAGUE)
    )


def test_identifiers_use_the_words_of_the_glossary():
    found = {str(p.relative_to(ROOT)): sorted(names) for p in FILES if (names := odd(p.read_text(encoding="utf-8")))}
    assert found == {}


def test_variables_say_what_they_hold():
    assert {str(p.relative_to(ROOT)): n for p in FILES if (n := vague(p.read_text(encoding="utf-8")))} == {}


@pytest.mark.parametrize("source", ["found = 1", "def f(given): pass", "[one for one in ()]", "with x as found: pass"])
def test_a_vague_name_would_be_seen(source):
    assert vague(source) == [1]


@pytest.mark.parametrize(
    "source",
    [
        "class Scout: pass",
        "def what_was_told(): pass",
        "def f(posterior_ending): pass",
        "def seen(): pass",
    ],
)
def test_an_odd_word_would_be_seen(source):
    assert odd(source)


def test_a_class_name_has_one_meaning():
    """No two modules of the framework define a public class of the same name."""
    homes: dict[str, list[str]] = {}
    for path in sorted((ROOT / "en4dvar").rglob("*.py")):
        module, *_ = nodes(path.read_text(encoding="utf-8"))
        for node in module.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


def test_shares_are_written_in_one_way():
    """As ``percent`` writes them, with a space before the sign: no format of Python's, which has none."""
    bare = re.compile(r":[\d.]*%\}")
    assert [str(p.relative_to(ROOT)) for p in FILES if bare.search(p.read_text(encoding="utf-8"))] == []
