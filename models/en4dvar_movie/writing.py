"""Writing movies frame by frame: TIFF with its scale, or a video without loss."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from en4dvar.errors import DataError
from en4dvar_movie.frames import TIFF, VIDEO, Frame, library

PLAYED = 30  # frames a second, of a video


def write_movie(
    path: Path, frames: Iterable[Frame], count: int, shape: tuple[int, int], pixel: float, rate: float, bits: int = 8
) -> None:
    """``count`` grey frames (H, W); a TIFF says size of a pixel (m) and rate (1/s), as ImageJ writes them.

    Raises
    ------
    DataError: the suffix is none of a movie's, a library is missing, or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in (*TIFF, *VIDEO):
        raise DataError(f"{path}: not a movie by its suffix ({', '.join((*TIFF, *VIDEO))})")
    if bits > 8 and suffix in VIDEO:
        raise DataError(f"{path}: a video holds 8 bits; write {bits} bits as .tif")
    try:
        if suffix in TIFF:
            _write_tiff(path, frames, count, shape, pixel, rate, bits)
        else:
            _write_video(path, frames, shape)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be written: {error}") from None


def _write_tiff(
    path: Path, frames: Iterable[Frame], count: int, shape: tuple[int, int], pixel: float, rate: float, bits: int
) -> None:
    per_um = 1e-6 / pixel
    with library("tifffile").TiffWriter(path, imagej=True) as file:
        file.write(
            iter(frames), shape=(count, *shape), dtype="uint16" if bits > 8 else "uint8", photometric="minisblack",
            resolution=(per_um, per_um), metadata={"axes": "TYX", "unit": "um", "finterval": 1 / rate},
        )  # fmt: skip


def _write_video(path: Path, frames: Iterable[Frame], shape: tuple[int, int]) -> None:
    av = library("av")
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=PLAYED)
        stream.height, stream.width, stream.pix_fmt = *shape, "gray"
        stream.options = {"qp": "0"}  # without loss
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        file.mux(stream.encode())
