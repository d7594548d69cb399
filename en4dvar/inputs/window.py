"""The assimilation window: which samples of a series are used, said by its extrema or by times.

A local minimum counts when its prominence exceeds a fraction (10 % by default) of the range of the series from the
window's start on, so that noise of a sample or two makes no minimum (``scipy.signal.find_peaks``).
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.units import UnitError, parse_quantity

_MINIMUM = re.compile(r"minimum(?:\s+(\d+))?")


@dataclass(frozen=True)
class Instant:
    """A sample of a series: an end, an extremum (the ``number``-th minimum), or a ``time`` on the file's clock."""

    kind: Literal["start", "end", "maximum", "minimum", "time"]
    number: int = 1
    time: float = 0.0


BY_NAME: dict[str, Instant] = {kind: Instant(kind) for kind in ("start", "end", "maximum")}


def parse_instant(text: str | float, time_unit: str, symbols: Collection[str] = ()) -> Instant:
    """``start``, ``end``, ``maximum`` (or ``R_max`` for R among ``symbols``), ``minimum 2``, or a time with its unit.

    Raises :class:`UnitError` (a ``ValueError``) for anything else.
    """
    word = str(text).strip()
    if word in BY_NAME:
        return BY_NAME[word]
    if word.endswith("_max") and word.removesuffix("_max") in symbols:
        return Instant("maximum")
    minimum = _MINIMUM.fullmatch(word)
    if minimum and minimum[1] != "0":
        return Instant("minimum", int(minimum[1] or 1))
    if word[:1].isdigit() or word[:1] in "+-.":
        return Instant("time", time=parse_quantity(text, time_unit))
    raise UnitError(
        f"{shown(text)} is not an instant; write start, end, maximum, 'minimum 2', or a time such as '3 us'"
    )


def select(times: Array, values: Array, start: Instant, end: Instant, prominence: float = 0.1) -> slice:
    """The window as a slice of the series ``times`` (K,), ``values`` (K,), both ends included.

    Raises :class:`DataError` when an extremum is not there or the window is empty.
    """
    first = _index(times, values, start, 0, prominence)
    last = _index(times, values, end, first, prominence, last=True)
    if last < first:
        raise DataError("the window is empty: it ends before it starts")
    return slice(first, last + 1)


def _index(times: Array, values: Array, instant: Instant, first: int, prominence: float, last: bool = False) -> int:
    if instant.kind == "start":
        return 0
    if instant.kind == "end":
        return len(values) - 1
    if instant.kind == "time":
        side: Literal["left", "right"] = "right" if last else "left"
        rounding = 1e-9 * float(np.ptp(times))  # a sample at 3 us may be stored as 3.0000000000000004e-6
        return int(np.searchsorted(times, instant.time + (rounding if last else -rounding), side)) - last
    if instant.kind == "maximum":
        return first + int(np.argmax(values[first:]))
    indices = minima(values[first:], prominence)
    if instant.number > len(indices):
        raise DataError(
            f"the window asks for minimum {instant.number}, but only {len(indices)} minima with a prominence of "
            f"{prominence:.0%} of the range follow its start"
        )
    return first + int(indices[instant.number - 1])


def minima(values: Array, prominence: float = 0.1) -> Array:
    """Indices of the local minima of ``values`` (K,) with at least ``prominence`` times its range."""
    from scipy.signal import find_peaks

    if len(values) < 3:
        return np.empty(0, dtype=int)
    indices, _ = find_peaks(-values, prominence=prominence * np.ptp(values))
    return np.asarray(indices)
