"""What decodes frames of movies; it runs in a child process (:func:`en4dvar.plumbing.decoding.decoded`).

Each function gives values one by one: numbers and words about the file, or frames as the libraries give them.
"""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from en4dvar.model.state import Indices
from en4dvar.plumbing.errors import DataError

MOST_PIXELS = 64_000_000  # of a frame
SQUARE = 0.001  # of a pixel's side: by which the other may differ
MOST_COLOURS = 3  # of a frame
CINE = "cine"  # the format of Phantom cameras
WITHOUT_LOSS = "High 4:4:4 Predictive"  # the profile of H.264 that may have none
PREFIXES = dict.fromkeys(("m", "milli"), 1e-3) | dict.fromkeys(("n", "nano"), 1e-9)
PREFIXES |= dict.fromkeys(("u", "µ", "μ", "\\u00B5", "micro"), 1e-6)
LENGTHS = {prefix + word: size for prefix, size in PREFIXES.items() for word in ("m", "meter", "metre")}
LENGTHS |= {"micron": 1e-6, "microns": 1e-6, "cm": 1e-2}
PREFIXES[""] = 1.0
TIMES = {prefix + word: size for prefix, size in PREFIXES.items() for word in ("s", "sec", "second", "seconds")}


def library(name: str) -> ModuleType:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError:
        raise DataError(f"reading this movie needs {name}: pip install {name}") from None


@contextmanager
def _overheard() -> Iterator[list[str]]:
    """Within, what tifffile logs is kept as a list instead of shown."""
    faults: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        faults.append(record.getMessage())
        return False

    logger = logging.getLogger("tifffile")
    logger.addFilter(keep)
    try:
        yield faults
    finally:
        logger.removeFilter(keep)


def tiff_about(path: Path) -> Iterator[tuple[int, tuple[int, ...], tuple[int, str] | None, float, float, list[str]]]:
    """How many frames a TIFF holds, and their shape; of frames that follow each other behind a single page where they
    begin, and their type; size of a pixel (m) and frame rate (1/s), NaN where it says nothing; what is not used of it.
    """
    tifffile = library("tifffile")
    try:
        with _overheard() as faults, tifffile.TiffFile(path) as file:
            pages, colours, first = len(file.pages), _pages(file, path).shape[1], file.pages[0]
            about = dict(file.imagej_metadata or {})
            count, start = int(about.get("images", pages)), first.dataoffsets[0]
            (pixel, of_pixel), (rate, of_rate) = _tiff_pixel(about, first.tags), _tiff_rate(about)
            notes = [f"{path}: {words}" for words in (of_pixel, of_rate) if words]
            kind = np.dtype(first.dtype).newbyteorder(file.byteorder).str
            check_size(first.shape, path)
            held = path.stat().st_size >= start + count * first.nbytes
            if pages == 1 < count and first.compression == 1 and held:  # ImageJ's way beyond 4 GB
                yield count, tuple(first.shape), (start, kind), pixel, rate, notes
                return
            if pages < count or any("invalid page offset" in fault or "circular" in fault for fault in faults):
                raise DataError(f"{path}: the file is damaged or cut off: not all of its frames are there")
            yield pages // colours, tuple(first.shape), None, pixel, rate, notes
    except DataError:
        raise
    except Exception as error:  # tifffile believes what a damaged file says of itself
        raise DataError(f"{path}: cannot be read as TIFF, it is damaged: {error}") from None


def tiff_frames(path: Path) -> Iterator[Any]:
    """Frames; the channels of one along its last axis, three as of a coloured picture."""
    with _overheard(), library("tifffile").TiffFile(path) as file:
        for numbers in _pages(file, path):
            check_size(file.pages[int(numbers[0])].shape, path)
            planes = [file.pages[int(number)].asarray() for number in numbers]
            dark = [np.zeros_like(planes[0])] * (MOST_COLOURS - len(planes))
            yield np.stack([*planes, *dark], axis=-1) if len(planes) > 1 else planes[0]


def _pages(file: Any, path: Path) -> Indices:
    """The pages (frames, colours) of each frame, by the axes that ImageJ, OME or tifffile has written.

    Raises :class:`DataError` where a frame has slices in depth, or more channels than colours.
    """
    series = file.series[0] if file.is_imagej or file.is_ome or file.is_shaped else None
    sizes = dict(zip(series.axes, series.shape, strict=True)) if series else {}
    sizes = {axis: n for axis, n in sizes.items() if axis not in "YXS" and n > 1}
    colours = sizes.get("C", 1) if len(sizes) > 1 else 1  # a stack of one axis is a movie, whatever its name
    for axis, words in {"Z": "slices in depth", "C": "channels"}.items():
        if {"T", "Z"} <= sizes.keys() if axis == "Z" else colours > MOST_COLOURS:
            raise DataError(
                f"{path}: each frame has {sizes[axis]} {words}; save the one that shows the bubble best "
                "(in ImageJ: Image > Duplicate…)"
            )
    pages = np.arange(len(file.pages))
    if colours == 1:
        return pages[:, None]
    if math.prod(sizes.values()) != len(pages):
        words = "the file is damaged or cut off, or holds more than 4 GB; save the channel with most light alone"
        raise DataError(f"{path}: the {colours} channels of its frames are not all there: {words}")
    return np.moveaxis(pages.reshape(tuple(sizes.values())), list(sizes).index("C"), -1).reshape(-1, colours)


