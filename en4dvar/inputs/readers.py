"""Series from data files: tables of text or of a workbook, and the ``.mat`` layouts of cavitation rheometry.

Rows that hold NaN or a blank are dropped; every remaining number must be finite and the times must increase. Fields of
``.mat`` files may be rows or columns; their leading zeros and NaN (frames before nucleation) are dropped and their
scalars collected. Leading zeros of a column that cannot be zero are dropped from CSV files too.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from en4dvar.errors import DataError
from en4dvar.hints import listed, no_such_file, suggest
from en4dvar.inputs.matfile import mat_variables
from en4dvar.inputs.order import Means, Written, in_order
from en4dvar.inputs.sheets import sheet_lines
from en4dvar.inputs.text_table import (
    Decimal,
    Table,
    cells_of,
    check_width,
    delimiter_of,
    matches,
    number_in,
    numbered_lines,
)
from en4dvar.inputs.variables import Variables, indexed
from en4dvar.state import Array
from en4dvar.units import convert

Format = Literal["csv", "mat", "xlsx"]
Disorder = Literal["refuse", "sort"]
Repeated = Literal["refuse", "average"]
_TEXT: Mapping[str, Format] = {".csv": "csv", ".txt": "csv", ".dat": "csv", ".tsv": "csv"}
SUFFIXES: Mapping[str, Format] = {**_TEXT, ".mat": "mat", ".xlsx": "xlsx", ".xlsm": "xlsx"}
SHEETS = (".xls", ".xlsb", ".ods")


@dataclass(frozen=True)
class Column:
    """A column or field ``name`` written in ``unit``, wanted in ``target``.

    ``positive``: zeros before its first reading are none. ``kind``: what its numbers must be, beside the readings.
    ``rate``: of times, that of the frames per ``target``.
    """

    name: str
    unit: str
    target: str
    positive: bool = False
    kind: Literal["std", "weight", "place"] = "std"
    rate: float | None = None


@dataclass(frozen=True)
class TimeStep:
    """Uniform times from zero at the first sample: ``value``, or the file's scalar ``column``."""

    column: Column | None = None
    value: float = 0.0


@dataclass(frozen=True)
class DataFile:
    """Where one data set is: a file, or of a file that holds several the ``part``, as :func:`parts_of` names it.

    ``others``: where its further series are.
    """

    path: Path
    part: str = ""
    others: tuple[DataFile, ...] = ()

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
    is done with times that do not increase."""

    format: Format | None = None
    decimal: Decimal = "."
    by: str | None = None
    sheet: str = ""
    unsorted: Disorder = "refuse"
    repeated: Repeated = "refuse"


ANY = Layout()


@dataclass(frozen=True)
class Readings:
    """One observable in time, in the model's units, times increasing; ``scalars`` as the file has them.

    ``errors`` are the columns that were asked for besides, by name, one number a reading.
    """

    times: Array
    values: Array
    source: str
    scalars: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, Array] = field(default_factory=dict)


def read_series(
    path: Path,
    time: Column | TimeStep,
    value: Column,
    layout: Layout = ANY,
    errors: Sequence[Column] = (),
    part: str = "",
    repeats: bool = False,
    fewest: int = 3,
) -> Readings:
    """Read one data set.

    ``errors`` are columns of standard deviations (or weights, or places), each as long as that of the values.
    ``part``: see :func:`parts_of`. ``repeats``: there may be several readings at a time, in any order of times.
    ``fewest`` usable readings are needed.

    Raises
    ------
    DataError: the file cannot be used.
    """
    if part and layout.by is None and "*" in value.name:
        value = replace(value, name=part)
    wanted = [c.name for c in (value, time, *errors) if isinstance(c, Column)]
    columns, scalars, lines = _columns(path, layout, wanted, part)
    values = convert(columns[value.name], value.unit, value.target)
    if isinstance(time, Column):
        times = convert(columns[time.name], time.unit, time.target)
    else:
        times = np.asarray(_step(time, scalars, path) * np.arange(len(values)), dtype=float)
    if not len(values):
        raise DataError(f"{path}: {value.name!r} is empty")
    if len(times) != len(values):
        raise DataError(f"{path}: {len(times)} times but {len(values)} values of {value.name!r}")
    first = 0 if lines and not value.positive else int(np.argmax(np.nan_to_num(values) != 0))
    kept = np.arange(first, len(values))[~(np.isnan(times) | np.isnan(values))[first:]]
    _check(times[kept], values[kept], value.name, path, fewest)
    if repeats:
        kept = kept[np.argsort(times[kept], kind="stable")]
    stated = {column.name: _stds(columns[column.name], column, kept, len(values), path) for column in errors}
    if isinstance(time, Column) and not repeats:
        written = Written(columns[time.name], time.unit, lines, path)
        order = in_order(times[kept], layout.unsorted == "sort", layout.repeated == "average", kept, written)
        kept, stated = kept[order], {name: stds[order] for name, stds in stated.items()}
    if repeats:
        return Readings(times[kept], values[kept], str(path), scalars, stated)
    means = Means(times[kept])
    stated = {c.name: (means.std if c.kind == "std" else means.of)(stated[c.name]) for c in errors}
    return Readings(means.times, means.of(values[kept]), str(path), scalars, stated)


def _columns(
    path: Path, layout: Layout, wanted: Sequence[str], part: str
) -> tuple[dict[str, Array], Mapping[str, float], list[int]]:
    """The columns wanted of a part, the file's scalars, and the numbers of the lines, none where it has no lines."""
    with _opened(path, layout) as kind:
        if kind != "mat":
            table = _table(path, kind, layout, [*wanted, *([layout.by] if layout.by is not None else [])])
            if layout.by is not None:
                if part not in _groups(table, layout.by):
                    raise DataError(f"{path}: no row belongs to {part!r} by column {layout.by!r}")
                at = table.position(layout.by)
                table.rows = [(line, row) for line, row in table.rows if _cell(row, at) == part]
            return _of_table(table, wanted), {}, [line for line, _ in table.rows]
        _refuse_by(path, layout)
        found = mat_variables(path).of(part)
        return {name: _of_mat(found, name, path) for name in wanted}, found.scalars, []


