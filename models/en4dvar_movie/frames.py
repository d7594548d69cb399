"""Reading movies frame by frame: TIFF stacks, folders of pictures, cine, mp4, avi, gif, raw files of a stated shape.

Frames are (H, W) arrays of brightness, 8 or 16 bit. Nothing is held: a movie is a way to run through its frames.
Movies are written frame by frame as well: TIFF with its scale, or a video.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.plumbing.decoding import Allowed, DecodeError, decoded, decoded_whole, require_plain
from en4dvar.plumbing.errors import DataError, En4dvarError, retold
from en4dvar.plumbing.files import open_plain, replace_file, temporary_folder
from en4dvar.plumbing.hints import beside
from en4dvar_movie.decoders import check_size, image, library, tiff_about, tiff_frames, video_about, video_frames
from en4dvar_movie.numbering import in_order

Frame = npt.NDArray[Any]
TIFF, VIDEO = (".tif", ".tiff"), (".mp4", ".avi", ".mov", ".mkv")
MOVING = (*TIFF, *VIDEO, ".gif", ".cine")  # which are read; the last two are not written
IMAGES = (".png", ".bmp", ".jpg", ".jpeg")
LEAST_SIDE = 16
PLAYED = 30  # frames a second, of a video that is written
MOVIES = Allowed(seconds=20, memory=2_000_000_000, size=256_000_000_000)
COUNTED = 20  # pixels to each grey level, from which on a frame tells how far apart its levels are
PULLED = 3.0  # steps between common levels over those between rare ones, where a histogram was equalised
FLAT = 0.05  # the largest difference of its cumulative histogram from an even one
MOSAIC = 0.03  # of the mean of four pixels: by which those of a mosaic differ, beside their scatter
COLOUR = 0.08  # mean difference of the channels, as a share of the full scale, from which a frame is a coloured one


@dataclass(frozen=True)
class Movie:
    """``open`` runs through the frames from the first; ``count`` is 0 where only reading tells.

    ``pixel`` (m) and ``rate`` (1/s) are what the file itself says, NaN where it says nothing. ``notes`` are what
    reading showed that a user should know, ``damaged`` the frames of which it showed that they are not whole, or not
    there, ``copies`` those that are the frame before bit for bit, as no camera's noise repeats itself; ``within`` is
    the name of the file that is being read of a folder.
    """

    path: Path
    open: Callable[[], Iterator[Frame]]
    count: int = 0
    pixel: float = float("nan")
    rate: float = float("nan")
    notes: list[str] = field(default_factory=list)
    damaged: set[int] = field(default_factory=set)
    copies: set[int] = field(default_factory=set)
    within: list[str] = field(default_factory=list)

    def frames(self) -> Iterator[Frame]:
        """Frames (H, W), all of one shape. Raises :class:`DataError`, which names the frame."""
        shape: tuple[int, ...] = ()
        number, channel, even = -1, 0, None
        before: Frame | None = None
        noisy = False
        try:
            for number, read in enumerate(self.open()):
                where = self._where(number)
                if number == 0:
                    channel, coloured = _channel(read)
                    first = _grey(read, channel, where)
                    shape, even = first.shape, _evened(first)
                    name = ("red", "green", "blue")[channel]
                    self.note(f"frames are in colour; the channel with most light, {name}, is used", coloured)
                    words = "pixels differ in a pattern of 2 × 2, as in raw frames of a colour camera"
                    self.note(f"{words}: their brightness is made even", even is not None)
                frame = _grey(read, channel, where)
                if frame.shape != shape:
                    raise DataError(f"{where} is {_size(frame.shape)}, the first {_size(shape)}")
                if even is not None:
                    light = frame * even
                    if frame.dtype.kind in "ui":
                        light = np.minimum(light.round(), np.iinfo(frame.dtype).max)
                    frame = light.astype(frame.dtype)
                differs = 0.0 if before is None else float(np.mean(frame != before))
                if differs:
                    noisy = differs > 0.5  # in what stands still, too
                elif noisy and number not in self.damaged:
                    self.copies.add(number)
                before = frame
                yield frame
        except En4dvarError:
            raise
        except Exception as error:  # whatever the libraries stumble over in a damaged file
            words = " ".join(str(error).split()) or type(error).__name__
            raise DataError(f"{self._where(number + 1)} cannot be read: {words}") from None
        if number < 0:
            raise DataError(f"{self.path}: the movie holds no frame")

    def note(self, words: str, holds: bool = True) -> None:
        """Keep, once, what a user should know of the movie where it ``holds``."""
        if holds and (told := f"{self.path}: {words}") not in self.notes:
            self.notes.append(told)

    def _where(self, number: int) -> str:
        return f"{self.path}: frame {number}{''.join(f' ({name})' for name in self.within)}"


def saturated(frames: Iterable[Frame]) -> float:
    """The brightness above which a pixel of some frames is saturated, of a camera of as many bits as they need."""
    most = max(float(np.nanmax(frame)) if frame.dtype.kind in "ui" else np.inf for frame in frames)
    full = max(float(2 ** np.ceil(np.log2(most + 1))) - 1, 255.0)
    return most - 1.5 if most > 0.99 * full else full


def steps_of(frames: Sequence[Frame]) -> tuple[float, bool]:
    """The step to the next lower grey level at half of the pixels or more, in the median over frames of integers; and
    whether histograms were equalised: that step is far larger than those between rare levels, or all levels are as
    common.
    """
    steps, even = list[float](), list[bool]()
    for frame in frames:
        values, counts = np.unique(frame if frame.dtype.kind in "ui" else 0, return_counts=True)
        if len(values) > 1 and frame.size > COUNTED * len(values):
            gaps = np.diff(values.astype(float), prepend=2.0 * values[0] - values[1])
            order = np.argsort(gaps)
            steps.append(float(gaps[order][np.searchsorted(np.cumsum(counts[order]), frame.size / 2)]))
            off = np.max(np.abs(np.cumsum(counts) / frame.size - values / values[-1]))
            even.append(bool(steps[-1] >= PULLED * np.percentile(gaps, 10) or off < FLAT))
    return float(np.median(steps or [0.0])), 2 * sum(even) > len(even)


def open_movie(path: str | Path, raw: str | None = None) -> Movie:
    """The movie in a file or folder; ``raw`` is the ``WIDTHxHEIGHTxBITS`` of a file without header.

    Raises DataError: there is none, it cannot be read, or a library is missing.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise DataError(f"{path}: {beside(path)}")
    if raw is not None:
        return _raw(path, raw)
    if path.is_dir():
        return _folder(path)
    require_plain(path, MOVIES.size)
    if not path.stat().st_size:
        raise DataError(f"{path}: the file is empty")
    suffix = path.suffix.lower()
    if suffix in TIFF:
        return _tiff(path)
    if suffix in MOVING:
        return _video(path)
    kinds = ", ".join(MOVING)
    raise DataError(f"{path}: not a movie by its suffix ({kinds}, or a folder of frames); for a raw file give --raw")


