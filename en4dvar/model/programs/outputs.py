"""Numbers out of the files that a program leaves: a column, a key of JSON, a pattern, PEST's instructions."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.model.programs import pest, template
from en4dvar.model.programs.pest import ProgramError
from en4dvar.model.programs.settings import OutputOf
from en4dvar.model.state import Array
from en4dvar.plumbing.decoding import LONGEST_TEXT, Allowed, DecodeError, decoded_whole, matches, text_of
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.hints import listed, short
from en4dvar.plumbing.tables import is_number

COMMENT = ("#", "%", "//")


def read(output: OutputOf, folder: Path, times: Array, seconds: float | None = None) -> Array:
    """The values at ``times`` (K,) of an observable, in the scratch directory; a pattern may take ``seconds``.

    With a column or key of times, values are interpolated linearly at those that are asked for; without it there is one
    value a time. A value that is missing or no number is NaN, a reading that the run does not give.

    Raises :class:`ProgramError`.
    """
    file = output.file
    if output.pattern is not None:
        values = _numbers(_found(folder, file, output.pattern, seconds), file)
    elif output.instructions:
        values = _instructed(output, folder)
    else:
        text, find = _text(folder, file), _key if output.column is None else _column
        values = find(text, output.key if output.column is None else output.column, file)
        if output.time is not None:
            return _at(times, find(text, output.time, file), values, file)
    if len(values) != len(times):
        raise ProgramError(f"{file}: {len(values)} values for {len(times)} times; name the column of times")
    return values


def _instructed(output: OutputOf, folder: Path) -> Array:
    values: dict[str, float] = {}
    for file, paths in output.instruction_files.items():
        text = _text(folder, file)
        for path in paths:
            values |= pest.read(template.text_of(path), text, file, path.name, output.delimiters)
    names = list(values) if output.observations is None else [name.lower() for name in output.observations]
    return np.array([values[name] for name in names])


def _found(folder: Path, file: str, pattern: str, seconds: float | None) -> list[str]:
    """The matches, by another process: a pattern may take years, in which nothing else of this one would run."""
    allowed = Allowed(min(Allowed.seconds, math.ceil(seconds or Allowed.seconds)), size=LONGEST_TEXT)
    try:
        return decoded_whole(matches, folder / file, pattern, allowed=allowed)
    except (DataError, DecodeError) as error:
        raise ProgramError(str(error).replace(str(folder / file), file)) from None


def _text(folder: Path, file: str) -> str:
    try:
        return text_of(folder / file)
    except DataError as error:
        raise ProgramError(str(error).replace(str(folder / file), file)) from None


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
    with retold(ValueError, ProgramError, f"{file}: not JSON: "):
        node: Any = json.loads(text)
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
