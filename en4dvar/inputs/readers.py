"""Series from data files: CSV with a header, and the ``.mat`` layouts of cavitation rheometry.

Rows that hold NaN or a blank are dropped; every remaining number must be finite and the times must increase. Fields of
``.mat`` files may be rows or columns; their leading zeros and NaN (frames before nucleation) are dropped and their
scalars collected.
"""

from __future__ import annotations

import csv
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from en4dvar.commands.hints import no_such_file, suggest
from en4dvar.errors import DataError
from en4dvar.inputs.units import convert
from en4dvar.state import Array

Format = Literal["csv", "mat"]
SUFFIXES: Mapping[str, Format] = {".csv": "csv", ".txt": "csv", ".dat": "csv", ".tsv": "csv", ".mat": "mat"}
COMMENT = ("#", "%", "//")
COMPRESSED = 15  # miCOMPRESSED of the MAT-file format, level 5
BLANK = ("", "nan", "na", "n/a", "-")


@dataclass(frozen=True)
class Column:
    """A column or field ``name`` written in ``unit``, wanted in ``target``."""

    name: str
    unit: str
    target: str


@dataclass(frozen=True)
class Step:
    """Uniform times from zero at the first sample: ``value``, or the file's scalar ``column``."""

    column: Column | None = None
    value: float = 0.0


@dataclass(frozen=True)
class Matrix:
    """A square table of numbers without header in ``unit``, wanted in ``target``."""

    path: Path
    unit: str
    target: str


@dataclass(frozen=True)
class Series:
    """One observable in time, in the model's units, times increasing; ``scalars`` as the file has them."""

    times: Array
    values: Array
    source: str
    scalars: Mapping[str, float] = field(default_factory=dict)


def read_series(path: Path, time: Column | Step, value: Column, format: Format | None = None) -> Series:
    """Read one data set. ``format`` defaults to the one of the suffix. Raises :class:`DataError`."""
    kind = _kind(path, format)
    wanted = [c.name for c in (value, time if isinstance(time, Column) else None) if c is not None]
    try:
        columns, scalars = _read_csv(path, wanted) if kind == "csv" else _read_mat(path, wanted)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}") from None
    values = convert(columns[value.name], value.unit, value.target)
    if isinstance(time, Column):
        times = convert(columns[time.name], time.unit, time.target)
    else:
        times = np.asarray(_step(time, scalars, path) * np.arange(len(values)), dtype=float)
    if len(times) != len(values):
        raise DataError(f"{path}: {len(times)} times but {len(values)} values of {value.name!r}")
    first = int(np.argmax(np.nan_to_num(values) != 0)) if kind == "mat" else 0
    return _clean(times[first:], values[first:], value.name, path, scalars)


@dataclass(frozen=True)
class Contents:
    """What a data file holds: columns (or vectors) with numbers, as written, and scalars; no units applied."""

    columns: Mapping[str, Array]
    scalars: Mapping[str, float] = field(default_factory=dict)


def read_contents(path: Path, format: Format | None = None) -> Contents:
    """Every column that holds numbers. Raises :class:`DataError`."""
    kind = _kind(path, format)
    try:
        return _mat_contents(path) if kind == "mat" else _csv_contents(path)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}") from None


def _mat_contents(path: Path) -> Contents:
    vectors, scalars = _mat_vectors(path)
    return Contents({k: np.asarray(v, dtype=float).ravel() for k, v in vectors.items() if v.size > 1}, scalars)


def _csv_contents(path: Path) -> Contents:
    lines = _lines(path)
    if not lines:
        raise DataError(f"{path}: the file holds no data")
    delimiter = _delimiter(lines[0][1])
    names = _cells(lines[0][1], delimiter)
    if all(_is_number(n) for n in names):
        raise DataError(f"{path}: the first line must name the columns, but it holds numbers")
    rows = [_cells(line, delimiter) for _, line in lines[1:]]
    columns: dict[str, Array] = {}
    for i, name in enumerate(names):
        cells = [row[i] if i < len(row) else "" for row in rows]
        numbers = [c if c.lower() not in BLANK else "nan" for c in cells]
        if numbers and all(_is_number(n) for n in numbers):
            columns[name] = np.array([float(n) for n in numbers])
    return Contents(columns)


def read_covariance(matrix: Matrix) -> Array:
    """The covariance (K, K) of a CSV file: symmetric, positive variances. Raises :class:`DataError`."""
    path = matrix.path
    if not path.is_file():
        raise DataError(f"{path}: is a directory" if path.is_dir() else no_such_file(path))
    rows: list[list[float]] = []
    delimiter = None
    for number, line in _lines(path):
        delimiter = _delimiter(line) if delimiter is None else delimiter
        rows.append([_number(cell, str(i), path, number) for i, cell in enumerate(_cells(line, delimiter), 1)])
        if len(rows[-1]) != len(rows[0]):
            raise DataError(f"{path}:{number}: {len(rows[-1])} numbers, but {len(rows[0])} in the first row")
    if not rows or len(rows) != len(rows[0]):
        raise DataError(
            f"{path}: a covariance is square, but this has {len(rows)} rows of {len(rows[0]) if rows else 0}"
        )
    values = np.array(rows)
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


def _kind(path: Path, format: Format | None) -> Format:
    """The format of a file that is there. Raises :class:`DataError`."""
    if not path.is_file():
        raise DataError(f"{path}: is a directory" if path.is_dir() else no_such_file(path))
    kind = format or SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise DataError(f"{path}: the format cannot be told from the suffix {path.suffix!r}; write format: csv or mat")
    return kind


