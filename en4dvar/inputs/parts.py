"""What is asked of a data file (columns in their units, how it is laid out), its parts that each hold a data set, and
the columns of one of them.

A file must be there and of a known format; whatever goes wrong in reading it is one kind of error.
"""

import csv
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from en4dvar.inputs.decimal_sign import Decimal
from en4dvar.inputs.formats import SUFFIXES, Disorder, Format, Outliers, Repeated
from en4dvar.inputs.matfile import Variables, indexed, mat_variables
from en4dvar.inputs.text_table import Table, scalars_in, sheet_lines
from en4dvar.inputs.window import BY_NAME, Instant
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.hints import listed, matches

VARIABLES: dict[str, Callable[[Path], Variables]] = {"mat": mat_variables}  # format → reader; the others are tables
SHEETS = (".xls", ".xlsb", ".ods")


@dataclass(frozen=True)
class Column:
    """A column or field ``name`` written in ``unit``, wanted in ``target``.

    ``positive``: numbers of 0 or below are no readings. ``kind``: what its numbers must be, beside the readings.
    ``rate``: of times, that of the frames per ``target``.
    """

    name: str
    unit: str
    target: str
    positive: bool = False
    kind: Literal["std", "shared", "weight", "place", "mark"] = "std"
    rate: float | None = None


@dataclass(frozen=True)
class TimeStep:
    """Uniform times from zero at the first sample: ``value``, or the file's scalar ``column``."""

    column: Column | None = None
    value: float = 0.0


@dataclass(frozen=True, slots=True)  # of 10⁵ data sets all are in memory
class DataFile:
    """Where one data set is: a file, or of a file that holds several the ``part``, as :func:`parts_of` names it.

    ``others``: where its further series are.
    """

    path: Path
    part: str = ""
    others: "tuple[DataFile, ...]" = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files of all its series, each once."""
        return tuple(dict.fromkeys((self.path, *(path for other in self.others for path in other.paths))))


@dataclass(frozen=True)
class Matrix:
    """A square table of numbers without header in ``unit``, wanted in ``target``."""

    path: Path
    unit: str
    target: str


@dataclass(frozen=True)
class Layout:
    """How a file is laid out: its ``format`` (by default that of the suffix), the ``decimal`` sign of its text, the
    column that says ``by`` which data set a row belongs to, the ``sheet`` of a workbook with or without a range; what
    is done with times that do not increase and with readings that their neighbours refute; from which instant on it
    is read."""

    format: Format | None = None
    decimal: Decimal = "."
    by: str | None = None
    sheet: str = ""
    unsorted: Disorder = "refuse"
    repeated: Repeated = "refuse"
    outliers: Outliers = "keep"
    since: Instant = BY_NAME["start"]


ANY = Layout()


@contextmanager
def opened(path: Path, layout: Layout) -> Iterator[Format]:
    """The format of a file that is there. Raises :class:`DataError`, also where reading inside fails."""
    kind = format_of(path, layout)
    if kind is None and os.path.isfile(path):  # Path.is_file raises for a name that is too long, or in a closed folder
        said = f"say what it is (data.format: {', '.join(get_args(Format))})"
        hint = "save the sheet as CSV" if path.suffix.lower() in SHEETS else said
        raise DataError(f"{path}: the format cannot be told from the suffix {path.suffix!r}; {hint}")
    with readable(path):
        yield kind or "csv"  # to open it tells what is there instead of a file


def format_of(path: Path, layout: Layout) -> Format | None:
    """As it is said, else that of the suffix, where it is known."""
    return layout.format or SUFFIXES.get(path.suffix.lower())


def readable(path: Path) -> AbstractContextManager[None]:
    """Whatever goes wrong in the system or in the csv module as :class:`DataError`."""
    return retold((OSError, csv.Error), DataError, f"{path}: ")


def columns_of(
    path: Path, layout: Layout, wanted: Sequence[str], part: str
) -> tuple[dict[str, Array], Mapping[str, float], list[int]]:
    """The columns wanted of a part, the file's scalars, and the numbers of the lines, none where it has no lines."""
    with opened(path, layout) as kind:
        if kind not in VARIABLES:
            table = table_of(path, kind, layout, [*wanted, *([layout.by] if layout.by is not None else [])])
            if layout.by is not None:
                if part not in _groups(table, layout.by):
                    raise DataError(f"{path}: no row belongs to {part!r} by column {layout.by!r}")
                at = table.position(layout.by)
                table.rows = [(line, row) for line, row in table.rows if cell(row, at) == part]
            scalars = scalars_in(path) if kind == "csv" else {}
            scalars |= _constant(table) if layout.by is not None else {}
            return _of_table(table, wanted), scalars, [line for line, _ in table.rows]
        variables = _variables(path, kind, layout).of(part)
        return {name: _column(variables, name, path) for name in wanted}, variables.scalars, []


def parts_of(path: Path, value: Column, layout: Layout = ANY, time: str | None = None) -> tuple[str, ...]:
    """The parts of a file that each hold a data set; () where the file is one data set.

    They are the columns that a name with ``*`` stands for, but not that of the ``time``; the elements of a struct array
    or a cell array, as ``1``, ``2``, …, for the column ``expts.R`` of what MATLAB calls ``expts(1).R``,
    ``expts(2).R``, …; or what the column ``by`` of a table says. Raises :class:`DataError`.
    """
    several = "*" in value.name
    if layout.by is None and not several and format_of(path, layout) not in (None, *VARIABLES):
        return ()  # whatever is in the file: of 10⁵ files each is opened where it is estimated
    with opened(path, layout) as kind:
        if kind not in VARIABLES:
            table = table_of(path, kind, layout, [value.name, *(c for c in (time, layout.by) if c is not None)])
            if layout.by is not None:
                return _groups(table, layout.by)
            if not several or value.name in table.names:
                return ()
            return tuple(name for name in table.names if matches(name, value.name) and name != time)
        variables = _variables(path, kind, layout)
    if several:
        return tuple(name for name in variables.matching(value.name) if name != time)
    if variables.vector(value.name) is not None:
        return ()
    return tuple(i for name, i in map(indexed, variables.vectors) if i and name == value.name)


