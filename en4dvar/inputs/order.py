"""Times that do not increase: refused with a place, sorted, or the readings of one time averaged, as was said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError


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
