"""What the user points at: a place within the bubble, a part of the frame, a mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.inputs.opened import require_file
from en4dvar.plumbing.errors import DataError
from en4dvar_movie.frames import Movie, open_picture


def place(text: str | None) -> tuple[float, float] | None:
    """``--bubble X,Y``. Raises :class:`DataError`."""
    if text is None:
        return None
    x, y = numbers(text, "--bubble", "X,Y")
    return x, y


def numbers(text: str, option: str, names: str) -> tuple[float, ...]:
    """``"12.5,30"`` as numbers, as many as ``names`` has. Raises :class:`DataError` that names the option."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(names.split(",")) or not np.all(np.isfinite(values)):
        raise DataError(f"{option} {text}: write {names}, in pixels from the upper left corner")
    return values


def watched(movie: Movie, region: str | None, mask: Path | None) -> npt.NDArray[np.bool_] | None:
    """The part of a frame (H, W) that is looked at; None: all of it.

    Raises
    ------
    DataError: the region lies outside the frame, or the mask is no picture of its size.
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
        require_file(mask)
        light = np.asarray(open_picture(mask))
        if light.shape[:2] != part.shape:
            raise DataError(f"{mask}: {light.shape[1]} × {light.shape[0]} pixels, the frames have {width} × {height}")
        part &= (light[..., :3].max(axis=2) if light.ndim == 3 else light) > 0
    if not part.any():
        raise DataError("--region and --mask leave nothing of the frame")
    return part