def _clean(times: Array, values: Array, name: str, path: Path, scalars: Mapping[str, float]) -> Series:
    if not len(values):
        raise DataError(f"{path}: no data")
    keep = ~(np.isnan(times) | np.isnan(values))
    times, values = times[keep], values[keep]
    if not len(values) or not np.any(values):
        raise DataError(f"{path}: {name!r} holds no usable value (all NaN, blank or zero)")
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
        raise DataError(f"{path}: infinite values")
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if len(wrong):
        a, b = times[wrong[0]], times[wrong[0] + 1]
        raise DataError(f"{path}: times must increase, but usable sample {wrong[0] + 1} at {a:g} is followed by {b:g}")
    if len(values) < 3:
        raise DataError(f"{path}: {len(values)} usable observations; at least 3 are needed")
    return Series(times, values, str(path), scalars)


def _step(step: Step, scalars: Mapping[str, float], path: Path) -> float:
    if step.column is None:
        value = step.value
    elif step.column.name not in scalars:
        raise DataError(f"{path}: no scalar {step.column.name!r} for the time step{suggest(step.column.name, scalars)}")
    else:
        value = convert(scalars[step.column.name], step.column.unit, step.column.target)
    if not value > 0:
        raise DataError(f"{path}: the time step {value:g} is not positive")
    return value


def _read_csv(path: Path, wanted: Sequence[str]) -> tuple[dict[str, Array], dict[str, float]]:
    lines = _lines(path)
    if not lines:
        raise DataError(f"{path}: the file holds no data")
    delimiter = _delimiter(lines[0][1])
    names = _cells(lines[0][1], delimiter)
    where = {name: _position(path, names, name) for name in wanted}
    columns: dict[str, list[float]] = {name: [] for name in wanted}
    for number, line in lines[1:]:
        cells = _cells(line, delimiter)
        for name, i in where.items():
            columns[name].append(_number(cells[i] if i < len(cells) else "", name, path, number))
        if any(cells[len(names) :]):
            raise DataError(f"{path}:{number}: {len(cells)} cells, but the header names {len(names)} columns")
    return {name: np.array(column, dtype=float) for name, column in columns.items()}, {}


def _lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines that are neither blank nor comments."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{path}: not a text file") from None
    return [(n, s) for n, s in enumerate(text.splitlines(), 1) if s.strip() and not s.lstrip().startswith(COMMENT)]


def _delimiter(line: str) -> str:
    """What separates the cells; "" for blanks."""
    delimiter = max((",", ";", "\t"), key=line.count)
    return delimiter if delimiter in line else ""


def _cells(line: str, delimiter: str) -> list[str]:
    if not delimiter:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _position(path: Path, names: list[str], name: str) -> int:
    if all(_is_number(n) for n in names):
        raise DataError(f"{path}: the first line must name the columns, but it holds numbers")
    if names.count(name) != 1:
        fault = "no column" if name not in names else "more than one column"
        raise DataError(f"{path}: {fault} {name!r}; the columns are: {', '.join(names)}")
    return names.index(name)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(cell: str, name: str, path: Path, line: int) -> float:
    if cell.lower() in BLANK:
        return float("nan")
    if not _is_number(cell):
        hint = "; write a decimal point" if "," in cell and _is_number(cell.replace(",", ".")) else ""
        raise DataError(f"{path}:{line}: {cell!r} in column {name!r} is not a number{hint}")
    return float(cell)


def _read_mat(path: Path, wanted: Sequence[str]) -> tuple[dict[str, Array], dict[str, float]]:
    vectors, scalars = _mat_vectors(path, wanted)
    return {name: np.asarray(vectors[name], dtype=float).ravel() for name in wanted}, scalars


def _mat_vectors(path: Path, wanted: Sequence[str] = ()) -> tuple[dict[str, Any], dict[str, float]]:
    """Real vectors of a ``.mat`` file, those ``wanted`` among them, and its finite scalars."""
    from scipy.io import loadmat

    raw = path.read_bytes()  # scipy's reader may take the whole process down with a damaged file
    if not raw.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        raise DataError(f"{path}: not a MATLAB v5 file (no such header); save it in MATLAB with save(..., '-v7')")
    if raw.startswith(b"MATLAB 5.0") and _damaged(raw):
        raise DataError(f"{path}: not a MATLAB v5 file (a compressed variable is damaged)")
    try:
        content = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
    except NotImplementedError:
        raise DataError(f"{path}: a MATLAB v7.3 (HDF5) file; save it again in MATLAB with save(..., '-v7')") from None
    except PermissionError:
        raise
    except Exception as error:  # a damaged file may raise anything (zlib, struct, the reader's own)
        raise DataError(f"{path}: not a MATLAB v5 file ({error})") from None
    vectors = {k: v for k, v in content.items() if _is_vector(v)}
    for name in wanted:
        if name not in vectors:
            fault = "is not a row or column of real numbers" if name in content else "is not in the file"
            raise DataError(f"{path}: field {name!r} {fault}; the vectors are: {', '.join(sorted(vectors)) or 'none'}")
    return vectors, {k: float(v.flat[0]) for k, v in vectors.items() if v.size == 1 and np.isfinite(v.flat[0])}


def _damaged(content: bytes) -> bool:
    """Whether a compressed variable of a v5 file does not unpack to its end with the right checksum."""
    order = "<" if content[126:128] == b"IM" else ">"
    at = 128
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        at += 8
        if kind == 0:
            break  # padding
        if kind == COMPRESSED:
            packed = zlib.decompressobj()
            rest = content[at : at + size]
            try:
                while rest and not packed.eof:
                    packed.decompress(rest, 1 << 20)
                    rest = packed.unconsumed_tail
            except zlib.error:
                return True
            if not packed.eof:
                return True
        at += size
    return False


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.size == max(value.shape, default=0)