def _tiff_pixel(about: dict[str, Any], tags: Any) -> tuple[float, str]:
    """Size of a pixel that ImageJ wrote, m, or NaN and why it is not used."""
    unit = LENGTHS.get(str(about.get("unit", "")))
    across, down = (tags.get(name) for name in ("XResolution", "YResolution"))
    if unit is None or across is None or not across.value[0]:
        return float("nan"), ""
    width, height = (unit * tag.value[1] / tag.value[0] if tag and tag.value[0] else 0 for tag in (across, down))
    if height and abs(width - height) > SQUARE * width:
        words = f"pixels of {1e6 * width:g} × {1e6 * height:g} um are no squares; scale its frames until they are, or "
        return float("nan"), f"{words}give the --pixel that both sides have"
    return width, ""


def _tiff_rate(about: dict[str, Any]) -> tuple[float, str]:
    """Frame rate by the interval that ImageJ wrote, 1/s, or NaN and why it is not used."""
    interval, name = float(about.get("finterval") or 0), str(about.get("tunit") or "sec")
    if not interval:
        return float("nan"), ""
    if name not in TIMES:
        return float("nan"), f"its frames are {interval:g} {name} apart, which is no known unit of time"
    return 1 / (interval * TIMES[name]), ""


def image(path: Path) -> Iterator[Any]:
    """The frame of a single picture."""
    with library("PIL.Image").open(path) as opened:
        check_size(opened.size, path)
        told = opened.mode in ("L", "F", "RGB", "RGBA") or opened.mode.startswith("I")
        yield np.asarray(opened if told else opened.convert("RGB"))  # a palette's numbers are no brightness


def video_about(path: Path) -> Iterator[tuple[int, str, float]]:
    """How many frames the file says that it holds, 0 where it does not; the codec where it is one that loses light;
    the rate of the camera, 1/s, which only a Phantom cine states: NaN of others, which state one to play them at.
    """
    with library("av").open(str(path)) as file:
        stream = next(iter(file.streams.video), None)
        if stream is None:
            yield 0, "", float("nan")
            return
        lossy = stream.codec_context.codec.lossy and stream.profile != WITHOUT_LOSS
        rate = float(1 / stream.time_base) if file.format.name == CINE and stream.time_base else float("nan")
        yield _count(file, stream), stream.codec_context.name if lossy else "", rate


def video_frames(path: Path) -> Iterator[Any]:
    """Frames; before one that is damaged its number, and at the end, in words, how many are missing."""
    with library("av").open(str(path)) as file:
        if not file.streams.video:
            raise DataError(f"{path}: holds no video")
        stream = file.streams.video[0]
        stream.thread_type = "AUTO"
        told, number = _count(file, stream), -1
        try:
            for number, frame in enumerate(file.decode(stream)):
                if frame.interlaced_frame:
                    raise DataError(f"{path}: the movie is interlaced; save whole frames (ffmpeg -vf yadif)")
                if frame.is_corrupt:
                    yield number
                check_size((frame.height, frame.width), path)
                deep = max(part.bits for part in frame.format.components) > 8
                coloured = "rgb48le" if deep else "rgb24"
                grey = frame.format.name.startswith("gray")
                yield frame.to_ndarray(format=("gray16le" if deep else "gray") if grey else coloured)
        except library("av").FFmpegError:  # of a frame that is not whole; those before it are
            if not 0 <= number < told - 1:
                raise
        if number + 1 < told:
            yield f"the file is cut off: it says that it holds {told} frames, {number + 1} are there"


def _count(file: Any, stream: Any) -> int:
    """How many frames a file says that it holds; 0 where it does not. A Phantom cine counts time in frames."""
    return int((stream.duration if file.format.name == CINE else stream.frames) or 0)


def check_size(shape: tuple[int, ...], path: Path) -> None:
    """Before anything is decoded, which takes several times the memory of the frame."""
    if math.prod(shape[:2]) > MOST_PIXELS:
        raise DataError(
            f"{path}: frames of {' × '.join(map(str, shape))} pixels; at most {MOST_PIXELS / 1e6:g} million are read"
        )
