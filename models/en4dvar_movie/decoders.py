"""What decodes frames of movies; it runs in a child process (:func:`en4dvar.plumbing.decoding.decoded`).

Each function gives values one by one: numbers and words about the file, or frames as the libraries give them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from en4dvar.plumbing.errors import DataError

MOST_PIXELS = 64_000_000  # of a frame


@dataclass(frozen=True)
class TiffAbout:
    """What a TIFF file says of itself: ``pixel`` (m) and ``rate`` (1/s) are NaN where it says nothing.

    ``count`` frames of ``shape`` in ``pages``; those of a ``plain`` file begin at byte ``start`` and have ``frame``
    bytes of ``kind``. ``broken``: the directory of pages leads nowhere.
    """

    pages: int
    count: int
    shape: tuple[int, ...]
    kind: str
    start: int
    frame: int
    plain: bool
    pixel: float
    rate: float
    broken: bool


def library(name: str) -> ModuleType:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise DataError(f"reading this movie needs {name}: pip install {name}") from None


@contextmanager
def _overheard(name: str) -> Iterator[list[str]]:
    """Within, what a library logs is kept as a list instead of shown."""
    faults: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        faults.append(record.getMessage())
        return False

    logger = logging.getLogger(name)
    logger.addFilter(keep)
    try:
        yield faults
    finally:
        logger.removeFilter(keep)


def tiff_about(path: Path) -> Iterator[TiffAbout]:
    tifffile = library("tifffile")
    try:
        with _overheard("tifffile") as faults, tifffile.TiffFile(path) as file:
            pages = len(file.pages)
            about = dict(file.imagej_metadata or {})
            first = file.pages[0]
            yield TiffAbout(
                pages,
                int(about.get("images", pages)),
                tuple(first.shape),
                np.dtype(first.dtype).newbyteorder(file.byteorder).str,
                first.dataoffsets[0],
                first.nbytes,
                bool(first.compression == 1),
                _tiff_pixel(about, first.tags.get("XResolution")),
                1 / float(about["finterval"]) if about.get("finterval") else float("nan"),
                any("invalid page offset" in fault or "circular" in fault for fault in faults),
            )
    except Exception as error:  # tifffile believes what a damaged file says of itself
        raise DataError(f"{path}: cannot be read as TIFF, it is damaged: {error}") from None


def tiff_frames(path: Path) -> Iterator[Any]:
    with _overheard("tifffile"), library("tifffile").TiffFile(path) as file:
        for page in file.pages:
            check_size(page.shape, path)
            yield page.asarray()


def _tiff_pixel(about: dict[str, Any], resolution: Any) -> float:
    """Size of a pixel that ImageJ wrote, m."""
    units = {"micron": 1e-6, "um": 1e-6, "µm": 1e-6, "\\u00B5m": 1e-6, "mm": 1e-3, "nm": 1e-9}
    unit = units.get(str(about.get("unit", "")))
    if unit is None or resolution is None:
        return float("nan")
    pixels, length = resolution.value
    return unit * length / pixels if pixels else float("nan")


def image(path: Path) -> Iterator[Any]:
    """The frame of a single picture."""
    with library("PIL.Image").open(path) as opened:
        check_size(opened.size, path)
        told = opened.mode in ("L", "F", "RGB", "RGBA") or opened.mode.startswith("I")
        yield np.asarray(opened if told else opened.convert("RGB"))  # a palette's numbers are no brightness


def video_count(path: Path) -> Iterator[int]:
    """How many frames the file says that it holds; 0 where it does not."""
    with library("av").open(str(path)) as file:
        yield int(file.streams.video[0].frames) if file.streams.video else 0


def video_frames(path: Path) -> Iterator[Any]:
    """Frames; before one that is damaged its number, and at the end, in words, how many are missing."""
    with library("av").open(str(path)) as file:
        if not file.streams.video:
            raise DataError(f"{path}: holds no video")
        stream = file.streams.video[0]
        stream.thread_type = "AUTO"
        number = -1
        for number, frame in enumerate(file.decode(stream)):
            if frame.interlaced_frame:
                raise DataError(f"{path}: the movie is interlaced; save whole frames (ffmpeg -vf yadif)")
            if frame.is_corrupt:
                yield number
            check_size((frame.height, frame.width), path)
            deep = max(part.bits for part in frame.format.components) > 8
            grey = frame.format.name.startswith("gray")
            yield frame.to_ndarray(format=("gray16le" if deep else "gray") if grey else "rgb48le" if deep else "rgb24")
        if number + 1 < stream.frames:
            said = f"it says that it holds {stream.frames} frames, {number + 1} are there"
            yield f"{path}: the file is cut off: {said}"


def check_size(shape: tuple[int, ...], path: Path) -> None:
    """Before anything is decoded, which takes several times the memory of the frame."""
    if math.prod(shape[:2]) > MOST_PIXELS:
        raise DataError(
            f"{path}: frames of {' × '.join(map(str, shape))} pixels; at most {MOST_PIXELS / 1e6:g} million are read"
        )
