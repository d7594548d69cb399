"""Numbers out of the files that a program leaves: a column, a key of JSON, a pattern, PEST's instructions."""

from __future__ import annotations

import csv
import functools
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.hints import listed, short
from en4dvar.programs import pest
from en4dvar.programs.errors import ProgramError
from en4dvar.state import Array

COMMENT = ("#", "%", "//")


@dataclass(frozen=True)
class ProgramOutput:
    """Where the values of one observable are: in ``file`` of the scratch directory, by one of the four ways.

    column: header of a column of text, or its number from 1. key: dotted path into JSON. pattern: regular expression
    with one group, every match a value. instructions: file of PEST, each of the ``observations``, by default all, a
    value. With ``time``, a column or key of times, values are interpolated linearly at those that are asked for;
    without it there is one value a time.
    """

    file: str
    column: str | int | None = None
    key: str | None = None
    pattern: str | None = None
    instructions: Path | None = None
    time: str | int | None = None
    observations: tuple[str, ...] | None = None

    def read(self, folder: Path, times: Array) -> Array:
        """The values at ``times`` (K,). Raises :class:`ProgramError`."""
        path = folder / self.file
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise ProgramError(f"no output file {self.file}: {error.strerror}") from None
        values = self._values(text)
        if self.time is None:
            if len(values) != len(times):
                raise ProgramError(
                    f"{self.file}: {len(values)} values for {len(times)} times; name the column of times"
                )
            return values
        own = _column(text, self.time, self.file) if self.column is not None else _key(text, str(self.time), self.file)
        return _at(times, own, values, self.file)

    def _values(self, text: str) -> Array:
        if self.column is not None:
            return _column(text, self.column, self.file)
        if self.key is not None:
            return _key(text, self.key, self.file)
        if self.pattern is not None:
            return _numbers(re.findall(self.pattern, text, re.MULTILINE), self.file)
        assert self.instructions is not None
        found = pest.read(_instructions(self.instructions), text, self.file)
        names = [name.lower() for name in self.observations] if self.observations is not None else list(found)
        if lacking := [name for name in names if name not in found]:
            raise ProgramError(f"{self.instructions} reads no {lacking[0]!r}")
        return np.array([found[name] for name in names])


@functools.cache
def _instructions(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _at(times: Array, own: Array, values: Array, file: str) -> Array:
    if len(own) != len(values) or len(own) < 1 or not np.all(np.diff(own) > 0):
        raise ProgramError(f"{file}: {len(own)} times for {len(values)} values, or times that do not increase")
    slack = 1e-9 * max(abs(own[0]), abs(own[-1]))
    if times[0] < own[0] - slack or times[-1] > own[-1] + slack:
        raise ProgramError(
            f"{file}: times from {own[0]:g} to {own[-1]:g}, but {times[0]:g} to {times[-1]:g} are needed"
        )
    return np.asarray(np.interp(times, own, values))


def _column(text: str, column: str | int, file: str) -> Array:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(COMMENT)]
    if not lines:
        raise ProgramError(f"{file}: is empty")
    delimiter = max((",", ";", "\t"), key=lines[0].count)
    rows = list(csv.reader(lines, delimiter=delimiter)) if delimiter in lines[0] else [line.split() for line in lines]
    header = [cell.strip() for cell in rows[0]]
    if isinstance(column, int):
        at, first = column - 1, 0 if _is_number(header[min(column, len(header)) - 1]) else 1
    elif column in header:
        at, first = header.index(column), 1
    else:
        raise ProgramError(f"{file}: no column {column!r}; the columns are: {listed(header)}")
    if at >= min(len(row) for row in rows[first:] or [header]):
        raise ProgramError(f"{file}: no column {column} in every line")
    return _numbers([row[at] for row in rows[first:]], file)


def _key(text: str, key: str, file: str) -> Array:
    try:
        node: Any = json.loads(text)
    except ValueError as error:
        raise ProgramError(f"{file}: not JSON: {error}") from None
    for part in key.split("."):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, ValueError, TypeError):
            raise ProgramError(f"{file}: no key {key!r}, for there is no {part!r}") from None
    return _numbers(node if isinstance(node, list) else [node], file)


def _numbers(found: list[Any], file: str) -> Array:
    for value in found:
        if not _is_number(value):
            raise ProgramError(f"{file}: {short(str(value))!r} is no number")
    return np.array([float(value) for value in found])


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True
