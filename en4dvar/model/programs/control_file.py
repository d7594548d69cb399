"""The sections of a control file of PEST or PEST++, version 1 or 2, as rows of named cells; nothing is interpreted."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.files import read_text

PARAMETERS = ["parnme", "partrans", "parchglim", "parval1", "parlbnd", "parubnd", "pargp", "scale", "offset", "dercom"]
OBSERVATIONS = ["obsnme", "obsval", "weight", "obgnme"]
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
    """What stands in it. ``options``: PEST++'s, name → text, lower case names."""

    path: Path
    sections: dict[str, list[PestRow]] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)

    def lines(self, name: str) -> list[PestRow]:
        """The lines of a section, each a row with the one cell ``line``."""
        return self.sections.get(name, [])

    def rows(self, name: str, columns: Sequence[str]) -> list[PestRow]:
        """Of a section with these columns, and of its external tables. Raises :class:`ConfigError`."""
        inline = (PestRow(r.where, dict(zip(columns, r.cells["line"].split(), strict=False))) for r in self.lines(name))
        return [*inline, *self.tables(name)]

    def tables(self, name: str) -> list[PestRow]:
        """The rows of the external tables of a section. Raises :class:`ConfigError`."""
        return [row for line in self.lines(f"{name} external") for row in self._table(line)]

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
            current = control.sections.setdefault(name, [])
        elif line.startswith("&") and current:
            last = current[-1]
            current[-1] = PestRow(last.where, {"line": f"{last.cells['line']} {line[1:]}"})
        elif line:
            current.append(PestRow(f"{path}:{number}", {"line": line}))
    for row in control.lines("control data keyword"):
        name, _, text = row.cells["line"].partition(" ")
        control.options[name.lower()] = text.strip().strip("\"'")
    for name in ("parameter data", "observation data", "model command line"):
        if not control.lines(name) and not control.lines(f"{name} external"):
            raise ConfigError(f"{path}: no section '* {name}'")
    return control


def text_of(path: Path) -> str:
    """The text of a file. Raises :class:`ConfigError`."""
    with retold(OSError, ConfigError, f"{path}: "):
        return read_text(path)
