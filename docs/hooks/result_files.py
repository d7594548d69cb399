"""Tables of what result files hold, from the declarations by which they are written, while the site is built."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

SHOWN = {
    "parameter": "G", "walk": "G", "series": "radius", "shared": "", "time": "time", "fixed": "R_eq",
    "matrix": "radius_correlation", "pairs": "time time_column", "limit": "wall_mach", "quantity": "strain_rate",
    "field": "ln_T", "kind": "analysis",
}  # fmt: skip
SAID = {"matrix": "correlation of the observation errors, where there is one", "kind": SHOWN["kind"]}
HIDDEN = {"chain", "draw", "quantile"}  # coordinates that need no words


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with the tables, whose names are broken at "_", if anywhere."""
    tables = partial(re.sub, r"`([^`]*_[^`]*)`", _breakable)
    return re.sub(r"<!-- \w+ -->", lambda m: tables(with_tables(m[0])), markdown)


def _breakable(name: re.Match[str]) -> str:
    return f"<code>{name[1].replace('_', '_<wbr>')}</code>"


def with_tables(markdown: str) -> str:
    """A page in which ``<!-- variables -->`` and ``<!-- attributes -->`` are replaced by the declarations."""
    from en4dvar.results import series_file as series
    from en4dvar.results.scalars import ATTRIBUTES
    from en4dvar.results.variables import COORDINATES, GROUPS

    tables = {
        "variables": lambda: variables_table({**GROUPS, "coordinates": COORDINATES}),
        "attributes": lambda: attributes_table(ATTRIBUTES),
        "series": lambda: variables_table({k: (*v, *series.COORDINATES[k]) for k, v in series.TABLES.items()}),
        "series_attributes": lambda: attributes_table(series.ATTRIBUTES),
    }
    return re.sub(r"<!-- (\w+) -->", lambda m: tables[m[1]]() if m[1] in tables else m[0], markdown)


def variables_table(groups: Mapping[str, Iterable[Any]]) -> str:
    """A row a variable; groups that hold the same are one."""
    of_groups: dict[tuple[tuple[str, ...], ...], list[str]] = {}
    for path, table in groups.items():
        of_groups.setdefault(tuple(_variable(d) for d in table if d.name not in HIDDEN), []).append(path)
    rows = []
    for held, paths in of_groups.items():
        heads = [", ".join(f"`{path}`" if path[:1] == "/" or path[-3:] == ".nc" else path for path in paths)]
        rows += [[head, *cells] for head, cells in zip(heads + [""] * len(held), held, strict=False)]
    return _table(["group", "variable", "dimensions", "unit", "meaning", "written if"], rows)


def _variable(d: Any) -> tuple[str, ...]:
    label = SAID.get(d.scope, "its label")
    meaning = d.meaning.format(label=label).removeprefix("its label, ")
    dims = ", ".join(d.dims.format(**SHOWN).split())
    return f"`{d.name.format(**SHOWN)}`", dims, d.unit.words, _cell(meaning), d.when.words


def attributes_table(groups: Mapping[str, Iterable[Any]]) -> str:
    """A row an attribute."""
    rows = [
        [f"`{path}`" if not i else "", ", ".join(f"`{name}`" for name in a.name.split(", ")), _cell(a.meaning)]
        for path, table in groups.items()
        for i, a in enumerate(table)
    ]
    return _table(["group", "attribute", "meaning"], rows)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _table(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows))
