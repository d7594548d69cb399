"""Writing movies frame by frame: TIFF with its scale, or a video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

from en4dvar.plumbing.errors import DataError, retold
from en4dvar_movie.decoders import library
from en4dvar_movie.frames import TIFF, VIDEO, Frame

PLAYED = 30  # frames a second, of a video


def require_suffix(path: Path) -> None:
    """Raise :class:`DataError` where a movie cannot be written under this name."""
    if path.suffix.lower() not in (*TIFF, *VIDEO):
        raise DataError(f"{path}: not a movie by its suffix ({', '.join((*TIFF, *VIDEO))})")


def write_movie(path: Path, frames: Iterable[Frame], count: int, pixel: float, rate: float) -> None:
    """``count`` frames, grey (H, W) or coloured (H, W, 3); a TIFF says size of a pixel (m) and rate (1/s).

    A grey video is without loss; a coloured one is to be looked at.

    Raises
    ------
    DataError: the suffix is none of a movie's, a library is missing, or the file cannot be written.
    """
    require_suffix(path)
    stream = iter(frames)
    first = next(stream)
    with retold((OSError, ValueError), DataError, f"{path}: cannot be written: "):
        if path.suffix.lower() in TIFF:
            _write_tiff(path, first, stream, count, pixel, rate)
        elif first.dtype.itemsize > 1:
            raise DataError(f"{path}: a video holds 8 bits; write more as .tif")
        else:
            _write_video(path, first, stream)


def _write_tiff(path: Path, first: Frame, others: Iterator[Frame], count: int, pixel: float, rate: float) -> None:
    colour = first.ndim == 3
    with library("tifffile").TiffWriter(path, imagej=True) as file:
        file.write(
            chain([first], others), shape=(count, *first.shape), dtype=first.dtype,
            photometric="rgb" if colour else "minisblack", resolution=(1e-6 / pixel, 1e-6 / pixel),
            metadata={"axes": "TYXS" if colour else "TYX", "unit": "um", "finterval": 1 / rate},
        )  # fmt: skip


def _write_video(path: Path, first: Frame, others: Iterator[Frame]) -> None:
    av = library("av")
    colour = first.ndim == 3
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=PLAYED)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p" if colour else "gray"
        stream.options = {} if colour else {"qp": "0"}
        for frame in chain([first], others):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24" if colour else "gray")))
        file.mux(stream.encode())
