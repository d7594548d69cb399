"""What ``en4dvar init`` is told about the columns of a file, what their names tell, and which options are missing."""

import math
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.inputs.parts import Contents, Layout, read_contents
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.units import UnitError, as_unit, convert
from en4dvar_bubble.starter.config import (
    AREA,
    DIAMETER,
    FRAMES,
    OF_AREA,
    PIXELS,
    TRACKED,
    quoted,
    unit_in,
    without_unit,
)

_TIME = re.compile(r"(?i)(t|time|zeit)([ _(\[].*)?")
_STEP = re.compile(r"(?i)delta_?t|dt|t_?step|time_?step")
_SIZE = re.compile(r"(?i)delta_?x|dx|pixel_?size|(um|m)_?per_?(px|pixel)|px_?2_?(um|m)")
_AS_PIXELS, _AS_FRAMES = ("px", "pixel", "pixels"), ("frame", "frames")
_OF = r"err(or)?s?|st\.? ?d(ev(iation)?)?\.?|standard[ _](error|deviation)|sd|sem?|sigma|σ|unc(ertainty)?|±|\+/?-"
_R = r"(r|radius)"
_ERRORS = re.compile(
    rf"(?i)(±|\+/?-)?[ _]*({_OF})([ _]*(of[ _]*)?{_R})?|(±|\+/?-|d|u|delta|δ)[ _]*{_R}|{_R}[ _]*({_OF})"
)
_PER_CENT = re.compile(r"[ _(\[]*%[ )\]]*$")
_RADIUS = re.compile(r"(?i)r|radius|radii|rnew|roft|r[ _(\[].*|radius[ _(\[].*")


LOOKED_AT = 20  # files of a folder
SAME_CLOCK = 1e-3  # relative difference of a unit of time and a frame that is rounding


