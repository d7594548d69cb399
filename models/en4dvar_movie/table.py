"""The readings as CSV: one line a frame, lengths in micrometres, times in microseconds."""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from en4dvar.plumbing.tables import csv_text
from en4dvar_movie.tracking import Reading

MODES = (2, 3, 4)  # whose amplitudes are columns
SHAPE = ("eccentricity", "angle_deg", *(f"mode_{n}_um" for n in MODES), "mode_std_um")
COLUMNS = ("frame", "t_us", "R_um", "R_std_um", "t_std_us", "x_um", "y_um", *SHAPE, "used", "reason")
LONGEST_HEAD = 100_000  # bytes, of which most is the command line
_HEAD = re.compile(rb"# en4dvar track, .*\n# movie: (.*); pixel: ")
COMMON, SHAPED = "R_common_um", "R_shape_common"
STEADY = 0.1  # of the exposure: where its light may be centred
UNKNOWN = 0.01  # of the step between frames, where no exposure is given


@dataclass(frozen=True)
class Scale:
    """``pixel`` m, ``rate`` 1/s, ``exposure`` s (0 where not known), ``flashes`` of a frame after its instant, s."""

    pixel: float
    rate: float
    exposure: float = 0.0
    flashes: tuple[float, ...] = (0.0,)

    def time(self, reading: Reading) -> float:
        """When a circle was seen, s."""
        return reading.frame / self.rate + self.flashes[reading.flash]

    @property
    def time_std(self) -> float:
        """Std of a frame's instant, s."""
        return STEADY * self.exposure if self.exposure > 0 else UNKNOWN / self.rate


def movie_of(table: Path) -> str:
    """The movie that a table was read from, as it was named; "" where it is none of ``en4dvar track``."""
    with table.open("rb") as file:
        head = _HEAD.match(file.read(LONGEST_HEAD))
    return head[1].decode("utf-8", "replace") if head else ""


def other_movie(table: Path, movie: Path) -> str:
    """Another movie than ``movie``, by name or place, that a table, if there is one, was read from; else ""."""
    named = movie_of(table) if table.is_file() else ""
    if (name := Path(named).name) != " ".join(movie.name.split()):
        return name
    return named if os.path.exists(at := table.parent / named) and not at.samefile(movie) else ""


def to_csv(readings: Sequence[Reading], scale: Scale, movie: str, command: str) -> str:
    """The table with its comment. Radii of frames that are left out stay blank, so that no reader takes them."""
    common = [r.errors.common for r in readings if r.used]
    factor = max((r.errors.factor for r in readings if r.used), default=0.0)
    exposure = f"{1e6 * scale.exposure:g} us" if scale.exposure > 0 else "not given"
    head = [
        f"en4dvar track, version {version('en4dvar')}: {command}",
        f"movie: {movie}; pixel: {1e6 * scale.pixel:.9g} um; frame rate: {scale.rate:.9g} Hz; exposure: {exposure}"
        + (f"; flashes: {', '.join(f'{1e6 * t:g} us' for t in scale.flashes)}" if len(scale.flashes) > 1 else ""),
        "R_std_um is independent from frame to frame; a pixel's size moves all radii together, the edge's level by",
        *[f"{COMMON} = {1e6 * scale.pixel * float(np.median(common or [0])):.2g}"] * bool(common),
        *[
            "and what a lasting shape hides along the line of sight, by a factor of which the std is",
            f"{SHAPED} = {factor:.2g}",
        ]
        * (factor > 0),
    ]
    comment = "".join(f"# {' '.join(line.split())}\n" for line in head)
    return comment + csv_text([COLUMNS, *(_row(reading, scale) for reading in readings)])


def _row(reading: Reading, scale: Scale) -> Sequence[str]:
    um = 1e6 * scale.pixel
    first = [str(reading.frame), f"{1e6 * scale.time(reading):.9g}"]
    outline = reading.outline
    last = [str(int(reading.used)), reading.reason]
    if not reading.used or outline is None:
        return [*first, *[""] * (len(COLUMNS) - 4), *last]
    digits = 4 - math.floor(math.log10(um))  # of lengths: to a 10,000th of a pixel or better
    numbers = [
        f"{um * reading.radius:.{digits}f}", f"{um * reading.errors.std:.4g}", f"{1e6 * scale.time_std:.4g}",
        *(f"{um * at:.{digits - 1}f}" for at in (outline.circle.x, outline.circle.y)),
    ]  # fmt: skip
    modes = [*(um * outline.amplitude(n) for n in MODES), um * reading.errors.mode_std]
    shape = [f"{outline.eccentricity:.4f}", f"{outline.angle:.1f}", *(f"{value:.{digits}f}" for value in modes)]
    return [*first, *numbers, *("" if text == "nan" or not outline.modes.size else text for text in shape), *last]