def _stds(written: Array, column: Column, kept: npt.NDArray[np.intp], count: int, path: Path) -> Array:
    """What belongs to the kept readings: standard deviations, weights or places.

    Raises :class:`DataError` where one is missing, or of the wrong sign.
    """
    if len(written) != count:
        raise DataError(f"{path}: {len(written)} values of {column.name!r} but {count} readings")
    stds = np.asarray(convert(written[kept], column.unit, column.target))
    fits = {"std": stds > 0, "weight": stds >= 0, "place": np.isfinite(stds)}[column.kind]
    wrong = np.flatnonzero(~(np.isfinite(stds) & fits))
    if len(wrong):
        said, sign = written[kept[wrong[0]]], {"std": "not positive", "weight": "negative", "place": "not finite"}
        what = "is blank" if np.isnan(said) else f"is {said:g}, {sign[column.kind]}"
        noun = {"std": "error"}.get(column.kind, column.kind)
        raise DataError(f"{path}: the {noun} of reading {kept[wrong[0]] + 1} in column {column.name!r} {what}")
    return stds


def parts_of(path: Path, value: Column, layout: Layout = ANY, time: str | None = None) -> tuple[str, ...]:
    """The parts of a file that each hold a data set; () where the file is one data set.

    They are the columns that a name with ``*`` stands for, but not that of the ``time``; the elements of a struct array
    or a cell array, as ``1``, ``2``, …, for the column ``expts.R`` of what MATLAB calls ``expts(1).R``,
    ``expts(2).R``, …; or what the column ``by`` of a table says. Raises :class:`DataError`.
    """
    several = "*" in value.name
    with _opened(path, layout) as kind:
        if kind != "mat":
            table = _table(path, kind, layout, [value.name, *(one for one in (time, layout.by) if one is not None)])
            if layout.by is not None:
                return _groups(table, layout.by)
            if not several or value.name in table.names:
                return ()
            return tuple(name for name in table.names if matches(name, value.name) and name != time)
        _refuse_by(path, layout)
        found = mat_variables(path)
    if several:
        return tuple(name for name in found.matching(value.name) if name != time)
    if found.vector(value.name) is not None:
        return ()
    return tuple(i for name, i in map(indexed, found.vectors) if i and name == value.name)


def _table(path: Path, kind: Format, layout: Layout, wanted: Sequence[str] = ()) -> Table:
    if kind == "csv":
        return Table(path, layout.decimal, wanted)
    return Table(path, layout.decimal, wanted, sheet_lines(path, layout.sheet))


def _refuse_by(path: Path, layout: Layout) -> None:
    if layout.by is not None:
        raise DataError(f"{path}: data.by is for tables; elements of a struct array are data sets without it")


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
    with _opened(path, layout) as kind:
        return _mat_contents(path) if kind == "mat" else _table_contents(_table(path, kind, layout))


def _mat_contents(path: Path) -> Contents:
    found = mat_variables(path).of_first()
    columns = found.columns()
    words = {name: f"{path}: {name} is {kind}; save what is in it as vectors" for name, kind in found.others.items()}
    words |= {
        name: f"{path}: {name} is {found.others[name]}; its columns are {name}(:,1), {name}(:,2), …, its rows "
        f"{name}(1,:), …"
        for name in found.matrices
    }
    for name in columns:  # a struct of which something can be read is no fault
        words.pop(name.partition(".")[0], None)
    return Contents(columns, found.scalars, words)


def _table_contents(table: Table) -> Contents:
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
    return Contents(columns, {}, others)


def read_covariance(matrix: Matrix) -> Array:
    """The covariance (K, K) of a CSV file: symmetric, positive variances. Raises :class:`DataError`."""
    path, values = matrix.path, read_square(matrix.path, "covariance")
    if not np.all(np.isfinite(values)) or not np.all(np.diag(values) > 0):
        raise DataError(f"{path}: the variances must be positive and every covariance finite")
    scale = np.sqrt(np.outer(np.diag(values), np.diag(values)))
    unequal = np.argwhere(np.abs(values - values.T) > 1e-9 * scale)
    if len(unequal):
        i, j = unequal[0]
        raise DataError(
            f"{path}: not symmetric: {values[i, j]:g} in row {i + 1}, column {j + 1}, {values[j, i]:g} across"
        )
    return np.asarray(convert(0.5 * (values + values.T), matrix.unit, matrix.target))


