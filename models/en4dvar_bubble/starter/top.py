r"""When a bubble was largest and how large: from the readings around its top, with errors.

About the top R^{5/2} is a parabola in t (Rayleigh's collapse, :mod:`en4dvar_bubble.collapse`), up to what growth and
collapse differ by, a term t³. With n readings of relative error ε within ± T of it the parabola's top is known to

    σ_t = ε t_c² √(3/n) / (0.84 T),

so that a wide window is the better one as long as it is not biased; beside readings that are exact, its bias is its
error. A cubic takes away what that term does, and has 2.5 times the error. The width is chosen by intersecting
confidence intervals (Goldenshluger & Nemirovski 1997, Math. Methods Statist. 6, 135): from narrow to wide, until one
of the estimates contradicts those before it. The largest reading itself, which is no estimate, lies up to √(ε/0.42) t_c
off and is too high by about ε √(2 ln n).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar_bubble.collapse import lobe

WINDOWS = (0.15, 0.2, 0.27, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85)  # half widths in collapse times
LOWEST = 0.45  # of R_max: what lies lower belongs to the end of the collapse, or to the beginning of the growth
FEWEST, CUBIC = 5, 8  # readings through which a parabola and a cubic are laid
AGREE = 2.0  # standard deviations
FORM = 0.002  # of the height: what R^{5/2} is not a polynomial by
CHOSEN, ONE_SIDED = 1.3, 2.5  # errors of a window that the readings chose themselves are larger by these factors


@dataclass(frozen=True)
class Top:
    """``time`` (s) and ``height`` (m) of the maximum, and their standard errors.

    ``reading`` is the number of the largest reading, bad ones left out.
    """

    time: float
    height: float
    time_std: float
    height_std: float
    reading: int


def top(times: Array, radius: Array, scatter: float) -> Top:
    """Of a history ``times`` (K,) s, ``radius`` (K,) m without bad readings, whose errors have the std ``scatter``."""
    reading = int(np.argmax(radius))
    estimates = list(_estimates(times, radius, scatter))
    if not estimates:  # a few readings between which anything may lie
        step = float(np.median(np.diff(times)))
        return Top(float(times[reading]), float(radius[reading]), step, 0.03 * float(radius[reading]), reading)
    low, high = np.full(2, -np.inf), np.full(2, np.inf)
    chosen = estimates[0]
    for value, std in estimates:
        low, high = np.maximum(low, value - AGREE * std), np.minimum(high, value + AGREE * std)
        if np.any(low > high):
            break
        if std[0] < chosen[1][0]:
            chosen = value, std
    value, std = chosen
    wider = CHOSEN if np.sum(times < value[0]) > 1 else ONE_SIDED
    return Top(float(value[0]), float(value[1]), wider * float(std[0]), wider * float(std[1]), reading)


def _estimates(times: Array, radius: Array, scatter: float) -> Iterator[tuple[Array, Array]]:
    """Time and height, and their std, by windows from narrow to wide."""
    try:
        seen, before = lobe(times, radius), 0
    except DataError:
        return
    for share in WINDOWS:
        near = (np.abs(times - seen.t_max) <= share * seen.t_c) & (radius > LOWEST * seen.R_max)
        count = int(near.sum())
        if count < FEWEST or count == before:
            continue
        before = count
        if (estimate := _vertex(times[near], radius[near], scatter, seen.t_c)) is not None:
            yield estimate


def _vertex(t: Array, r: Array, scatter: float, t_c: float) -> tuple[Array, Array] | None:
    """Top of the parabola or cubic R^{5/2} through readings, and its std; None where there is none.

    Of a cubic where the readings lie to both sides, which growth that is slower than the collapse does not move. The
    std holds the errors of the readings to first order, and :data:`FORM`, which as a tilt of half of the readings
    moves the top by 5/2 of it over the parabola's curvature.
    """
    middle, scale, largest = 0.5 * (t[0] + t[-1]), 0.5 * float(np.ptp(t)), float(r.max())
    z, y = (t - middle) / scale, np.clip(r / largest, 0.05, None)
    smooth = np.clip(np.polyval(np.polyfit(z, y**2.5, 2), z), 0.05, None) ** 0.4
    weight = smooth**-1.5 / 2.5  # an error of R is one of 5/2 R^{3/2} in R^{5/2}
    parabola, cubic = (_fit(z, y**2.5, weight, scatter / largest, degree, 2 * (scale / t_c) ** 2) for degree in (2, 3))
    if parabola is None:
        return None
    (at, height), variance = parabola
    if cubic is not None and len(t) >= CUBIC:
        there, of_cubic = cubic
        if np.sum(z < there[0]) >= 0.25 * len(z):
            (at, height), variance = there, of_cubic
        else:  # from the way down alone a cubic tells how far off a parabola may be, and no more
            variance = variance + (there - parabola[0]) ** 2
    std = np.hypot(np.sqrt(variance), FORM * np.array([1.25 * (t_c / scale) ** 2, 1.0]))
    return np.array([middle + scale * at, largest * height]), np.array([scale, largest]) * std


def _fit(z: Array, y: Array, weight: Array, error: float, degree: int, curvature: float) -> tuple[Array, Array] | None:
    """Place and height of the maximum of R, whose R^{5/2} = y is a polynomial of z, and their variances.

    The place is as uncertain as the slope over the ``curvature`` that the collapse time tells: one that was fitted to
    few readings is small by chance, or large.
    """
    X = np.vander(z, degree + 1)
    covariance = np.linalg.pinv((weight[:, None] * X).T @ (weight[:, None] * X))
    poly = np.poly1d(covariance @ X.T @ (weight**2 * y))
    turning = [float(at.real) for at in poly.deriv().roots if abs(at.imag) < 1e-9 and poly.deriv(2)(at.real) < 0]
    if not turning:
        return None
    at = min(turning, key=abs)
    if abs(at) > 1.5 or not poly(at) > 0:
        return None
    powers = np.arange(degree, -1, -1)
    of_time = powers * at ** np.maximum(powers - 1.0, 0.0) / curvature
    of_height = 0.4 * poly(at) ** -0.6 * at**powers
    variance = error**2 * np.array([s @ covariance @ s for s in (of_time, of_height)])
    return np.array([at, poly(at) ** 0.4]), variance
