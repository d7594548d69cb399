"""Imports only point down: the order of the layers, and no circles between files."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from syntax import nodes

ROOT = Path(__file__).resolve().parents[2]

# From the ground up. A file imports from its own layer and from those before it, type-checking imports included.
LAYERS = (
    "plumbing", "model", "priors", "data", "problem", "executor", "ensemble", "schemes", "diagnosis", "descent",
    "series", "sampling", "estimation", "inputs", "config", "assembly", "results", "report", "runs", "commands", "cli",
)  # fmt: skip
FLOOR = {name: floor for floor, name in enumerate(LAYERS)}

# the same inside the bubble, as the docstring of its package states
BUBBLE = (
    "tables", "medium", "collapse", "driving", "numbers", "laws", "solver", "dynamics", "paths", "events",
    "settings", "model", "api", "battery", "starter", "examples", "commands", "commands_init", "warm_up",
)  # fmt: skip


# and inside the reader of movies
MOVIE = (
    "decoders", "numbering", "frames", "kernels", "outline", "uncertainty", "fitting", "drifting", "surfaces", "burnt",
    "background", "merged", "flashes", "candidates", "following", "choice", "tracking", "table", "page", "scene",
    "filming", "commands", "warm_up",
)  # fmt: skip


def modules(top: Path) -> dict[str, Path]:
    """Dotted name → file of every module below a folder that lies on the import path."""
    found = {}
    for path in sorted(top.rglob("*.py")):
        parts = path.relative_to(top.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(source: str, known: dict[str, Path]) -> set[str]:
    """The modules of ``known`` that a file imports, at any depth of nesting and in any branch."""
    found = set()
    for node in nodes(source):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            inside = submodules & known.keys()
            found |= inside
            if inside != submodules:
                found.add(node.module)
    return found & known.keys()


@cache
def graph(top: Path) -> dict[str, set[str]]:
    known = modules(top)
    return {name: imports(path.read_text(encoding="utf-8"), known) - {name} for name, path in known.items()}


def upward(arrows: dict[str, set[str]], floors: Mapping[str, int]) -> list[str]:
    """Imports inside a package that do not point down; its face, which only hands names on, is left out."""
    floor = {name: floors[name.split(".")[1]] for name in arrows if "." in name}
    return [
        f"{name} -> {target}"
        for name in floor
        for target in sorted(arrows[name])
        if target not in floor or floor[target] > floor[name]
    ]


def circle(arrows: dict[str, set[str]]) -> list[str]:
    """The modules of one circle, in the order in which they are imported; empty where there is none."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return list(error.args[1])[::-1]
    return []


def test_imports_of_the_framework_point_down():
    assert upward(graph(ROOT / "en4dvar"), FLOOR) == []


def test_imports_of_the_bubble_point_down():
    floors = {name: floor for floor, name in enumerate(BUBBLE)}
    assert upward(graph(ROOT / "models" / "en4dvar_bubble"), floors) == []


def test_imports_of_the_movies_point_down():
    floors = {name: floor for floor, name in enumerate(MOVIE)}
    assert upward(graph(ROOT / "models" / "en4dvar_movie"), floors) == []


def test_movies_do_not_know_the_bubble():
    sources = [p.read_text(encoding="utf-8") for p in (ROOT / "models" / "en4dvar_movie").rglob("*.py")]
    assert [source for source in sources if "en4dvar_bubble" in source or "en4dvar_agarose" in source] == []


def test_the_bubble_does_not_know_the_paper():
    sources = [p.read_text(encoding="utf-8") for p in (ROOT / "models" / "en4dvar_bubble").rglob("*.py")]
    assert [source for source in sources if "en4dvar_agarose" in source] == []


def test_no_layer_is_left_over():
    present = {name.split(".")[1] for name in modules(ROOT / "en4dvar") if "." in name}
    assert present == set(FLOOR)


@pytest.mark.parametrize("package", ["en4dvar", *(p.name for p in sorted((ROOT / "models").glob("en4dvar_*")))])
def test_no_files_import_each_other_in_a_circle(package):
    top = ROOT / package if package == "en4dvar" else ROOT / "models" / package
    arrows = dict(graph(top))
    arrows.pop(package, None)  # the package's face, which only hands names on
    assert circle(arrows) == []


def test_only_the_command_line_imports_the_commands():
    importers = {
        name
        for name, targets in graph(ROOT / "en4dvar").items()
        if any(target.startswith("en4dvar.commands") for target in targets)
    }
    assert {name for name in importers if not name.startswith(("en4dvar.commands", "en4dvar.cli"))} == set()


def test_applications_import_the_commands_only_for_commands_of_their_own():
    """The one exception to what may be imported from above: options and messages of the command line are shared."""
    known = modules(ROOT / "en4dvar")
    for package in (p for p in (ROOT / "models").iterdir() if p.is_dir()):
        for path in package.rglob("*.py"):
            used = imports(path.read_text(encoding="utf-8"), known)
            if any(target.startswith("en4dvar.commands") for target in used):
                assert path.name.startswith("commands"), path


def test_an_upward_import_would_be_seen():
    arrows = dict(graph(ROOT / "en4dvar"))
    arrows["en4dvar.priors.prior"] = arrows["en4dvar.priors.prior"] | {"en4dvar.config.load"}
    assert upward(arrows, FLOOR) == ["en4dvar.priors.prior -> en4dvar.config.load"]


@pytest.mark.parametrize(
    "source",
    [
        "from en4dvar.config import load",
        "import en4dvar.config.load",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from en4dvar.config.load import Config",
        "def f():\n    from en4dvar.config.load import Config",
    ],
)
def test_every_kind_of_import_would_be_seen(source):
    assert imports(source, modules(ROOT / "en4dvar")) == {"en4dvar.config.load"}


def test_a_circle_would_be_seen():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}, "e": set()})) == {"a", "b", "c"}
