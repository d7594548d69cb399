"""Frames corrected by hand: a small text file, a line a frame.

# frame  what
12       out   blurred, two bubbles
15       ok    what was read is right, whatever makes it doubtful
19       270.5 64.0 28.0   start here: x, y and radius in pixels
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from en4dvar.inputs.opened import readable, require_file
from en4dvar.inputs.text_table import numbered_lines
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.outline import Circle


@dataclass(frozen=True)
class Correction:
    """``out``: the frame is left out. Else the outline is looked for about ``start``, or where there is none, what was
    read is confirmed."""

    out: bool
    start: Circle | None
    words: str


def read_corrections(path: Path) -> dict[int, Correction]:
    """Frame → correction. Raises :class:`DataError` that names the line."""
    require_file(path)
    with readable(path):
        lines = numbered_lines(path)
    corrections: dict[int, Correction] = {}
    for line, text in lines:
        where = f"{path}:{line}"
        frame, *rest = text.split()
        if not frame.isdigit() or not rest:
            raise DataError(
                f"{where}: write FRAME out WORDS, FRAME ok WORDS, or FRAME X Y RADIUS WORDS with numbers in pixels"
            )
        if int(frame) in corrections:
            raise DataError(f"{where}: frame {frame} was corrected before")
        corrections[int(frame)] = _correction(rest, where)
    return corrections


def _correction(rest: list[str], where: str) -> Correction:
    if (word := rest[0].lower()) in ("out", "ok"):
        return Correction(word == "out", None, " ".join(rest[1:]))
    try:
        x, y, radius = map(float, rest[:3])
    except ValueError:
        raise DataError(f"{where}: {' '.join(rest[:3])!r} is neither 'out' nor 'ok' nor X Y RADIUS in pixels") from None
    if not radius > 0:
        raise DataError(f"{where}: the radius {radius:g} is not positive")
    return Correction(False, Circle(x, y, radius), " ".join(rest[3:]))