def table_of(path: Path, kind: Format, layout: Layout, wanted: Sequence[str] = ()) -> Table:
    return Table(path, layout.decimal, wanted, None if kind == "csv" else sheet_lines(path, layout.sheet))


def _variables(path: Path, kind: Format, layout: Layout) -> Variables:
    if layout.by is not None:
        raise DataError(f"{path}: data.by is for tables; elements of a struct array are data sets without it")
    return VARIABLES[kind](path)


def _groups(table: Table, by: str) -> tuple[str, ...]:
    """What the column ``by`` says, in the order of the rows. Raises :class:`DataError`."""
    cells = [cell(row, table.position(by)) for _, row in table.rows]
    if "" in cells:
        line = table.rows[cells.index("")][0]
        raise DataError(f"{table.path}:{line}: column {by!r} does not say which data set this is")
    return tuple(dict.fromkeys(cells))


def _constant(table: Table) -> dict[str, float]:
    """Columns of numbers that are the same in all rows of a data set: they belong to it, as a radius at rest does."""
    held: dict[str, float] = {}
    for i, name in enumerate(table.names):
        cells = {cell(row, i) for _, row in table.rows}
        with suppress(DataError):
            held |= {name: float(table.numbers(i, name)[0])} if len(cells) == 1 else {}
    return {name: value for name, value in held.items() if math.isfinite(value)}


def cell(row: Sequence[str], i: int) -> str:
    """The cell ``i`` of a row, "" where the row is shorter."""
    return row[i] if i < len(row) else ""


def _of_table(table: Table, wanted: Sequence[str]) -> dict[str, Array]:
    where = {name: table.position(name) for name in wanted}
    columns = {name: table.numbers(i, name) for name, i in where.items()}
    for line, cells in table.rows:
        if any(cells[len(table.names) :]):
            raise DataError(
                f"{table.path}:{line}: {len(cells)} cells, but the header names {len(table.names)} columns; a comma "
                "or a blank within a number is to be deleted, or the number quoted"
            )
    return columns


def _column(variables: Variables, name: str, path: Path) -> Array:
    vector = variables.vector(name)
    if vector is not None:
        return np.asarray(vector, dtype=float)
    kind = variables.others.get(name)
    fault = f"is {kind}, not a row or column of real numbers" if kind else "is not in the file"
    rest = [f"{k} ({what})" for k, what in variables.others.items() if k != name]
    there = f"{listed(sorted(variables.vectors)) or 'none'}{'; no vectors: ' * bool(rest)}{listed(rest)}"
    matrix = name if name in variables.matrices else next(iter(variables.matrices), None)
    hint = f"; columns of a matrix are {matrix}(:,1), {matrix}(:,2), …, rows {matrix}(1,:), …" if matrix else ""
    raise DataError(f"{path}: field {name!r} {fault}; the vectors are: {there}{hint}")


@dataclass(frozen=True)
class Contents:
    """What a data file holds: columns (or vectors) with numbers, as written, and scalars; no units applied.

    ``others``: why what else is in the file cannot be a column, by name. ``units``: what a line of a table states.
    ``unsure``: of columns whose commas may as well separate thousands, such a number. Of the elements of a struct array
    or a cell array the first stands for all, as ``expts.R`` and ``C``.
    """

    columns: Mapping[str, Array]
    scalars: Mapping[str, float] = field(default_factory=dict)
    others: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    unsure: Mapping[str, str] = field(default_factory=dict)


def read_contents(path: Path, layout: Layout = ANY) -> Contents:
    """Every column that holds numbers. Raises :class:`DataError`."""
    with opened(path, layout) as kind:
        if kind in VARIABLES:
            return _variable_contents(path, VARIABLES[kind](path).of_first())
        return _table_contents(table_of(path, kind, layout), scalars_in(path) if kind == "csv" else {})


def _variable_contents(path: Path, held: Variables) -> Contents:
    columns = held.columns()
    parts = {n: f"its columns are {n}(:,1), {n}(:,2), …, its rows {n}(1,:), …" for n in held.matrices}
    otherwise = "save what is in it as vectors"
    words = {name: f"{path}: {name} is {kind}; {parts.get(name, otherwise)}" for name, kind in held.others.items()}
    for name in columns:  # a struct of which something can be read is no fault
        words.pop(name.partition(".")[0], None)
    return Contents(columns, held.scalars, words)


def _table_contents(table: Table, scalars: Mapping[str, float]) -> Contents:
    columns: dict[str, Array] = {}
    others: dict[str, str] = {}
    for i, name in enumerate(table.names):
        if name:  # none behind a delimiter that ends every line
            try:
                columns[name] = table.numbers(i, name)
            except DataError as error:
                others[name] = str(error)
    unsure = {name: it for i, name in enumerate(table.names) if name in columns and (it := table.unsure(i))}
    return Contents(columns, scalars, others, table.units, unsure)