@dataclass(frozen=True)
class Asked:
    """The ``contents`` of a file, and the options about its columns as they were given; None is one that was not."""

    contents: Contents
    time_unit: str | None = None
    radius_unit: str | None = None
    time_column: str | None = None
    radius_column: str | None = None
    time_step: str | None = None
    frame_rate: str | None = None
    pixel: str | None = None

    @property
    def tracked(self) -> bool:
        """Whether the file is a table of 'en4dvar track', which says everything itself, and nobody says otherwise."""
        options = (value for name, value in vars(self).items() if name != "contents")
        return {"t_us", "R_um", *TRACKED.errors} <= self.contents.columns.keys() and not any(options)

    @property
    def step(self) -> str | None:
        """The scalar of the file that is the time between two readings, where nothing else gives their times."""
        return None if self.time_column or self.time_step else self._stated_step

    @property
    def _stated_step(self) -> str | None:
        fitting = [name for name in self.contents.scalars if _STEP.fullmatch(without_unit(name, "s"))]
        return fitting[0] if len(fitting) == 1 else None

    @property
    def errors(self) -> list[str]:
        """Columns that are called as standard deviations of radii are."""
        columns = self.contents.columns
        bare = {name: without_unit(_PER_CENT.sub("", name)) for name in columns}
        return [name for name in columns if _ERRORS.fullmatch(bare[name]) and name != self.radius_column]

    @property
    def unused(self) -> list[str]:
        """What is to be written where columns hold errors of the radii, which are proposed without them."""
        if self.tracked:
            return []
        units = {name: unit_in(name, "m") for name in self.errors}
        said = {name: f", unit: {unit}" if unit not in (None, self.radius_unit) else "" for name, unit in units.items()}
        use = {
            name: f"to use it write in the section error 'radius_std: {{column: {quoted(name)}{unit}}}'"
            for name, unit in said.items()
        }
        use |= {name: "to use them, write them into the file as lengths" for name in units if _PER_CENT.search(name)}
        return [f"column {name!r} looks like errors of the radii, and is not used; {how}" for name, how in use.items()]

    def shown(self, name: str) -> str:
        """A column or scalar and what it holds, in words."""
        if name not in self.contents.columns:
            return f"{name} ({self.contents.scalars.get(name, np.nan):g})"
        values = self.contents.columns[name]
        finite = values[np.isfinite(values)]
        span = f"{finite.min():g} to {finite.max():g}" if len(finite) else "none of them finite"
        return f"{name} ({len(values)} values, {span})"

    def by_names(self) -> "Asked":
        """With the columns whose names tell what they are; pixels and frames as units. Raises :class:`UnitError`, and
        :class:`ConfigError` for options that contradict each other.
        """
        if self.tracked:
            return self
        names = {name: it for name, it in self.contents.columns.items() if name not in self.errors}
        time, radius = self.time_column, self.radius_column or _only(_RADIUS, names)
        if self.time_step is None:
            time = time or _only(_TIME, names)
            if len(names) == 2:  # one tells what the other is
                first, second = names
                other = {first: second, second: first}
                timed = [name for name in names if name != radius and self._unit(name, "s")]
                time = time or (timed[0] if len(timed) == 1 else None)  # words of any language, with a unit
                radius = radius or other.get(time or "")
                if not time and radius and (self.frame_rate is None or np.all(np.diff(names[other[radius]]) > 0)):
                    time = other[radius]
            if self._stated_step is None:
                time = time or _only(FRAMES, names)
        named = replace(self, time_column=time, radius_column=radius)
        frames = self.frame_rate is not None and named._counts_frames
        times = self.time_unit or (None if frames else self._unit(time or named.step, "s"))
        radii = self.radius_unit or (None if self.pixel else self._unit(radius, "m"))
        return replace(named, time_unit=times, radius_unit=radii).of_camera()

    def _unit(self, column: str | None, kind: str) -> str | None:
        """What the column's name, or a line below the names, says."""
        return unit_in(column, kind) or unit_in(f"{column}_{self.contents.units.get(column or '', '')}", kind)

    def of_camera(self) -> "Asked":
        """With what pixel and frame rate make of units. Raises as :meth:`by_names` does."""
        asked = self
        if asked.pixel is not None:
            if asked.radius_unit not in (None, *_AS_PIXELS):
                raise ConfigError("--pixel makes pixels the unit of radii: give it, or --radius-unit, not both")
            asked = replace(asked, radius_unit=as_unit(asked.pixel, "um"), pixel=None)
        if asked.frame_rate is not None and (asked._in_frames or asked._frame_each_row):
            between = f"1/({as_unit(asked.frame_rate, 'kHz')})"
            step, unit = convert(1.0, between, "us"), between if asked.time_unit in _AS_FRAMES else asked.time_unit
            if unit and not math.isclose(convert(1.0, unit, "us"), step, rel_tol=SAME_CLOCK):
                raise ConfigError(
                    f"--frame-rate makes {asked.time_column} numbers of frames of {step:.4g} us, --time-unit times in "
                    f"{unit}: give the one that is right, not both"
                )
            each = f"{step:.12g} us" if asked._frame_each_row else asked.time_step
            asked = replace(asked, time_unit=between, time_step=each, frame_rate=None)
        return asked

    @property
    def _frame_each_row(self) -> bool:
        """Whether no column can hold times: none is named, and none but the radii increases from row to row."""
        others = (values for name, values in self.contents.columns.items() if name != self.radius_column)
        named = self.time_column or self.time_step or self.time_unit or self.step
        return not named and not any(np.all(np.diff(values) > 0) for values in others)

    @property
    def _counts_frames(self) -> bool:
        """Whether the column of times is called as frames are, or rises by one and its name tells no unit."""
        name = self.time_column or ""
        steps = np.diff(self.contents.columns.get(name, np.empty(0)))
        by_one = len(steps) > 0 and np.median(steps) == 1 and np.all(steps == np.rint(steps))
        return bool(FRAMES.fullmatch(name) or (by_one and not self._unit(name, "s")))

    @property
    def _in_frames(self) -> bool:
        """Whether times are numbers of frames: by their unit, by a rate beside such numbers, or by their name alone."""
        named = self.time_unit is None and FRAMES.fullmatch(self.time_column or "")
        return self.time_unit in _AS_FRAMES or (self._counts_frames if self.frame_rate is not None else bool(named))

    @property
    def complete_columns(self) -> bool:
        """Whether it is known which columns are times and radii."""
        return not any(option.endswith("column") for option, _, _ in self.needed())

    def needed(self) -> list[tuple[str, str, str]]:
        """Options that are missing: each with what stands for its value, and a hint, "" where there is none."""
        if self.tracked:
            return []
        missing = []
        if self.time_step is None:
            time = self.time_column or self.step
            if time is None:
                missing.append(("--time-column", "NAME", ""))
            if self._in_frames:
                missing.append(("--frame-rate", "RATE", f"e.g. '270 kHz', where {time} counts frames"))
            elif self.time_unit is None and (time or self.frame_rate is None):
                may_count = time and (self.frame_rate is not None or self._counts_frames)
                frames = f", or 'frame' beside --frame-rate where {time} counts frames" if may_count else ""
                missing.append(("--time-unit", "UNIT", f"e.g. us{frames}"))
        if self.radius_column is None:
            others = [name for name in self.contents.columns if name != self.time_column]
            alike = _numbered(others) if len(others) < len(self.contents.columns) else ""
            missing.append(("--radius-column", alike or "NAME", "each of these columns is a bubble" if alike else ""))
        size = _only(_SIZE, self.contents.scalars)
        radii = self.radius_column or ""
        halved = bool(DIAMETER.match(radii))
        since = f", since {radii!r} seems to hold diameters" * halved
        pixels = PIXELS.search(f"{radii} {self.contents.units.get(radii, '')}")
        if (self.radius_unit is None and (size or pixels)) or self.radius_unit in _AS_PIXELS:
            value, unit = (2.76, "um'") if size is None else (self.contents.scalars[size], f"m' if {size} is in m")
            words = f"{'half ' * halved}the size of one{since}, e.g. '{value / (1 + halved):g} {unit}"
            missing.append(("--pixel", "LENGTH", f"{words}; or --radius-unit UNIT"))
        elif self.radius_unit is None:
            missing.append(("--radius-unit", "UNIT", f"e.g. {'0.5*' * halved}um{since}"))
        return missing

    def _spoilt(self) -> list[str]:
        """Columns whose names tell that they are the missing ones, and that hold something else than numbers."""
        named = {_TIME: self.time_column or self.time_step or self.step, _RADIUS: self.radius_column}
        lacking = (_only(pattern, self.contents.others) for pattern, column in named.items() if column is None)
        return [it for it in lacking if it and not any(name.startswith(f"{it}(") for name in self.contents.columns)]

    def incomplete(self, file: Path, advice: str) -> ConfigError:
        """The error that names what is :meth:`needed`."""
        needed = ((f"{option} {shlex.quote(value)}", hint) for option, value, hint in self.needed())
        options = ", ".join(f"{words}{f' ({hint})' if hint else ''}" for words, hint in needed)
        spoilt = [self.contents.others[name] for name in self._spoilt()]
        if spoilt:
            return ConfigError("\n".join(spoilt))
        columns = ", ".join(self.contents.columns) or "none"
        message = f"{file}: columns with numbers: {columns}; units are never guessed: add {options}"
        others = () if self.complete_columns else self.contents.others.values()
        return ConfigError("\n".join([*others, message, advice]))

    def columns(self) -> dict[str, Any]:
        """Columns and units as ``propose_config`` takes them. Raises :class:`UnitError`: one is not of its kind."""
        if self.tracked:
            return {"radius": TRACKED.radius, "time": TRACKED.time, "errors": TRACKED.errors}
        radius = (self.radius_column, self.radius_unit)
        with retold(UnitError, UnitError, f"--radius-unit: {OF_AREA}: " * bool(AREA.match(str(self.radius_column)))):
            convert(1.0, str(self.radius_unit), "m")
        if self.time_step is not None:
            return {"radius": radius, "time_step": self.time_step}
        convert(1.0, str(self.time_unit), "s")
        if self.step is not None:
            return {"radius": radius, "time_step": self.step, "step_unit": self.time_unit}
        return {"radius": radius, "time": (self.time_column, self.time_unit), "rate": self.frame_rate}