def read_square(path: Path, what: str = "correlation matrix") -> Array:
    """The numbers (K, K) of a CSV file without header. Raises :class:`DataError`."""
    _require_file(path)
    with _readable(path):
        rows = _rows_of_numbers(path)
    if not rows or len(rows) != len(rows[0]):
        raise DataError(f"{path}: a {what} is square, but this has {len(rows)} rows of {len(rows[0]) if rows else 0}")
    return np.array(rows)


def _rows_of_numbers(path: Path) -> list[list[float]]:
    """Rows of equally many numbers."""
    rows: list[list[float]] = []
    delimiter = None
    for number, line in numbered_lines(path):
        if delimiter is None:
            delimiter = delimiter_of(line)
            check_width(line, delimiter, path)
        rows.append(
            [number_in(cell, str(i), path, number, None) for i, cell in enumerate(cells_of(line, delimiter), 1)]
        )
        if len(rows[-1]) != len(rows[0]):
            raise DataError(f"{path}:{number}: {len(rows[-1])} numbers, but {len(rows[0])} in the first row")
    return rows


@contextmanager
def _opened(path: Path, layout: Layout) -> Iterator[Format]:
    """The format of a file that is there. Raises :class:`DataError`, also where reading inside fails."""
    _require_file(path)
    kind = layout.format or SUFFIXES.get(path.suffix.lower())
    if kind is None:
        hint = (
            "save the sheet as CSV"
            if path.suffix.lower() in SHEETS
            else f"write format: {' or '.join(get_args(Format))}"
        )
        raise DataError(f"{path}: the format cannot be told from the suffix {path.suffix!r}; {hint}")
    with _readable(path):
        yield kind


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Whatever goes wrong in the system or in the csv module as :class:`DataError`."""
    try:
        yield
    except (OSError, csv.Error) as error:
        raise DataError(f"{path}: {getattr(error, 'strerror', None) or error}") from None


def _require_file(path: Path) -> None:
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long, or in a closed folder
        raise DataError(f"{path}: is a directory" if os.path.isdir(path) else no_such_file(path))


def _check(times: Array, values: Array, name: str, path: Path, fewest: int) -> None:
    if not len(values) or not np.any(values):
        raise DataError(f"{path}: {name!r} holds no usable value (all NaN, blank or zero)")
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
        raise DataError(f"{path}: infinite values")
    if len(values) < fewest:
        raise DataError(f"{path}: {len(values)} usable observations; at least {fewest} are needed")


def _step(step: TimeStep, scalars: Mapping[str, float], path: Path) -> float:
    if step.column is None:
        value = step.value
    elif step.column.name not in scalars:
        raise DataError(f"{path}: no scalar {step.column.name!r} for the time step{suggest(step.column.name, scalars)}")
    else:
        value = convert(scalars[step.column.name], step.column.unit, step.column.target)
    if not value > 0:
        raise DataError(f"{path}: the time step {value:g} is not positive")
    return value


def _groups(table: Table, by: str) -> tuple[str, ...]:
    """What the column ``by`` says, in the order of the rows. Raises :class:`DataError`."""
    cells = [_cell(row, table.position(by)) for _, row in table.rows]
    if "" in cells:
        line = table.rows[cells.index("")][0]
        raise DataError(f"{table.path}:{line}: column {by!r} does not say which data set this is")
    return tuple(dict.fromkeys(cells))


def _cell(row: Sequence[str], i: int) -> str:
    return row[i] if i < len(row) else ""


def _of_table(table: Table, wanted: Sequence[str]) -> dict[str, Array]:
    where = {name: table.position(name) for name in wanted}
    if not table.rows:
        raise DataError(f"{table.path}: no data: no line follows the header")
    columns = {name: table.numbers(i, name) for name, i in where.items()}
    for line, cells in table.rows:
        if any(cells[len(table.names) :]):
            raise DataError(f"{table.path}:{line}: {len(cells)} cells, but the header names {len(table.names)} columns")
    return columns


def _of_mat(found: Variables, name: str, path: Path) -> Array:
    """A vector by its name. Raises :class:`DataError`."""
    vector = found.vector(name)
    if vector is not None:
        return np.asarray(vector, dtype=float)
    kind = found.others.get(name)
    fault = f"is {kind}, not a row or column of real numbers" if kind else "is not in the file"
    rest = [f"{k} ({what})" for k, what in found.others.items() if k != name]
    there = f"{listed(sorted(found.vectors)) or 'none'}{'; no vectors: ' * bool(rest)}{listed(rest)}"
    matrix = name if name in found.matrices else next(iter(found.matrices), None)
    hint = f"; columns of a matrix are {matrix}(:,1), {matrix}(:,2), …" if matrix else ""
    raise DataError(f"{path}: field {name!r} {fault}; the vectors are: {there}{hint}")