def _grey(read: Any, channel: int, where: str) -> Frame:
    """Brightness (H, W) of what a library gives. Raises :class:`DataError`."""
    frame = np.asarray(read)
    if frame.ndim == 3 and frame.shape[2] in (3, 4):
        frame = np.ascontiguousarray(frame[..., channel])
    if frame.ndim != 2 or min(frame.shape) < LEAST_SIDE:
        raise DataError(
            f"{where} has the shape {_size(frame.shape)}; frames are images of {LEAST_SIDE} pixels and more"
        )
    if frame.dtype.kind not in "uif":
        raise DataError(f"{where} holds {frame.dtype}, not brightness")
    return frame


def _channel(read: Any) -> tuple[int, bool]:
    """The channel with most light, for in that of the lamp a bubble is darkest; whether the frame is a coloured one."""
    frame = np.asarray(read)
    if frame.ndim != 3 or frame.shape[2] not in (3, 4):
        return 0, False
    colours, full = frame[..., :3], np.iinfo(frame.dtype).max if frame.dtype.kind in "ui" else 1.0
    return int(np.argmax(colours.mean(axis=(0, 1)))), float(np.mean(np.ptp(colours, axis=2))) > COLOUR * full


def _evened(frame: Frame) -> Array | None:
    """Factors (H, W) that make a colour camera's mosaic as even as its brightest quarter; None where there is none."""
    height, width = (side - 1 for side in frame.shape)
    fours = np.array([frame[j : height + j : 2, i : width + i : 2] for j in (0, 1) for i in (0, 1)], dtype=float)
    mean = fours.mean(axis=0)
    lit = (mean > 0) & (mean >= mean.mean())
    shares = fours[:, lit] / mean[lit]
    if not shares.size:
        return None
    usual = np.median(shares, axis=1)
    scatter = np.median(np.abs(shares - usual[:, None]))
    if usual.min() <= 0 or np.max(np.abs(usual - 1)) < max(MOSAIC, scatter):
        return None
    repeated = np.tile((usual.max() / usual).reshape(2, 2), (height // 2 + 1, width // 2 + 1))
    return np.asarray(repeated[: height + 1, : width + 1])


def _size(shape: tuple[int, ...]) -> str:
    return " × ".join(map(str, shape[1::-1] + shape[2:]))


def _tiff(path: Path) -> Movie:
    count, shape, block, pixel, rate, notes = decoded_whole(tiff_about, path, allowed=MOVIES, kind="a TIFF")

    def read() -> Iterator[Frame]:
        if block is None:
            return decoded(tiff_frames, path, allowed=MOVIES)
        return _blocks(path, block[0], count, np.dtype(block[1]), shape)

    return Movie(path, read, count, pixel, rate, notes)


def open_picture(path: Path) -> Any:
    """A single picture (H, W) or (H, W, channels). Raises :class:`DataError`."""
    if path.suffix.lower() not in (*TIFF, *IMAGES):
        raise DataError(f"{path}: not a picture by its suffix ({', '.join((*IMAGES, *TIFF))})")
    read = _tiff(path).open() if path.suffix.lower() in TIFF else decoded(image, path, allowed=MOVIES)
    with retold((DecodeError, En4dvarError), DataError, f"{path}: cannot be read as a picture: "):
        return next(iter(read))


def _folder(path: Path) -> Movie:
    files = [p for p in path.iterdir() if p.suffix.lower() in (*TIFF, *IMAGES) and not p.name.startswith(".")]
    if not files:
        raise DataError(f"{path}: the folder holds no frame ({', '.join((*TIFF, *IMAGES))})")
    files, missing, notes = in_order(path, files)
    movie = Movie(path, lambda: read(), len(files) + sum(missing), notes=notes)

    def read() -> Iterator[Frame]:
        number = 0
        for file, gap in zip(files, missing, strict=True):
            movie.within[:] = [file.name]
            first = number
            for frame in _tiff(file).open() if file.suffix.lower() in TIFF else decoded(image, file, allowed=MOVIES):
                yield frame
                number += 1
            for _ in range(gap * (number - first)):  # the last one stands for those that are missing
                movie.damaged.add(number)
                yield frame
                number += 1

    return movie


def _video(path: Path) -> Movie:
    def read() -> Iterator[Frame]:
        for value in decoded(video_frames, path, allowed=MOVIES):
            if isinstance(value, str):
                movie.note(value)
            elif isinstance(value, int):
                movie.damaged.add(value)
            else:
                yield value

    count, codec, rate = decoded_whole(video_about, path, allowed=MOVIES, kind="a movie")
    movie = Movie(path, read, count, rate=rate)
    movie.note(
        f"compressed with loss ({codec}): R_std does not hold what that does to whole outlines, and may be several "
        "times too small where few bits are left; take the frames that the camera saved, if there are any",
        bool(codec),
    )
    return movie


def _raw(path: Path, raw: str) -> Movie:
    match = re.fullmatch(r"(\d+)x(\d+)x(8|10|12|14|16)", raw)
    if match is None:
        raise DataError(f"--raw {raw}: write WIDTHxHEIGHTxBITS, e.g. 512x128x8 (above 8 bit: two bytes, low one first)")
    require_plain(path, MOVIES.size)
    width, height, bits = map(int, match.groups())
    check_size((height, width), path)
    kind = np.dtype("u1" if bits == 8 else "<u2")
    frame = width * height * kind.itemsize
    size = path.stat().st_size
    if not frame or not size or size % frame:
        raise DataError(f"{path}: {size} bytes are not a whole number of frames of {raw} ({frame} bytes each)")

    count = size // frame
    return Movie(path, lambda: _blocks(path, 0, count, kind, (height, width)), count)


def _blocks(path: Path, start: int, count: int, kind: np.dtype[Any], shape: tuple[int, ...]) -> Iterator[Frame]:
    """Frames that follow each other in a file, without anything between them."""
    with open_plain(path) as file:
        file.seek(start)
        for _ in range(count):
            frame = np.frombuffer(file.read(int(np.prod(shape)) * kind.itemsize), kind).reshape(shape)
            yield frame.astype(kind.newbyteorder("="), copy=False)


def with_scale(movie: Movie, pixel: float | None, rate: float | None) -> Movie:
    """The movie with the given scale, else the file's own. Raises :class:`DataError` where both are mute."""
    pixel, rate = pixel or movie.pixel, rate or movie.rate
    missing = ["--pixel '2.76 um'"] * (not pixel > 0) + ["--frame-rate '270 kHz'"] * (not rate > 0)
    if missing:
        raise DataError(
            f"{movie.path}: the file does not state its scale, which is never guessed: add {' '.join(missing)}"
            + "".join(f"; {note.removeprefix(f'{movie.path}: ')}" for note in movie.notes)
        )
    return replace(movie, pixel=pixel, rate=rate)


def require_suffix(path: Path) -> None:
    """Raise :class:`DataError` where a movie cannot be written under this name."""
    if path.suffix.lower() not in (*TIFF, *VIDEO):
        raise DataError(f"{path}: not a movie by its suffix ({', '.join((*TIFF, *VIDEO))})")


def write_movie(path: Path, frames: Iterable[Frame], count: int, pixel: float, rate: float) -> None:
    """``count`` frames, grey (H, W) or coloured (H, W, 3); a TIFF says size of a pixel (m) and rate (1/s).

    A grey video is without loss; a coloured one is to be looked at.

    Raises DataError: the suffix is none of a movie's, a library is missing, or the file cannot be written.
    """
    require_suffix(path)
    stream = iter(frames)
    first = next(stream)
    told = retold((OSError, ValueError), DataError, f"{path}: cannot be written: ")
    with told, temporary_folder(path.absolute().parent) as folder:  # suffix and whole file in the end
        partial = folder / path.name
        if path.suffix.lower() in TIFF:
            _write_tiff(partial, first, stream, count, pixel, rate)
        elif first.dtype.itemsize > 1:
            raise DataError(f"{path}: a video holds 8 bits; write more as .tif")
        else:
            _write_video(partial, first, stream)
        replace_file(partial, path)


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
        if not colour:
            stream.options, stream.color_range = {"qp": "0"}, 2  # of all grey levels; else they would be read stretched
        for frame in chain([first], others):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24" if colour else "gray")))
        file.mux(stream.encode())
