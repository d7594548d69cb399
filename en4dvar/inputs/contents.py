"""All that a data file holds, before anybody says what it means."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from en4dvar.inputs.asked import ANY, Layout
from en4dvar.inputs.matfile import mat_variables
from en4dvar.inputs.opened import opened
from en4dvar.inputs.parts import table_of
from en4dvar.inputs.text_table import Table, scalars_in
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError


@dataclass(frozen=True)
class Contents:
    """What a data file holds: columns (or vectors) with numbers, as written, and scalars; no units applied.

    ``others``: why what else is in the file cannot be a column, by name. Of the elements of a struct array or a cell
    array the first stands for all, as ``expts.R`` and ``C``.
    """

    columns: Mapping[str, Array]
    scalars: Mapping[str, float] = field(default_factory=dict)
    others: Mapping[str, str] = field(default_factory=dict)


def read_contents(path: Path, layout: Layout = ANY) -> Contents:
    """Every column that holds numbers. Raises :class:`DataError`."""
    with opened(path, layout) as kind:
        if kind == "mat":
            return _mat_contents(path)
        return _table_contents(table_of(path, kind, layout), scalars_in(path) if kind == "csv" else {})


def _mat_contents(path: Path) -> Contents:
    held = mat_variables(path).of_first()
    columns = held.columns()
    words = {name: f"{path}: {name} is {kind}; save what is in it as vectors" for name, kind in held.others.items()}
    words |= {
        name: f"{path}: {name} is {held.others[name]}; its columns are {name}(:,1), {name}(:,2), …, its rows "
        f"{name}(1,:), …"
        for name in held.matrices
    }
    for name in columns:  # a struct of which something can be read is no fault
        words.pop(name.partition(".")[0], None)
    return Contents(columns, held.scalars, words)


def _table_contents(table: Table, scalars: Mapping[str, float]) -> Contents:
    columns: dict[str, Array] = {}
    others: dict[str, str] = {}
    for i, name in enumerate(table.names):
        if not name:  # behind a delimiter that ends every line
            continue
        if not table.rows:
            others[name] = f"{table.path}: no line follows the header"
            continue
        try:
            columns[name] = table.numbers(i, name)
        except DataError as error:
            others[name] = str(error)
    return Contents(columns, scalars, others)
