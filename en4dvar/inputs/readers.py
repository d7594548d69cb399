"""Series from data files: times, readings and their errors in the units of a model.

Rows that hold NaN or a blank are dropped; every remaining number must be finite and the times must increase. Fields of
``.mat`` files may be rows or columns; their leading zeros and NaN (frames before nucleation) are dropped and their
scalars collected. Leading zeros of a column that cannot be zero are dropped from CSV files too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.inputs.asked import ANY, Column, Layout, TimeStep
from en4dvar.inputs.parts import columns_of
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.units import convert


@dataclass(frozen=True)
class Readings:
    """One observable in time, in the model's units, times increasing; ``scalars`` as the file has them.

    ``errors`` are the columns that were asked for besides, by name, one number a reading.
    """

    times: Array
    values: Array
    source: str
    scalars: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, Array] = field(default_factory=dict)


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

    Raises
    ------
    DataError: the file cannot be used.
    """
    if part and layout.by is None and "*" in value.name:
        value = replace(value, name=part)
    wanted = [c.name for c in (value, time, *errors) if isinstance(c, Column)]
    columns, scalars, lines = columns_of(path, layout, wanted, part)
    values = convert(columns[value.name], value.unit, value.target)
    if isinstance(time, Column):
        times = convert(columns[time.name], time.unit, time.target)
    else:
        times = np.asarray(_step(time, scalars, path) * np.arange(len(values)), dtype=float)
    if not len(values):
        raise DataError(f"{path}: {value.name!r} is empty")
    if len(times) != len(values):
        raise DataError(f"{path}: {len(times)} times but {len(values)} values of {value.name!r}")
    zero = bool(lines) and not value.positive
    first = 0 if zero else int(np.argmax(np.nan_to_num(values) != 0))
    kept = np.arange(first, len(values))[~(np.isnan(times) | np.isnan(values))[first:]]
    _check(times[kept], values[kept], value.name, path, fewest, zero)
    if repeats:
        kept = kept[np.argsort(times[kept], kind="stable")]
    stated = {column.name: _stds(columns[column.name], column, kept, len(values), path) for column in errors}
    if isinstance(time, Column) and not repeats:
        written = Written(columns[time.name], time.unit, lines, path)
        order = in_order(times[kept], layout.unsorted == "sort", layout.repeated == "average", kept, written)
        kept, stated = kept[order], {name: stds[order] for name, stds in stated.items()}
    if repeats:
        return Readings(times[kept], values[kept], str(path), scalars, stated)
    means = Means(times[kept])
    stated = {c.name: (means.std if c.kind == "std" else means.of)(stated[c.name]) for c in errors}
    return Readings(means.times, means.of(values[kept]), str(path), scalars, stated)


def _stds(written: Array, column: Column, kept: npt.NDArray[np.intp], count: int, path: Path) -> Array:
    """What belongs to the kept readings: standard deviations, weights or places.

    Raises :class:`DataError` where one is missing, or of the wrong sign.
    """
    if len(written) != count:
        raise DataError(f"{path}: {len(written)} values of {column.name!r} but {count} readings")
    stds = np.asarray(convert(written[kept], column.unit, column.target))
    fits, wrong_sign = {
        "std": (stds > 0, "not positive"),
        "shared": (np.isfinite(stds), "not finite"),
        "weight": (stds >= 0, "negative"),
        "place": (np.isfinite(stds), "not finite"),
        "mark": (np.isin(stds, (0, 1)), "neither 0 nor 1"),
    }[column.kind]
    wrong = np.flatnonzero(~(np.isfinite(stds) & fits))
    if len(wrong):
        said = written[kept[wrong[0]]]
        sign = wrong_sign if np.isfinite(said) else "not finite"
        what = "is blank" if np.isnan(said) else f"is {said:g}, {sign}"
        noun = {"std": "error", "shared": "shared error"}.get(column.kind, column.kind)
        raise DataError(f"{path}: the {noun} of reading {kept[wrong[0]] + 1} in column {column.name!r} {what}")
    return stds


def _check(times: Array, values: Array, name: str, path: Path, fewest: int, zero: bool) -> None:
    """Raise :class:`DataError` where readings are of no use; ``zero``: all of them may be."""
    if not len(values) or not (zero or np.any(values)):
        raise DataError(
            f"{path}: {name!r} holds no usable value (all NaN{', or blank' if zero else ', blank or zero'})"
        )
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
        raise DataError(f"{path}: infinite values")
    if len(values) < fewest:
        raise DataError(f"{path}: {len(values)} usable observations; at least {fewest} are needed")


def _step(step: TimeStep, scalars: Mapping[str, float], path: Path) -> float:
    if step.column is None:
        value = step.value
    elif step.column.name not in scalars:
        raise DataError(f"{path}: no scalar {step.column.name!r} for the time step{suggest(step.column.name, scalars)}")
    else:
        value = convert(scalars[step.column.name], step.column.unit, step.column.target)
    if not value > 0:
        raise DataError(f"{path}: the time step {value:g} is not positive")
    return value


@dataclass(frozen=True)
class Written:
    """Times (K,) in ``unit`` as the file has them, and its lines (K,), () where it has none."""

    times: Array
    unit: str
    lines: Sequence[int]
    path: Path


def in_order(
    times: Array, sort: bool, repeat: bool, kept: npt.NDArray[np.intp], written: Written
) -> npt.NDArray[np.intp]:
    """Indices (K,) that put ``times`` (K,) in order; ``kept`` (K,) are their places in the file.

    Raises :class:`DataError`: they are not and shall not be sorted, or a time occurs again and may not (``repeat``).
    """
    order = np.argsort(times, kind="stable") if sort else np.arange(len(times))
    steps = np.diff(times[order])
    wrong = np.flatnonzero(steps < 0 if repeat else steps <= 0)
    if len(wrong):
        before, after = kept[order[wrong[0] : wrong[0] + 2]]
        raise DataError(_disorder(before, after, kept[0], written))
    return order


def _disorder(before: int, after: int, first: int, written: Written) -> str:
    times, lines = written.times, written.lines
    where = f"{written.path}:{lines[after]}" if lines else f"{written.path}: sample {after + 1}"
    sort = "sort the rows (data.unsorted: sort)"
    hint = f"; correct it, or {sort}"
    if times[after] == times[before]:
        hint = "; keep one of the two readings, or their mean (data.repeated: average)"
    elif times[after] <= times[first]:
        hint = (
            f"; if another series begins here, give it a file of its own or say whose each row is (data.by); or {sort}"
        )
    unit = "" if "*" in written.unit else f" {written.unit}"
    return f"{where}: times must increase, but {times[after]:g}{unit} follows {times[before]:g}{unit}{hint}"


class Means:
    """Readings of the same time as their mean; ``times`` (K',) are each once, of ``ordered`` (K,)."""

    def __init__(self, ordered: Array):
        self.times, self._which, self._counts = np.unique(ordered, return_inverse=True, return_counts=True)

    def of(self, values: Array) -> Array:
        """Means (K',) of ``values`` (K,)."""
        if len(self.times) == len(values):
            return values
        return np.asarray(np.bincount(self._which, values) / self._counts)

    def std(self, stds: Array) -> Array:
        """Standard deviations (K',) of means of independent readings with ``stds`` (K,)."""
        if len(self.times) == len(stds):
            return stds
        return np.asarray(np.sqrt(np.bincount(self._which, stds**2)) / self._counts)
