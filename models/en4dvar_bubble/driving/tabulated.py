"""A measured driving pressure p(t), from a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from en4dvar.inputs.parts import Column, Format, Layout
from en4dvar.inputs.readers import read_series
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.errors import retold
from en4dvar_bubble.driving.base import Driving, PulseNumber, Shape

if TYPE_CHECKING:
    from scipy.interpolate import BPoly, CubicSpline

_MOST_CELLS = 200_000
_DELAY = Parameter("pulse_delay", "s", label="delay of the pulse", symbol=r"$\delta$", display_unit="us")
_STRETCH = Parameter(
    "pulse_stretch", "1", "lognormal", (0.0, np.inf), "time scale of the pulse over that of its record", "$s$"
)
OF_RECORD = (PulseNumber(_DELAY, "delay", 0.0, "delay"), PulseNumber(_STRETCH, "", 1.0, "stretch"))
"""What can be a parameter of a record: its times are stretched about their zero, and then delayed."""
_PROMINENCE = 0.02  # of the largest |p|: turning points that no time step may straddle


def _record(t: Array, spline: CubicSpline, before: BPoly, after: BPoly) -> Array:
    """Cubic spline through the samples, led from and to zero by one quintic at either end."""
    parts = [part(np.clip(t, part.x[0], part.x[-1])) for part in (before, spline, after)]
    return np.asarray(np.where(t < spline.x[0], parts[0], np.where(t > spline.x[-1], parts[2], parts[1])))


def tabulated(times: Array, pressure: Array, delay: float = 0.0, scale: float = 1.0) -> Driving:
    """p_f through samples (K,) at increasing ``times`` (s), shifted by ``delay`` and multiplied by ``scale``.

    Interpolation is the cubic spline with continuous curvature (not-a-knot). Outside the record p_f is zero: over one
    sampling interval before the first and after the last sample a quintic leads there smoothly. Raises ValueError for
    fewer than four samples, times that do not increase, values that are not finite, a record of zeros, or sampling so
    uneven that it would take more than 200 000 cells.
    """
    t = np.asarray(times, dtype=float) + delay
    p = np.asarray(pressure, dtype=float) * scale
    if t.ndim != 1 or t.shape != p.shape or len(t) < 4:
        raise ValueError("a tabulated driving needs at least four samples, one pressure for each time")
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(p)) and np.all(np.diff(t) > 0)):
        raise ValueError("a tabulated driving needs finite pressures at finite, increasing times")
    largest = float(np.abs(p).max())
    if largest == 0.0:
        raise ValueError("the tabulated pressure is zero throughout; write kind: none")
    span, gaps = t[-1] - t[0], np.diff(t)
    even = span / (len(t) - 1)
    # On a uniform grid the knots are edges of cells and the table is exact; otherwise four cells for the shortest gap.
    uniform = bool(np.all(np.abs(t - (t[0] + even * np.arange(len(t)))) < 1e-3 * even))
    if uniform:
        t, lead, inner = t[0] + even * np.arange(len(t)), even, len(t) - 1
    else:
        inner = int(np.ceil(4 * span / gaps.min()))
        lead = span / inner
    if inner + 2 > _MOST_CELLS:
        raise ValueError(f"{inner + 2} cells for {len(t)} samples, more than {_MOST_CELLS}: resample the record evenly")
    from scipy.interpolate import BPoly, CubicSpline  # half a second at the start of every worker that needs neither
    from scipy.signal import find_peaks

    peaks = np.concatenate([find_peaks(sign * p, prominence=_PROMINENCE * largest)[0] for sign in (1, -1)])
    spline, zero = CubicSpline(t, p / largest), np.zeros(3)  # with its derivatives
    first, last = (np.array([spline(at, order) for order in range(3)]) for at in t[[0, -1]])
    before = BPoly.from_derivatives([t[0] - lead, t[0]], [zero, first])
    shape = Shape(_record, (spline, before, BPoly.from_derivatives([t[-1], t[-1] + lead], [last, zero])))
    stops = (float(t[0]), *(float(t[i]) for i in peaks), float(t[-1]))
    numbers = tuple(replace(number, value=delay) if number.role == "delay" else number for number in OF_RECORD)
    return Driving(largest, float(t[0] - lead), float(t[-1] + lead), shape, inner + 2, stops, numbers)


def from_file(
    path: Path,
    time: tuple[str, str],
    pressure: tuple[str, str],
    delay: float = 0.0,
    scale: float = 1.0,
    format: Format | None = None,
) -> Driving:
    """:func:`tabulated` from a CSV or ``.mat`` file; ``time`` and ``pressure`` are (column, unit).

    Raises :class:`~en4dvar.plumbing.errors.DataError` for a file that cannot be read, ValueError as :func:`tabulated`.
    """
    series = read_series(path, Column(*time, "s"), Column(*pressure, "Pa"), Layout(format))
    with retold(ValueError, ValueError, f"{path}: "):
        return tabulated(series.times, series.values, delay, scale)
