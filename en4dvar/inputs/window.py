"""The assimilation window: which samples of a series are used, said by its extrema or by times.

A local minimum counts when its prominence exceeds a fraction (10 % by default) of the range of the series from the
window's start on, so that noise of a sample or two makes no minimum (``scipy.signal.find_peaks``).

A window that ends with the smallest sample of several, or begins with the largest, ends or begins with an error of
known sign: it was chosen for its value, and those beside it were left out for theirs. ``top`` and ``trough N`` say the
same instants by what no single sample decides: the vertex of a parabola through the samples about the maximum, and the
middle between the two crossings of half the depth of a minimum, seen between the minima beside it.

A minimum in a hole of the series, which no sample shows (:func:`~en4dvar.data.extrema.with_unseen`), counts as well: a
window ends with the last sample before the hole, or begins with the first behind it.

``20 % of maximum`` is where a series has fallen to that share of its largest sample: a window begins with the first
sample below it and ends with the last one before.

An instant may be followed by another for series that have no such minimum, or do not fall as far: ``trough 2 or end``.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from en4dvar.data.extrema import minima, with_unseen
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.hints import percent, shown
from en4dvar.plumbing.units import UnitError, parse_quantity

_NUMBERED = re.compile(r"(minimum|trough)(?:\s+([1-9]\d*))?")
_SHARE = re.compile(r"(\S+\s*%)\s+of\s+(?:the\s+)?(\S+)")
ABOUT = 0.8  # of the maximum: the samples that are larger tell where the top is


@dataclass(frozen=True)
class Instant:
    """A sample of a series: an end, an extremum (the ``number``-th minimum), or a ``time`` on the file's clock.

    ``top`` and ``trough`` are the maximum and a minimum where several samples, and no single one, put them; ``fall`` is
    where the series has fallen to a ``share`` of its maximum.
    ``otherwise`` is what counts where there is no such minimum or fall; ``text`` says all of it, as it was written.
    """

    kind: Literal["start", "end", "maximum", "minimum", "top", "trough", "fall", "time"]
    number: int = 1
    time: float = 0.0
    share: float = 0.0
    otherwise: "Instant | None" = None
    text: str = field(default="", compare=False)


BY_NAME: dict[str, Instant] = {kind: Instant(kind, text=kind) for kind in ("start", "end", "maximum", "top")}


def parse_instant(text: str | float, time_unit: str, symbols: Collection[str] = ()) -> Instant:
    """``start``, ``end``, ``maximum`` (or ``R_max`` for R among ``symbols``), ``top``, ``minimum 2``, ``trough 2``,
    ``20 % of maximum``, the last three with ``or`` and another of these behind them, or a time with its unit.

    Raises :class:`UnitError` (a ``ValueError``) for anything else.
    """
    word = str(text).strip()
    if word in BY_NAME:
        return BY_NAME[word]
    largest = ("maximum", *(f"{symbol}_max" for symbol in symbols))
    if word in largest:
        return BY_NAME["maximum"]
    first, *others = re.split(r"\s+or\s+", word, maxsplit=1)
    instant = None
    if numbered := _NUMBERED.fullmatch(first):
        kind: Literal["minimum", "trough"] = "minimum" if numbered[1] == "minimum" else "trough"
        instant = Instant(kind, int(numbered[2] or 1))
    elif (said := _SHARE.fullmatch(first)) and said[2] in largest:
        if not 0 < (share := parse_quantity(said[1], "1")) < 1:
            raise UnitError(f"{shown(text)}: the share must lie between 0 and 100 %")
        instant = Instant("fall", share=share)
    if instant is not None:
        return replace(instant, otherwise=parse_instant(others[0], time_unit, symbols) if others else None, text=word)
    if word[:1].isdigit() or word[:1] in "+-.":
        return Instant("time", time=parse_quantity(text, time_unit), text=word)
    kinds = "start, end, maximum, top, 'minimum 2', 'trough 2', '20 % of maximum', 'trough 2 or end', or '3 us'"
    raise UnitError(f"{shown(text)} is not an instant: {kinds}")


def select(times: Array, values: Array, start: Instant, end: Instant, prominence: float = 0.1) -> slice:
    """The window as a slice of the series ``times`` (K,), ``values`` (K,), both ends included. Raises
    :class:`DataError` when an extremum is not there or the window is empty.
    """
    with retold(DataError, DataError, "the window "):
        first = index_of(times, values, start, 0, prominence)
        last = index_of(times, values, end, first, prominence, last=True)
        if last < first:
            between = start.kind == end.kind == "time" and start.time <= end.time
            none = between or first == len(times) or last < 0
            raise DataError("holds no reading" if none else "is empty: it ends before it starts")
    return slice(first, last + 1)


def index_of(
    times: Array, values: Array, instant: Instant, first: int = 0, prominence: float = 0.1, last: bool = False
) -> int:
    """The first sample of ``times`` (K,), ``values`` (K,) from an instant on, or the ``last`` one up to it. Extrema are
    those from the sample ``first`` on. Raises :class:`DataError` when there is none such.
    """
    if instant.kind == "start":
        return 0
    if instant.kind == "end":
        return len(values) - 1
    if instant.kind == "time":
        side: Literal["left", "right"] = "right" if last else "left"
        rounding = 1e-9 * float(np.ptp(times))  # a sample at 3 us may be stored as 3.0000000000000004e-6
        return int(np.searchsorted(times, instant.time + (rounding if last else -rounding), side)) - last
    if instant.kind == "top":
        return int(np.searchsorted(times, vertex(times[first:], values[first:])))
    largest = first + int(np.argmax(values[first:]))
    if instant.kind == "maximum":
        return largest
    falls = instant.kind == "fall"
    below = np.flatnonzero(values[largest:] < instant.share * values[largest]) + largest - first - last
    t, y = with_unseen(times[first:], values[first:])
    indices = below if falls else minima(y, prominence)
    if instant.number > len(indices):
        if instant.otherwise is not None:
            return index_of(times, values, instant.otherwise, first, prominence, last)
        if falls:
            level = f"{100 * instant.share:.3g} % of maximum"
            elsewhere = f"give another instant or a time, or write '{level} or end'"
            raise DataError(f"asks for {level}, but no reading after the maximum is below that; {elsewhere}")
        few = f"only {len(indices)} minima with a prominence of {percent(prominence)} of the range follow its start"
        elsewhere = f"'to: {instant.kind} {instant.number} or end', or at a time"
        advice = f"end it elsewhere ({elsewhere}), or lower its prominence"
        raise DataError(f"asks for minimum {instant.number}, but {few}; {advice}")
    index = int(indices[instant.number - 1])
    if falls:
        return first + index
    at = t[index]
    if instant.kind == "trough":
        begin, _, end = np.concatenate([[0], indices, [len(y) - 1]])[instant.number - 1 :][:3]
        at = _middle(t[begin : end + 1], y[begin : end + 1], index - begin)
    return int(np.searchsorted(times, at, "right")) - (last or t[index] in times)


def vertex(times: Array, values: Array) -> float:
    """When a parabola through the samples about the largest has its vertex; the largest where they make none."""
    largest = int(np.argmax(values))
    low = np.flatnonzero(values < ABOUT * values[largest])
    near = slice(int(max(low[low < largest], default=-1)) + 1, int(min(low[low > largest], default=len(values))))
    t, y = times[near] - times[largest], values[near]
    if len(t) < 5:
        return float(times[largest])
    curvature, slope, _ = np.polyfit(t, y, 2)
    top = -slope / (2 * curvature) if curvature < 0 else 0.0
    return float(times[largest] + np.clip(top, t[0], t[-1]))


def _middle(times: Array, values: Array, index: int) -> float:
    """The middle between the crossings of half the depth (the prominence) of the minimum at ``index``."""
    from scipy.signal import peak_widths

    _, _, left, right = peak_widths(-values, [index], rel_height=0.5)
    return float(np.mean(np.interp([left[0], right[0]], np.arange(len(times)), times)))
