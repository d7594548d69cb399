"""What the user says of a movie: a place within the bubble, a part of the frame, a mask, and corrections by hand.

These are a small text file, a line a frame.

# frame  what
12       out   blurred, two bubbles
15       ok    what was read is right, whatever makes it doubtful
19       270.5 64.0 28.0   start here: x, y and radius in pixels
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from en4dvar.inputs.parts import readable
from en4dvar.inputs.text_table import numbered_lines
from en4dvar.model.state import Mask
from en4dvar.plumbing.decoding import require_plain
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.frames import MOVIES, Movie, open_picture
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


def numbers(text: str, option: str, names: str) -> tuple[float, ...]:
    """``"12.5,30"`` as numbers, as many as ``names`` has. Raises :class:`DataError` that names the option."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(names.split(",")) or not np.all(np.isfinite(values)):
        raise DataError(f"{option} {text}: write {names}, in pixels from the upper left corner")
    return values


def watched(movie: Movie, region: str | None, mask: Path | None) -> Mask | None:
    """The part of a frame (H, W) that is looked at; None: all of it.

    Raises DataError: the region lies outside the frame, the mask is no picture of its size, or they leave too little.
    """
    if region is None and mask is None:
        return None
    height, width = next(movie.frames()).shape
    part = np.ones((height, width), dtype=bool)
    if region is not None:
        x, y, w, h = (round(value) for value in numbers(region, "--region", "X,Y,WIDTH,HEIGHT"))
        if x < 0 or y < 0 or w < 1 or h < 1 or x + w > width or y + h > height:
            raise DataError(f"--region {region}: not within the frame of {width} × {height} pixels")
        part[:] = False
        part[y : y + h, x : x + w] = True
    if mask is not None:
        require_plain(mask, MOVIES.size)
        light = np.asarray(open_picture(mask))
        if light.shape[:2] != part.shape:
            raise DataError(f"{mask}: {light.shape[1]} × {light.shape[0]} pixels, the frames have {width} × {height}")
        part &= (light[..., :3].max(axis=2) if light.ndim == 3 else light) > 0
    if min(part.any(axis=0).sum(), part.any(axis=1).sum()) < 3:  # a quadratic surface needs three
        raise DataError("--region and --mask leave nothing of the frame that a bubble is seen in")
    return part
