"""Series from data files: times, readings and their errors in the units of a model.

Rows that hold NaN or a blank are dropped; every remaining number must be finite and the times must increase. Fields of
``.mat`` files may be rows or columns; their leading zeros and NaN (frames before nucleation) are dropped and their
scalars collected. Of a column that cannot be zero all numbers of 0 or below are dropped, from CSV files too, and those
below 0, or after its first reading, are told: they are codes of missing readings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.inputs.implausible import (
    APART,
    SHOTS,
    check_order,
    cut_off,
    level_top,
    once_more,
    outlying,
    placeholders,
    scatter_of,
    step_doubts,
)
from en4dvar.inputs.parts import ANY, Column, Layout, TimeStep, columns_of
from en4dvar.inputs.text_table import remarks_in
from en4dvar.inputs.window import Instant, index_of, select
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.hints import percent, suggest
from en4dvar.plumbing.units import convert, unit_after

Rows = npt.NDArray[np.intp]
AGAIN = "one number again and again, far above all others, as a missing reading may be written"
CLIPPED = "one largest number though those beside them lead higher, as where a bubble leaves the picture"
LEVEL = "level but for scatter though those beside them lead higher, as where a bubble leaves the picture"
FAR, BELOW = "far from what their neighbours say", "0 or below, as a missing reading may be written"


@dataclass(frozen=True)
class Readings:
    """One observable in time, in the model's units, times increasing; ``scalars`` as the file has them.

    ``errors`` are the columns that were asked for besides, by name, one number a reading; ``left_out`` the times of
    readings that are none, by the reason. ``rows`` are those of the file, counted from 0, that the readings stand in,
    none where several are one reading, their mean; it has ``count`` rows, of which ``usable`` hold a reading. ``clock``
    is the column of times, where there is one.
    """

    times: Array
    values: Array
    source: str
    scalars: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, Array] = field(default_factory=dict)
    left_out: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    rows: Rows | None = None
    count: int = 0
    usable: Rows | None = None
    clock: Column | None = None

    def window(self, start: Instant, end: Instant, prominence: float) -> slice:
        """Those from one instant to another. Raises :class:`DataError` where there are none."""
        try:
            window = select(self.times, self.values, start, end, prominence)
            if not len(self.times[window]):
                raise DataError("no observation lies in the window")
        except DataError as error:
            span = ""
            if self.clock is not None:
                first, last = convert(self.times[[0, -1]], self.clock.target, self.clock.unit)
                span = f"; the readings go from {first:g} to {last:g} {self.clock.unit}"
            raise DataError(f"{self.source}: {error}{span}") from None
        return window

    def next_end(self, begin: int, after: range, prominence: float) -> str:
        """The first trough among those ``after`` a window that begins with the reading ``begin``; "" for none."""
        number = 0
        while after:
            trough = Instant("trough", number := number + 1)
            try:
                at = index_of(self.times, self.values, trough, begin, prominence, last=True)
            except DataError:
                return ""
            if at >= after.start:
                return f"trough {number}" if at in after else ""
        return ""

    @property
    def doubts(self) -> tuple[Caution, ...]:
        """Readings that were left out, and warnings about implausible times, where the file states them."""
        clock, times, left_out = self.clock, np.unique(self.times), tuple[Caution, ...]()
        every = len(self.times) + sum(map(len, self.left_out.values()))
        for reason, when in self.left_out.items():
            words = f"readings left out, for they are {reason}: {len(when)} of {every}"
            if clock is not None:
                listed = convert(np.array(when[:6]), clock.target, clock.unit)
                more = " …" if len(when) > 6 else ""
                words += f", at {', '.join(f'{time:.6g}' for time in listed)}{more} {clock.unit}"
            left_out += (caution("down-weighted", words),)
        if len(times) == len(self.times) > 0:
            cut = cut_off(times, self.values, scatter_of(times, self.values))
            if cut.any():
                words = f"{cut.sum()} readings at the top are {CLIPPED}: leave them out (data.outliers: leave out)"
                left_out += (caution("implausible-data", words),)
        if clock is None or len(times) < 3:
            return left_out
        return left_out + step_doubts(times, clock.target, clock.unit, self.scalars, clock.rate)

    def doubts_of(self, window: slice, start: Instant) -> tuple[Caution, ...]:
        """:attr:`doubts`, and what stands outside the window where it begins at the largest reading."""
        k = once_more(self.values, window) if start.kind in ("maximum", "top") else None
        if k is None:
            return self.doubts
        share, where = percent(self.values[k] / self.values.max()), f"in reading {k + 1}"
        if self.clock is not None:
            at = convert(self.times[k], self.clock.target, self.clock.unit)
            where = f"at {at:.6g}{unit_after(self.clock.unit)} of the file"
        words = f"outside the window the readings rise to {share} of their largest once more, {where}: several shots?"
        return (*self.doubts, Caution("implausible-data", "caution", words, SHOTS))

    def rows_among(self, size: int, used: slice) -> Rows:
        """Where the readings ``used`` stand in a table of ``size`` rows that follow each other as in the file. There is
        one a row of the file, one a usable row, or one a reading that is used. Raises :class:`DataError`.
        """
        number = len(self.times[used])
        if self.rows is None or self.usable is None:
            if size == number:
                return np.arange(number)
            raise DataError(f"{size} rows, but {number} observations, of which some are means of readings of one time")
        rows = self.rows[used]
        for every in (np.arange(self.count), self.usable, np.sort(rows)):
            if len(every) == size:
                return np.searchsorted(every, rows)
        counts = f"{number} observations are used, of {len(self.usable)} usable ones in {self.count} rows of data"
        raise DataError(f"{size} rows, but {counts}; give a row to each of one of these")


def read_series(
    path: Path,
    time: Column | TimeStep,
    value: Column,
    layout: Layout = ANY,
    errors: Sequence[Column] = (),
    part: str = "",
    repeats: bool = False,
    fewest: int = 3,
) -> Readings:
    """Read one data set.

    ``errors`` are columns of standard deviations (or weights, or places), each as long as that of the values.
    ``part``: see :func:`parts_of`. ``repeats``: there may be several readings at a time, in any order of times.
    ``fewest`` usable readings are needed.

    Raises :class:`DataError`: the file cannot be used.
    """
    if part and layout.by is None and "*" in value.name:
        value = replace(value, name=part)
    asked = [column for column in (value, time, *errors) if isinstance(column, Column)]
    wanted = [column.name for column in asked]
    columns, scalars, lines = columns_of(path, layout, wanted, part)
    converted = {column: convert(columns[column.name], column.unit, column.target) for column in asked}
    values = converted[value]
    frames, numbers = np.arange(float(len(values))), lines if layout.by is None else []
    times = converted[time] if isinstance(time, Column) else _step(time, scalars, path, numbers) * frames
    if not len(values):
        raise DataError(f"{path}: {value.name!r} is empty")
    if len(times) != len(values):
        raise DataError(f"{path}: {len(times)} times but {len(values)} values of {value.name!r}")
    zero = bool(lines) and not value.positive
    first = 0 if zero else int(np.argmax(values > 0 if value.positive else np.nan_to_num(values) != 0))
    kept = np.arange(first, len(values))[~(np.isnan(times) | np.isnan(values))[first:]]
    left_out = dict[str, tuple[float, ...]]()
    if value.positive:
        kept = kept[values[kept] > 0]
        codes = (values <= 0) & ((values < 0) | (np.arange(len(values)) >= first)) & ~np.isnan(times)
        left_out |= {BELOW: tuple(np.sort(times[codes]))} if codes.any() else {}
    for column in asked[: 1 + isinstance(time, Column)]:
        _require_finite(columns[column.name], column.name, kept[np.isinf(converted[column][kept])], lines, path)
    _check(values[kept], value.name, path, fewest, zero)
    if repeats:
        kept = kept[np.argsort(times[kept], kind="stable")]
    stated = {c.name: _stds(c, converted[c], columns[c.name], kept, len(values), path) for c in errors}
    if isinstance(time, Column) and not repeats:
        written = columns[time.name][kept]
        bounds = any(column.kind == "mark" for column in errors)
        check_order(path, layout, kept, lines, written, time.unit, wanted, bounds, times[kept], values[kept])
        if layout.unsorted == "sort":
            order = np.argsort(times[kept], kind="stable")
            kept, stated = kept[order], {name: stds[order] for name, stds in stated.items()}
    count, usable = len(times), np.sort(kept)
    rows: Rows | None = kept
    times, values = times[kept], values[kept]
    each, which, counts = np.unique(times, return_inverse=True, return_counts=True)
    if not repeats and len(each) < len(times):  # readings of one time as their mean, their errors as independent
        for c in errors:
            own = stated[c.name]
            if c.kind == "mark" and np.any(np.bincount(which, own)[counts > 1]):
                raise DataError(f"{path}: a bound is not averaged with another reading of its time; {APART}")
            sums = np.sqrt(np.bincount(which, own**2)) if c.kind == "std" else np.bincount(which, own)
            stated[c.name] = np.asarray(sums / counts)
        times, values, rows = each, np.bincount(which, values) / counts, None
    clock = time if isinstance(time, Column) else None
    read = Readings(times, values, str(path), scalars, stated, left_out, rows, count, usable, clock)
    return _rest(read, layout, fewest, value.positive)


ODD = {AGAIN: lambda _, values, __: placeholders(values), CLIPPED: cut_off, LEVEL: level_top, FAR: outlying}
"""Why readings are left out, in this order, and what tells which of times, values and the std of errors. LEVEL is asked
of what is positive, as a radius is: a voltage or a temperature may be held."""


def _rest(read: Readings, layout: Layout, fewest: int, positive: bool) -> Readings:
    """Without outliers and what is before an instant, where the layout says so. Raises :class:`DataError`."""
    if layout.outliers == "leave out":
        for reason, which in ODD.items():
            if reason == LEVEL and not positive:
                continue
            t, y = read.times, read.values
            odd = which(t, y, scatter_of(t, y))
            told = {reason: tuple(t[odd])} if odd.any() else {}
            read = replace(_kept(read, ~odd), left_out={**read.left_out, **told})
    if layout.since != ANY.since:
        with retold(DataError, DataError, f"{read.source}: data.since "):
            since = slice(index_of(read.times, read.values, layout.since), None)
            left, count = len(read.times[since]), len(read.times)
            if left < fewest:
                raise DataError(f"leaves {left} of {count} readings; at least {fewest} are needed")
        read = _kept(read, since)
    return read


def _kept(read: Readings, which: slice | npt.NDArray[np.bool_]) -> Readings:
    errors = {name: column[which] for name, column in read.errors.items()}
    rows = None if read.rows is None else read.rows[which]
    return replace(read, times=read.times[which], values=read.values[which], errors=errors, rows=rows)


def _stds(column: Column, every: Array, written: Array, kept: Rows, count: int, path: Path) -> Array:
    """Standard deviations, weights or places of the kept readings; one missing or of a wrong sign raises DataError."""
    if len(every) != count:
        raise DataError(f"{path}: {len(every)} values of {column.name!r} but {count} readings")
    stds = every[kept]
    fits, wrong_sign = {
        "std": (stds > 0, "not positive"),
        "weight": (stds >= 0, "negative"),
        "mark": (np.isin(stds, (0, 1)), "neither 0 nor 1"),
    }.get(column.kind, (np.isfinite(stds), "not finite"))
    wrong = np.flatnonzero(~(np.isfinite(stds) & fits))
    if len(wrong):
        said = written[kept[wrong[0]]]
        sign = wrong_sign if np.isfinite(said) else "not finite"
        what = "is blank" if np.isnan(said) else f"is {said:g}, {sign}"
        noun = {"std": "error", "shared": "shared error"}.get(column.kind, column.kind)
        raise DataError(f"{path}: the {noun} of reading {kept[wrong[0]] + 1} in column {column.name!r} {what}")
    return stds


def _require_finite(column: Array, name: str, wrong: Rows, lines: Sequence[int], path: Path) -> None:
    """Raise :class:`DataError` where there are rows ``wrong``, infinite in the model's unit."""
    if len(wrong):
        where = f":{lines[wrong[0]]}" if lines else f": sample {wrong[0] + 1}"
        told = f"{column[wrong[0]]:g} in column {name!r}"
        raise DataError(f"{path}{where}: {told}; correct it, or leave it blank (NaN) if the reading is missing")


