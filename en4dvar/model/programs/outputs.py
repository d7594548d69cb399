"""Numbers out of the files that a program leaves: a column, a key of JSON, a pattern, PEST's instructions."""

from __future__ import annotations

import csv
import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.model.programs import pest
from en4dvar.model.programs.errors import ProgramError
from en4dvar.model.state import Array
from en4dvar.plumbing.decoding import Allowed, DecodeError, decoded_whole
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.files import read_text
from en4dvar.plumbing.hints import listed, short
from en4dvar.plumbing.patterns import LONGEST, matches, text_of
from en4dvar.plumbing.tables import is_number

COMMENT = ("#", "%", "//")


@dataclass(frozen=True)
class ProgramOutput:
    """Where the values of one observable are: in ``file`` of the scratch directory, by one of the four ways.

    column: header of a column of text, or its number from 1. key: dotted path into JSON. pattern: regular expression
    with one group, every match a value. instructions: output file → instruction files of PEST, each of the
    ``observations``, by default all, a value; ``delimiters`` separate numbers there as blanks do. With ``time``, a
    column or key of times, values are interpolated linearly at those that are asked for; without it there is one value
    a time. A value that is missing or no number is NaN, a reading that the run does not give.
    """

    file: str
    column: str | int | None = None
    key: str | None = None
    pattern: str | None = None
    instructions: Mapping[str, Sequence[Path]] | None = None
    time: str | int | None = None
    observations: tuple[str, ...] | None = None
    delimiters: str = ""

    def read(self, folder: Path, times: Array, seconds: float | None = None) -> Array:
        """The values at ``times`` (K,); a pattern may take ``seconds``. Raises :class:`ProgramError`."""
        if self.pattern is not None:
            values = _numbers(_found(folder, self.file, self.pattern, seconds), self.file)
        elif self.instructions:
            values = self._instructed(folder, self.instructions)
        else:
            text, find = _text(folder, self.file), _key if self.column is None else _column
            values = find(text, self.key if self.column is None else self.column, self.file)
            if self.time is not None:
                return _at(times, find(text, self.time, self.file), values, self.file)
        if len(values) != len(times):
            raise ProgramError(f"{self.file}: {len(values)} values for {len(times)} times; name the column of times")
        return values

    def _instructed(self, folder: Path, instructions: Mapping[str, Sequence[Path]]) -> Array:
        values: dict[str, float] = {}
        for file, paths in instructions.items():
            text = _text(folder, file)
            for path in paths:
                values |= pest.read(_instructions(path), text, file, path.name, self.delimiters)
        names = list(values) if self.observations is None else [name.lower() for name in self.observations]
        return np.array([values[name] for name in names])


def _found(folder: Path, file: str, pattern: str, seconds: float | None) -> list[str]:
    """The matches, by another process: a pattern may take years, in which nothing else of this one would run."""
    allowed = Allowed(min(Allowed.seconds, math.ceil(seconds or Allowed.seconds)), size=LONGEST)
    try:
        return decoded_whole(matches, folder / file, pattern, allowed=allowed)
    except (DataError, DecodeError) as error:
        raise ProgramError(str(error).replace(str(folder / file), file)) from None


def _text(folder: Path, file: str) -> str:
    try:
        return text_of(folder / file)
    except DataError as error:
        raise ProgramError(str(error).replace(str(folder / file), file)) from None


@functools.cache
def _instructions(path: Path) -> str:
    return read_text(path)


def _at(times: Array, own: Array, values: Array, file: str) -> Array:
    if len(own) != len(values) or len(own) < 1 or not np.all(np.diff(own) > 0):
        raise ProgramError(f"{file}: {len(own)} times for {len(values)} values, or times that do not increase")
    slack = 1e-9 * max(abs(own[0]), abs(own[-1]))
    if times[0] < own[0] - slack or times[-1] > own[-1] + slack:
        raise ProgramError(
            f"{file}: times from {own[0]:g} to {own[-1]:g}, but {times[0]:g} to {times[-1]:g} are needed"
        )
    return np.asarray(np.interp(times, own, values))


def _column(text: str, column: str | int | None, file: str) -> Array:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(COMMENT)]
    if not lines:
        raise ProgramError(f"{file}: is empty")
    delimiter = max((",", ";", "\t"), key=lines[0].count)
    rows = list(csv.reader(lines, delimiter=delimiter)) if delimiter in lines[0] else [line.split() for line in lines]
    header = [cell.strip() for cell in rows[0]]
    if isinstance(column, int):
        at, first = column - 1, 0 if is_number(header[min(column, len(header)) - 1]) else 1
    elif column in header:
        at, first = header.index(column), 1
    else:
        raise ProgramError(f"{file}: no column {column!r}; the columns are: {listed(header)}")
    if at >= max(len(row) for row in rows[first:] or [header]):
        raise ProgramError(f"{file}: no column {column}")
    return _numbers([row[at] if at < len(row) else "" for row in rows[first:]], file)


def _key(text: str, key: str | int | None, file: str) -> Array:
    try:
        node: Any = json.loads(text)
    except ValueError as error:
        raise ProgramError(f"{file}: not JSON: {error}") from None
    for part in str(key).split("."):
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, ValueError, TypeError):
            raise ProgramError(f"{file}: no key {key!r}, for there is no {part!r}") from None
    return _numbers(node if isinstance(node, list) else [node], file)


def _numbers(texts: list[Any], file: str) -> Array:
    """What is no number is NaN, a reading that is missing. Raises :class:`ProgramError` where none is a number."""
    values = np.array([float(value) if is_number(value) else math.nan for value in texts])
    if len(texts) and np.isnan(values).all():
        raise ProgramError(f"{file}: {short(str(texts[0]))!r} is no number")
    return values