def first_with_columns(files: Sequence[Path], layout: Layout) -> tuple[Path, Contents, Layout]:
    """The first file with the columns of numbers that most of the first files hold, and with its decimal sign. Raises
    :class:`DataError`: none holds any.
    """
    points, commas = (replace(layout, decimal=sign) for sign in (".", ","))
    faults, alike = list[str](), dict[tuple[str, ...], list[tuple[Path, Contents, Layout]]]()
    for count, file in enumerate(files):
        if count >= LOOKED_AT and alike:
            break
        try:
            either = [(file, read_contents(file, signs), signs) for signs in (points, commas)]
        except DataError as error:
            faults.append(str(error))
            continue
        template = max(either, key=lambda it: len(it[1].columns))  # points where both are alike
        if columns := template[1].columns:
            alike.setdefault(tuple(columns), []).append(template)
        else:
            faults.append(next(iter(template[1].others.values()), f"{file}: no column holds numbers"))
    if not alike:
        raise DataError("\n".join(faults))
    return max(alike.values(), key=len)[0]


def _only(pattern: re.Pattern[str], names: Iterable[str]) -> str | None:
    fitting = [name for name in names if pattern.fullmatch(name.rpartition(".")[2])]
    return fitting[0] if len(fitting) == 1 else None


def _numbered(names: Sequence[str]) -> str:
    """The pattern with ``*`` of names that differ by a number only, as ``R_1``, ``R_2``, …, or by a capital letter, as
    ``bubble A``, ``bubble B``, …; "" where they do not."""
    for what in (r"\d+", r"(?<![^\W_])[A-Z](?![^\W_])"):
        patterns = {re.sub(what, "*", name, count=1) for name in names}
        if len(patterns) == 1 < len(names) and patterns != {"*"}:
            return patterns.pop()
    return ""
