"""Readings that are none of what was observed, as their neighbours tell: a frame that was misread, a slip of a hand.

A window of seven neighbouring readings that is not steep is a polynomial of degree four and errors: the sum of squares
about it, two degrees of freedom, is χ²_2 times the variance of an error. The median over all windows tells that
variance whatever a few of them hold: a bad reading, a gap, a short rebound.
"""

import math

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from en4dvar.model.state import Array

WINDOW, DEGREE = 7, 4
STEEP = 0.5  # of the largest reading of a window: one that holds less, or crosses zero, falls too fast for a polynomial
MEDIAN_OF_CHI2 = 2 * math.log(2)  # of χ²_2
OUTLYING = 8.0  # standard deviations from what its neighbours say
IN_A_ROW = 3  # readings that are judged together
FALLS = 3.0  # standard deviations by which the nearest neighbours lie below the farthest at the bottom of a collapse
ASIDE = np.array([0, 1, 2, -3, -2, -1])  # the neighbours, of a window


def scatter_of(times: Array, values: Array) -> float:
    """Standard deviation of the errors of readings ``values`` (K,) at ``times`` (K,); NaN without a window.

    It is not less than what the readings are rounded to.
    """
    if len(values) < WINDOW:
        return math.nan
    t, r = (sliding_window_view(it, WINDOW) for it in (times, values))
    steps = np.diff(t)
    smooth = (r.min(axis=1) > STEEP * r.max(axis=1)) & (steps.max(axis=1) < 2.5 * steps.min(axis=1))
    if not smooth.any():
        return math.nan
    t, r = t[smooth], r[smooth]
    squares = np.sum((r - _fitted(t, np.arange(WINDOW), DEGREE, r)[0]) ** 2, axis=1)
    return max(math.sqrt(float(np.median(squares)) / MEDIAN_OF_CHI2), _rounding(values))


def _rounding(values: Array) -> float:
    """Standard deviation of what readings lose by the smallest difference that there is between two of them."""
    steps = np.diff(np.unique(values))
    usual = steps[steps > 1e-9 * values.max()]
    return float(usual.min()) / math.sqrt(12) if len(usual) else 0.0


def outlying(times: Array, values: Array, scatter: float) -> npt.NDArray[np.bool_]:
    """Which readings (K,) are far from what three neighbours to either side say, with ``scatter`` as errors have.

    Up to three in a row are judged together. Readings below neighbours that fall towards them from both sides are the
    bottom of a collapse; several that move no farther than their neighbours do are an oscillation.
    """
    odd = np.zeros(len(values), dtype=bool)
    for count in range(1, min(IN_A_ROW, len(values) - len(ASIDE)) + 1):
        t, r = (sliding_window_view(it, len(ASIDE) + count) for it in (times, values))
        near, here = r[:, ASIDE], r[:, 3:-3]
        expected, spread = _fitted(t, ASIDE, 2, near)
        rough = np.sqrt(2 * np.mean((near - expected[:, ASIDE]) ** 2, axis=1))  # of 6 readings and 3 coefficients
        off = here - expected[:, 3:-3]
        far = np.abs(off) > OUTLYING * spread[:, 3:-3] * np.maximum(scatter, rough)[:, None]
        if count > 1:
            far &= (np.abs(off) > np.ptp(near, axis=1)[:, None]) & (np.sign(off) == np.sign(off[:, :1]))
        steep = (near.min(axis=1) < STEEP * near.max(axis=1)) | (here.min(axis=1) < 0.2 * near.min(axis=1))
        falls = near[:, [0, 5]].mean(axis=1) - near[:, [2, 3]].mean(axis=1) > FALLS * scatter
        for first in np.flatnonzero(far.all(axis=1) & ~steep & ~(falls & (off[:, 0] < 0))):
            odd[first + 3 : first + 3 + count] = True
    return odd


def _fitted(t: Array, near: npt.NDArray[np.intp], degree: int, values: Array) -> tuple[Array, Array]:
    """Polynomials through ``values`` (n, k) at the instants ``near`` (k,) of windows ``t`` (n, m).

    At all instants (n, m), and their standard deviations with that of a reading, in errors of one.
    """
    z = (t - t.mean(axis=1, keepdims=True)) / np.ptp(t, axis=1)[:, None]
    powers = z[:, :, None] ** np.arange(degree + 1)
    weights = powers @ np.linalg.pinv(powers[:, near])
    return (weights @ values[:, :, None])[:, :, 0], np.sqrt(1 + np.sum(weights**2, axis=2))
