"""Matrices with names of rows and columns, as PEST, PEST++ and pyemu write them.

By the name of the file: ``.jcb``, ``.jco``, ``.bin`` (PEST's binary matrix, that of PEST++ with long names, and its
dense one), ``.csv``, ``.unc`` (PEST's uncertainty file); any other is PEST's matrix file of text. Source: White et al.
(2020), Approaches to highly parameterized inversion: PEST++, USGS Techniques and Methods 7-C26, appendix B.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from en4dvar.model.programs.control_file import text_of
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.files import read_plain

BINARY = (".jcb", ".jco", ".bin")
LARGEST = 200_000_000  # bytes of a file, and numbers of a matrix times eight
SHORT, LONG = (12, 20), (200, 200)  # characters of the names of columns and rows: PEST, PEST++


@dataclass(frozen=True)
class NamedMatrix:
    """``values`` (M, K) with lower-case names of M ``rows`` and K ``columns``."""

    path: Path
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    values: Array

    def of(self, names: Sequence[str]) -> Array:
        """Columns (M, k) of ``names``. Raises :class:`ConfigError`."""
        return self.values[:, self._places(self.columns, names)]

    def covariance(self, names: Sequence[str]) -> Array:
        """The covariance (k, k) of ``names``. Raises :class:`ConfigError` where it is none."""
        part = self.of(names)[self._places(self.rows, names)]
        scale = np.sqrt(np.maximum(np.diag(part), 0.0))
        if not np.all(scale > 0) or np.any(np.abs(part - part.T) > 1e-6 * np.outer(scale, scale)):
            raise ConfigError(f"{self.path}: is no covariance of {names[0]}, …: symmetric, with variances above 0")
        return np.asarray(0.5 * (part + part.T))

    def _places(self, known: Sequence[str], names: Sequence[str]) -> list[int]:
        places = {name: i for i, name in enumerate(known)}
        if lacking := [name for name in names if name not in places]:
            raise ConfigError(f"{self.path}: lacks {lacking[0]}, one of {len(lacking)} that it must have")
        return [places[name] for name in names]


def read_matrix(path: Path) -> NamedMatrix:
    """The matrix in a file. Raises :class:`ConfigError`: unreadable, not finite, a name twice."""
    kind = path.suffix.lower()
    read = _binary if kind in BINARY else {".csv": _table, ".unc": _uncertainty}.get(kind, _text)
    not_read = retold((ValueError, IndexError), ConfigError, f"{path}: is no matrix of PEST: ")
    with retold(OSError, ConfigError, f"{path}: "), not_read:
        rows, columns, values = read(path)
    own, across = (tuple(name.strip().lower() for name in names) for names in (rows, columns))
    matrix = NamedMatrix(path, own, across, values)
    if values.shape != (len(matrix.rows), len(matrix.columns)) or not np.isfinite(values).all():
        raise ConfigError(f"{path}: holds something else than finite numbers with a name for each row and column")
    if len(set(matrix.columns)) < len(matrix.columns):
        raise ConfigError(f"{path}: a column occurs twice")
    return matrix


Read = tuple[Sequence[str], Sequence[str], Array]


def _binary(path: Path) -> Read:
    content = read_plain(path, LARGEST)
    first, second, count = (int(n) for n in np.frombuffer(content, "<i4", 3))
    n_columns, n_rows = abs(first), abs(second)
    if first == 0 and second == count:
        return _dense(content, n_rows)
    if n_columns * n_rows * 8 > LARGEST:
        raise ValueError(f"{n_rows} rows of {n_columns} numbers")
    widths, index = (SHORT, [("at", "<i4")]) if first < 0 else (LONG, [("row", "<i4"), ("column", "<i4")])
    entries = np.frombuffer(content, np.dtype([*index, ("value", "<f8")]), count, offset=12)
    down = entries["at"] - 1 if first < 0 else entries["row"] + n_rows * entries["column"]  # the columns, from 0
    values = np.zeros(n_rows * n_columns)
    values[down] = entries["value"]
    names, end = [], 12 + entries.nbytes
    for width, many in zip(widths, (n_columns, n_rows), strict=True):
        names.append([content[end + i * width : end + (i + 1) * width].decode() for i in range(many)])
        end += width * many
    return names[1], names[0], values.reshape(n_columns, n_rows).T


def _dense(content: bytes, n_columns: int) -> Read:
    """The lengths of the columns' names, these, and of each row the length of its name, this and its numbers."""
    lengths = np.frombuffer(content, "<i4", n_columns, offset=12)
    end = 12 + lengths.nbytes
    columns, rows, values = [], [], []
    for length in lengths.tolist():
        columns.append(content[end : end + length].decode())
        end += length
    while end < len(content):
        (length,) = np.frombuffer(content, "<i4", 1, offset=end).tolist()
        rows.append(content[end + 4 : end + 4 + length].decode())
        values.append(np.frombuffer(content, "<f8", n_columns, offset=end + 4 + length))
        end += 4 + length + 8 * n_columns
    return rows, columns, np.array(values)


def _table(path: Path) -> Read:
    header, *lines = (row for row in csv.reader(text_of(path).splitlines()) if row)
    return [row[0] for row in lines], header[1:], np.array([[float(cell) for cell in row[1:]] for row in lines])


def _text(path: Path) -> Read:
    """``rows columns code``, the numbers, and names; code 1 has one list of them, −1 is a diagonal."""
    body, *lists = text_of(path).split("*")
    n_rows, n_columns, code = (int(word) for word in body.split()[:3])
    numbers = np.array([float(word.lower().replace("d", "e")) for word in body.split()[3:]])
    names = [list(filter(str.strip, part.splitlines()[1:])) for part in lists] * (1 if code == 2 else 2)
    values = np.diag(numbers) if code == -1 else numbers.reshape(n_rows, n_columns)
    return names[0], names[1], values


def _uncertainty(path: Path) -> Read:
    """Blocks of standard deviations and of further matrix files."""
    names: list[str] = []
    blocks: list[Array] = []
    for kind, lines in _blocks(path):
        said = {words[0].lower(): words[1].strip("\"'") for words in lines}
        factor = float(said.pop({"standard_deviation": "std_multiplier"}.get(kind, "variance_multiplier"), 1.0))
        if kind == "standard_deviation":
            names += said
            blocks += [np.array([[(factor * float(std)) ** 2]]) for std in said.values()]
        elif kind == "covariance_matrix" and set(said) == {"file"}:
            part = read_matrix(path.parent / said["file"].replace("\\", "/"))
            names += part.rows
            blocks.append(factor * part.covariance(part.rows))
        else:
            raise ValueError(f"block {kind} with {', '.join(said)}")
    return names, names, block_diag(*blocks)


def _blocks(path: Path) -> Iterator[tuple[str, list[list[str]]]]:
    """Kind and lines of each START … END."""
    lines = [line.split("#")[0].split() for line in text_of(path).splitlines()]
    kind, own = "", list[list[str]]()
    for words in filter(None, lines):
        if words[0].lower() == "start":
            kind, own = words[1].lower(), []
        elif words[0].lower() == "end":
            yield kind, own
        else:
            own.append(words)