def _check(values: Array, name: str, path: Path, fewest: int, zero: bool) -> None:
    """Raise :class:`DataError` where readings are of no use; ``zero``: all of them may be."""
    if not len(values) or not (zero or np.any(values)):
        none = "blank" if zero else "blank, or not above zero"
        raise DataError(f"{path}: {name!r} holds no usable value (all NaN, or {none})")
    if len(values) < fewest:
        raise DataError(f"{path}: {len(values)} usable observations; at least {fewest} are needed")


def scalar_of(column: Column, scalars: Mapping[str, float], path: Path, what: str) -> float:
    """A scalar of a file in the model's unit. Raises :class:`DataError` where the file holds none of the name."""
    if column.name not in scalars:
        raise DataError(f"{path}: no scalar {column.name!r} for {what}{suggest(column.name, scalars)}")
    return float(convert(scalars[column.name], column.unit, column.target))


def _step(step: TimeStep, scalars: Mapping[str, float], path: Path, lines: Sequence[int]) -> float:
    """The constant step. Raises :class:`DataError`: it is none, or a line of the table between others holds nothing."""
    skips = np.diff(lines)
    if np.any(skips > min(skips, default=1)):
        skips -= np.diff(np.searchsorted(remarks_in(path), lines))
    if len(uneven := np.flatnonzero(skips > min(skips, default=1))):
        where = f"{path}:{lines[uneven[0]] + min(skips)}: a line without a reading between others of a constant step"
        raise DataError(f"{where}; write NaN in it where a frame has none, or delete it where no frame is missing")
    value = step.value if step.column is None else scalar_of(step.column, scalars, path, "the time step")
    if not value > 0:
        raise DataError(f"{path}: the time step {value:g} is not positive")
    return value
