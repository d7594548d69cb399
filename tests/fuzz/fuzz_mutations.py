"""Changes to a valid configuration that keep it YAML: the way people get configurations wrong."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

Path = tuple[str | int, ...]

ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 10**18, -(10**18), 1e308, 5e-324, float("inf"), float("nan"), "", " ", "nan", "1e-6",
    "0 kPa", "-3 um", "1e400 us", "5", "5 parsec", "R_max", "R_max/7", "0.5 kPa", "us", "../../../etc/passwd",
    "/dev/null", ".", "~", "*.csv", "[", "\x00", "\ud7ff", "💥", "a" * 5000, "!!python/object:os.system", "{{ 7*7 }}",
    "<script>", "./nowhere.py:Law", "os:system", "heat", "laser", "bubble", "linear", "lognormal", [], {}, [[]],
    [1, "a", None],
    1e-300, -1e-300, 1e300, 1e-200, 1e-20, 2**63, 2**63 - 1, -(2**64), "9" * 400, "1e99999 m", "~nosuchuser/x.csv",
    "../x.py:Y", "./my.py:Y", ":Y", "..:Y", "/dev/null:Y", "a" * 50_000,
    [["b" * 50_000]], "$", "$x$", r"$\frac{$", "\\",
    "{", "}", "%", "\x1b[2J", "\u202eabc", "\u200f", "é", "漢", "=1+1", "@a", "-a", "\t=1", "\x85", "\u2028",
    {"a": {"b": {"c": []}}}, {"prior": "normal"}, {"prior": "lognormal", "median": "1 kPa", "log_std": -1},
)  # fmt: skip


def paths(node: Any, here: Path = ()) -> list[Path]:
    """Every place in a document."""
    found: list[Path] = [here] if here else []
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in items:
        found += paths(child, (*here, key))
    return found


def one_changed(document: dict[str, Any]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """``document`` with one scalar replaced: by every odd value, and by the same quantity of every odd size."""
    for path in paths(document):
        old = parent(document, path)[path[-1]]
        if isinstance(old, dict | list):
            continue
        for new in (*ODD, *(of_size(old, number) for number in NUMBERS)):
            changed = copy.deepcopy(document)
            parent(changed, path)[path[-1]] = new
            yield path, changed


def parent(document: Any, path: Path) -> Any:
    for key in path[:-1]:
        document = document[key]
    return document


NUMBERS = (
    "0",
    "-1",
    "1e-300",
    "-1e-300",
    "1e300",
    "-1e300",
    "1e308",
    "1e-320",
    "1e-20",
    "1e-200",
    "1e200",
    "nan",
    "inf",
)
SIZED = re.compile(r"\s*[-+]?[\d.]+(?:[eE][-+]?\d+)?(?P<unit>\s*[^\d\s].*|)")


def of_size(value: Any, number: str) -> Any:
    """A number, or a quantity, of another size and of the same unit; anything else as it is."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(number)
    found = SIZED.fullmatch(value) if isinstance(value, str) else None
    return f"{number}{found['unit']}" if found else value


values = st.one_of(
    st.sampled_from(ODD),
    st.integers(),
    st.floats(),
    st.text(max_size=30),
    st.recursive(st.none() | st.text(max_size=5), lambda inner: st.lists(inner, max_size=3), max_leaves=4),
)


@st.composite
def mutated(draw: st.DrawFn, document: dict[str, Any]) -> dict[str, Any]:
    """``document`` with one to three places replaced, resized, removed, renamed, added to or swapped."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        places = paths(document)
        if not places:
            break
        path = draw(st.sampled_from(places))
        holder, key = parent(document, path), path[-1]
        match draw(st.sampled_from(["replace", "resize", "remove", "rename", "add", "swap"])):
            case "replace":
                holder[key] = draw(values)
            case "resize":
                holder[key] = of_size(holder[key], draw(st.sampled_from(NUMBERS)))
            case "remove":
                del holder[key]
            case "rename" if isinstance(holder, dict):
                holder[str(key)[1:] or draw(st.text(max_size=8))] = holder.pop(key)
            case "add" if isinstance(holder, dict):
                holder[draw(st.sampled_from(["prior", "std", "unit", "path", "seed", "x", "__class__"]))] = draw(values)
            case _:
                other = draw(st.sampled_from(places))
                holder[key] = copy.deepcopy(parent(document, other)[other[-1]])
    return document
