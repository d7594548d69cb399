"""Control files of PEST or PEST++, version 1 or 2: sections as rows of named cells, and the matrices that they name.

These are covariances and ensembles, with names of rows and columns, as PEST, PEST++ and pyemu write them.

By the name of the file: ``.jcb``, ``.jco``, ``.bin`` (PEST's binary matrix, that of PEST++ with long names, and its
dense one), ``.csv``, ``.unc`` (PEST's uncertainty file); any other is PEST's matrix file of text. Source: White et al.
(2020), Approaches to highly parameterized inversion: PEST++, USGS Techniques and Methods 7-C26, appendix B.
"""

import csv
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.files import read_plain, read_text

KNOWN = """control data|automatic user intervention|singular value decomposition|lsqr|sensitivity reuse|svd assist
    |parameter groups|parameter data|observation groups|observation data|derivatives command line|model command line
    |model input|model output|model input/output|prior information|regularisation|regularization|predictive analysis
    |pareto|control data keyword"""  # what may stand behind a *, and with "external" be in a table of its own
_SECTIONS = {name.strip() for name in KNOWN.split("|")}
_COMMENT = re.compile(r"(^|\s)#.*")
_OPTION = re.compile(r"(\w+)\s*\(([^)]*)\)")


class PestRow(NamedTuple):
    """Cells by the names of their columns, lower case; ``where``: file and line."""

    where: str
    cells: Mapping[str, str]

    def word(self, key: str) -> str:
        """A cell in lower case, "" where there is none."""
        return self.cells.get(key, "").lower()

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number. Raises :class:`ConfigError`, also where there is none and no ``default``."""
        text = self.cells.get(key)
        if text is None and default is not None:
            return default
        try:
            value = float((text or "").lower().replace("d", "e"))
        except ValueError:
            value = float("nan")
        if not abs(value) < float("inf"):
            name = next(iter(self.cells.values()), "it")
            raise ConfigError(f"{self.where}: {text or 'nothing'!r} where {name} has a number ({key})")
        return value


@dataclass
class ControlFile:
    """The lines of each of its ``sections``, each a row with the one cell ``line``.

    ``options``: PEST++'s, name → text, lower case names.
    """

    path: Path
    sections: dict[str, list[PestRow]] = field(default_factory=lambda: defaultdict(list))
    options: dict[str, str] = field(default_factory=dict)

    def rows(self, name: str, columns: Sequence[str]) -> list[PestRow]:
        """Of a section with these columns, and of its external tables. Raises :class:`ConfigError`."""
        lines = ((row.where, row.cells["line"].split()) for row in self.sections[name])
        inline = [PestRow(where, dict(zip(columns, cells, strict=False))) for where, cells in lines]
        return inline + self.tables(name)

    def tables(self, name: str) -> list[PestRow]:
        """The rows of the external tables of a section. Raises :class:`ConfigError`."""
        return [row for line in self.sections[f"{name} external"] for row in self._table(line)]

    def number(self, option: str, default: float) -> float:
        """A positive number among the options. Raises :class:`ConfigError`."""
        value = PestRow(f"{self.path}: {option}", self.options).number(option, default)
        if not value > 0:
            raise ConfigError(f"{self.path}: {option} is {value:g}; it must be positive")
        return value

    def file(self, text: str) -> Path:
        """A file beside the control file; names may be those of Windows."""
        return self.path.parent / text.strip("\"'").replace("\\", "/")

    def _table(self, line: PestRow) -> Iterator[PestRow]:
        """The rows of ``table.csv [sep w] [missing_value text]``."""
        name, *words = line.cells["line"].split()
        told = dict(zip([word.lower() for word in words[::2]], words[1::2], strict=False))
        path, sep = self.file(name), told.get("sep", ",").lower()
        rows = [(n, text) for n, text in enumerate(text_of(path).splitlines(), 1) if text.strip() and text[0] != "#"]
        cells = [t.split() for _, t in rows] if sep == "w" else list(csv.reader((t for _, t in rows), delimiter=sep))
        header = [cell.strip().lower() for cell in cells[0]] if cells else []
        for (number, _), row in zip(rows[1:], cells[1:], strict=True):
            if len(row) != len(header):
                raise ConfigError(f"{path}:{number}: {len(row)} cells, but {len(header)} columns")
            missing = ("", told.get("missing_value", ""))
            named = zip(header, (cell.strip() for cell in row), strict=True)
            yield PestRow(f"{path}:{number}", {key: cell for key, cell in named if cell not in missing})


def read_control(path: Path) -> ControlFile:
    """The control file as it is. Raises :class:`ConfigError`: unreadable, no control file, or an unknown section."""
    lines = text_of(path).splitlines()
    if not lines or not re.match(r"pcf\b", lines[0].strip(), re.IGNORECASE):
        raise ConfigError(f"{path}: the first line of a control file is pcf")
    control = ControlFile(path)
    current: list[PestRow] = []
    for number, whole in enumerate(lines[1:], 2):
        line = _COMMENT.sub("", whole).strip()
        if line.startswith("++"):
            control.options |= {name.lower(): text.strip() for name, text in _OPTION.findall(line)}
        elif line.startswith("*"):
            name = " ".join(line[1:].lower().split())
            if name.removesuffix(" external") not in _SECTIONS:
                raise ConfigError(f"{path}:{number}: no section of a control file is called {name!r}")
            current = control.sections[name]
        elif line.startswith("&") and current:
            last = current[-1]
            current[-1] = PestRow(last.where, {"line": f"{last.cells['line']} {line[1:]}"})
        elif line:
            current.append(PestRow(f"{path}:{number}", {"line": line}))
    for row in control.sections["control data keyword"]:
        name, _, text = row.cells["line"].partition(" ")
        control.options[name.lower()] = text.strip().strip("\"'")
    for name in ("parameter data", "observation data", "model command line"):
        if not control.sections[name] and not control.sections[f"{name} external"]:
            raise ConfigError(f"{path}: no section '* {name}'")
    return control


def text_of(path: Path) -> str:
    """The text of a file. Raises :class:`ConfigError`."""
    with retold(OSError, ConfigError, f"{path}: "):
        return read_text(path)


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
    lines = [line.split("#")[0].split() for line in text_of(path).splitlines()]
    kind, own = "", list[list[str]]()
    for words in filter(None, lines):
        if words[0].lower() == "start":
            kind, own = words[1].lower(), []
        elif words[0].lower() == "end":
            yield kind, own
        else:
            own.append(words)
