"""Frames of a movie as pictures, and tables as numbers, for the page."""

import csv
import io
import re
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.inputs.parts import readable
from en4dvar.plumbing.errors import DataError, En4dvarError
from en4dvar.plumbing.files import read_plain
from en4dvar.report.text import plus_minus
from en4dvar_movie.frames import Frame, Movie, open_movie

HELD = 300_000_000  # bytes of frames that are kept, so that going back reads nothing again
PLOTTED = 4000  # readings of a column
LARGEST_TABLE = 50_000_000  # bytes


class Pictures:
    """The frames of one movie, read forward and kept as far as there is room. Used by several threads."""

    def __init__(self, path: Path, raw: str | None = None):
        self.movie: Movie = open_movie(path, raw)
        self._frames, self._next = self.movie.frames(), 1
        first = next(self._frames)
        self.shape: tuple[int, ...] = first.shape
        self._range = float(first.min()), float(first.max())
        # one block: what threads allocate by themselves grows without end
        self._room = np.empty((max(1, HELD // first.nbytes), *first.shape), first.dtype)
        self._room[0], self._held = first, {0: 0}  # place in the room → number of the frame that is there
        self._lock = threading.Lock()
        self.count = self.movie.count or sum(1 for _ in self.movie.frames())

    def frame(self, number: int) -> Frame:
        """One frame (H, W). Raises :class:`DataError`."""
        with self._lock:
            if self._held.get(number % len(self._room)) == number:
                kept: Frame = self._room[number % len(self._room)].copy()
                return kept
            if number < self._next:
                self._frames, self._next = self.movie.frames(), 0
            for at, frame in enumerate(self._frames, self._next):
                self._next = at + 1
                if frame.dtype == self._room.dtype:
                    place = at % len(self._room)
                    self._room[place], self._held[place] = frame, at
                if at == number:
                    return frame
        raise DataError(f"{self.movie.path}: there is no frame {number}")

    def bmp(self, number: int) -> bytes:
        """One frame as BMP, which takes no time to compress; 16 bit are stretched over the range of the first frame."""
        from PIL import Image

        frame, out = self.frame(number), io.BytesIO()
        if frame.dtype != np.uint8:
            low, high = self._range
            frame = np.clip(255 * (frame - low) / max(high - low, 1e-12), 0, 255).astype(np.uint8)
        Image.fromarray(frame).save(out, "bmp")
        return out.getvalue()


def readings(path: Path) -> dict[str, Any]:
    """The table of ``en4dvar track``: pixel (um), and rows with frame, t_us, R_um, R_std_um, x_um, y_um, used, reason,
    and R, the radius in as many digits as its error allows. Raises :class:`DataError` where it is no such table.
    """
    with readable(path):
        text = read_plain(path, LARGEST_TABLE).decode("utf-8", "replace")
    pixel = re.search(r"; pixel: ([\d.e+-]+) um;", text)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    if pixel is None or not rows or "frame" not in rows[0]:
        raise DataError(f"{path}: is not a table of 'en4dvar track'")
    told = [{key: _number(row.get(key)) for key in row if key} for row in rows]
    for row in told:
        radius, std = row.get("R_um"), row.get("R_std_um")
        if isinstance(radius, float) and isinstance(std, float):
            row["R"] = plus_minus(radius, std)
    return {"pixel": float(pixel[1]), "rows": told}


def _number(text: str | None) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text


def columns(path: Path, sheet: str = "") -> dict[str, Any]:
    """Columns of a table with their numbers (thinned out if many), which would be taken for times and radii, and the
    names of those of words. Raises :class:`DataError`."""
    from en4dvar.inputs.formats import SUFFIXES
    from en4dvar.inputs.parts import Layout
    from en4dvar_bubble.starter.asked import Asked, first_with_columns

    files = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
    if not files:
        raise DataError(f"{path}: the folder holds no data file ({', '.join(SUFFIXES)})")
    first, contents, layout = first_with_columns(files, Layout(sheet=sheet))
    asked = Asked(contents)
    with suppress(En4dvarError):
        asked = asked.by_names()
    step = max(1, max((len(v) for v in contents.columns.values()), default=0) // PLOTTED)
    shown = {
        name: [float(v) if np.isfinite(v) else None for v in values[::step]]
        for name, values in contents.columns.items()
    }
    return {
        "file": first.name, "files": len(files), "columns": shown, "words": [*contents.others],
        "decimal": layout.decimal, "tracked": asked.tracked, "time": asked.time_column, "radius": asked.radius_column,
    }  # fmt: skip
