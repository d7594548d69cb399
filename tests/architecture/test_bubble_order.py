"""The bubble's modules form an order: none imports, over whatever detour, a module that imports it."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ORDER = (
    "tables", "medium", "gas", "driving", "laws", "solver", "dynamics", "packing", "paths", "settings", "model", "api",
    "battery", "starter", "examples", "commands", "commands_init",
)  # fmt: skip
BUBBLE = Path(__file__).resolve().parents[2] / "models" / "en4dvar_bubble"


def modules(folder: Path) -> dict[str, Path]:
    """Dotted name → file of every module below a package folder; a package is its ``__init__``."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """Module → the modules of ``sources`` that it imports anywhere, also in a function or for type checkers only."""
    graph: dict[str, set[str]] = {}
    for name, source in sources.items():
        wanted = set()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom):
                below = {f"{node.module}.{alias.name}" for alias in node.names} & set(sources)
                wanted |= below or {str(node.module)}
            elif isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
        graph[name] = wanted & set(sources)
    return graph


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """The modules of one circle, in the order in which they are imported; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])[::-1]
    return []


def test_no_circles_in_the_bubble():
    graph = imports({name: path.read_text(encoding="utf-8") for name, path in modules(BUBBLE).items()})
    assert len(graph) > 30
    assert circle(graph) == []


def test_the_bubble_imports_only_downwards():
    """In the order that the package's docstring states; the paper's study stands above all of it."""
    graph = imports({name: path.read_text(encoding="utf-8") for name, path in modules(BUBBLE).items()})
    upward = []
    for name, wanted in graph.items():
        floors = {m.split(".")[1] for m in (name, *wanted) if "." in m} - {"study", "commands_study"}
        if "." in name and "study" not in name:
            here = ORDER.index(name.split(".")[1])
            upward += [f"{name} imports {floor}" for floor in floors if ORDER.index(floor) > here]
    assert upward == []


@pytest.mark.parametrize(
    "back", ["from a.low import x", "from a import low", "import a.low", "if TYPE_CHECKING:\n    from a.low import X",
             "def f():\n    from a.low import x"],
)  # fmt: skip
def test_a_circle_would_be_seen_and_named(back):
    sources = {"a": "", "a.low": "import a.mid", "a.mid": "from a.high import f", "a.high": back}
    assert set(circle(imports(sources))) == {"a.low", "a.mid", "a.high"}
    assert circle(imports({**sources, "a.low": ""})) == []
