"""Readings that are none of what was observed, as their neighbours tell: a frame that was misread, a slip of a hand.

A window of seven neighbouring readings that is not steep is a polynomial of degree four and errors: the sum of squares
about it, two degrees of freedom, is χ²_2 times the variance of an error. The median over all windows tells that
variance whatever a few of them hold: a bad reading, a gap, a short rebound.
"""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array

WINDOW, DEGREE = 7, 4
STEEP = 0.5  # of the largest reading of a window: one that holds less, or crosses zero, falls too fast for a polynomial
MEDIAN_OF_CHI2 = 2 * math.log(2)  # of χ²_2
OUTLYING = 8.0  # standard deviations from what its neighbours say
FALLS = 3.0  # standard deviations by which the nearest neighbours lie below the farthest at the bottom of a collapse


def scatter_of(times: Array, values: Array) -> float:
    """Standard deviation of the errors of readings ``values`` (K,) at ``times`` (K,); NaN without a window.

    It is not less than what the readings are rounded to.
    """
    squares = [float(np.sum((r - _fitted(t, r, t, DEGREE)) ** 2)) for t, r in _windows(times, values)]
    if not squares:
        return math.nan
    return max(math.sqrt(float(np.median(squares)) / MEDIAN_OF_CHI2), _rounding(values))


def _rounding(values: Array) -> float:
    """Standard deviation of what readings lose by the smallest difference that there is between two of them."""
    steps = np.diff(np.unique(values))
    usual = steps[steps > 1e-9 * values.max()]
    return float(usual.min()) / math.sqrt(12) if len(usual) else 0.0


def outlying(times: Array, values: Array, scatter: float) -> npt.NDArray[np.bool_]:
    """Which readings (K,) are far from what three neighbours to either side say, with ``scatter`` as errors have.

    A reading below neighbours that fall towards it from both sides is the bottom of a collapse.
    """
    odd = np.zeros(len(values), dtype=bool)
    for i in range(3, len(values) - 3):
        near = np.r_[i - 3 : i, i + 1 : i + 4]
        t, r = times[near], values[near]
        if r.min() < STEEP * r.max() or values[i] < 0.2 * r.min():
            continue
        expected, spread = _expected(t, r, times[i])
        if values[i] < expected and (r[0] + r[5] - r[2] - r[3]) / 2 > FALLS * scatter:
            continue
        rough = float(np.sqrt(np.mean((r - _fitted(t, r, t, 2)) ** 2) * 2))  # of 6 readings and 3 coefficients
        odd[i] = abs(values[i] - expected) > OUTLYING * spread * max(scatter, rough)
    return odd


def _expected(t: Array, r: Array, at: float) -> tuple[float, float]:
    """What a parabola through readings says of another instant, and its std with that of a reading, in errors."""
    scale = np.ptp(t)
    X = np.vander((t - at) / scale, 3)
    inverse = np.linalg.pinv(X)
    return float(inverse[2] @ r), math.sqrt(1 + float(inverse[2] @ inverse[2]))


def _windows(times: Array, values: Array) -> Iterator[tuple[Array, Array]]:
    for i in range(len(values) - WINDOW + 1):
        r, t = values[i : i + WINDOW], times[i : i + WINDOW]
        if r.min() > STEEP * r.max() and np.diff(t).max() < 2.5 * np.diff(t).min():
            yield t, r


def _fitted(t: Array, r: Array, at: Array, degree: int) -> Array:
    z = 2 * (t - t.mean()) / np.ptp(t)
    return np.asarray(np.polyval(np.polyfit(z, r, degree), 2 * (at - t.mean()) / np.ptp(t)))
