"""How far readings scatter about the history they were taken of, and which of them are no readings of it.

A window of seven neighbouring readings away from a collapse is a polynomial of degree four and errors: the sum of
squares about it, two degrees of freedom, is χ²_2 times the variance of an error. The median over all windows tells that
variance whatever a few of them hold: a bad reading, a gap, a rebound that is short.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array

WINDOW, DEGREE = 7, 4
STEEP = 0.5  # of the largest reading of a window: one that holds less is on its way into a collapse
MEDIAN_OF_CHI2 = 2 * math.log(2)  # of χ²_2
BAD = 8.0  # standard deviations from what its neighbours say


def noise(times: Array, radius: Array) -> float:
    """Standard deviation of the errors of readings ``radius`` (K,) at ``times`` (K,); NaN without a window.

    It is not less than what the readings are rounded to.
    """
    squares = [float(np.sum((r - _fitted(t, r, t, DEGREE)) ** 2)) for t, r in _windows(times, radius)]
    if not squares:
        return math.nan
    return max(math.sqrt(float(np.median(squares)) / MEDIAN_OF_CHI2), rounding(radius))


def rounding(radius: Array) -> float:
    """Standard deviation of what readings lose by the smallest difference that there is between two of them."""
    steps = np.diff(np.unique(radius))
    usual = steps[steps > 1e-9 * radius.max()]
    return float(usual.min()) / math.sqrt(12) if len(usual) else 0.0


def bad(times: Array, radius: Array, scatter: float) -> npt.NDArray[np.bool_]:
    """Which readings (K,) are no readings of the bubble: far from what three neighbours to either side say."""
    bad = np.zeros(len(radius), dtype=bool)
    for i in range(3, len(radius) - 3):
        near = np.r_[i - 3 : i, i + 1 : i + 4]
        t, r = times[near], radius[near]
        if r.min() < STEEP * r.max() or radius[i] < 0.2 * r.min():
            continue
        expected, spread = _expected(t, r, times[i])
        rough = float(np.sqrt(np.mean((r - _fitted(t, r, t, 2)) ** 2) * 2))  # of 6 readings and 3 coefficients
        bad[i] = abs(radius[i] - expected) > BAD * spread * max(scatter, rough)
    return bad


def _expected(t: Array, r: Array, at: float) -> tuple[float, float]:
    """What a parabola through readings says of another instant, and its std with that of a reading, in errors."""
    scale = np.ptp(t)
    X = np.vander((t - at) / scale, 3)
    inverse = np.linalg.pinv(X)
    return float(inverse[2] @ r), math.sqrt(1 + float(inverse[2] @ inverse[2]))


def _windows(times: Array, radius: Array) -> list[tuple[Array, Array]]:
    windows = []
    for i in range(len(radius) - WINDOW + 1):
        r, t = radius[i : i + WINDOW], times[i : i + WINDOW]
        if r.min() > STEEP * r.max() and np.diff(t).max() < 2.5 * np.diff(t).min():
            windows.append((t, r))
    return windows


def _fitted(t: Array, r: Array, at: Array, degree: int) -> Array:
    z = 2 * (t - t.mean()) / np.ptp(t)
    return np.asarray(np.polyval(np.polyfit(z, r, degree), 2 * (at - t.mean()) / np.ptp(t)))
