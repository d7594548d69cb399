"""What a radius history shows by itself: maximum, collapse, start, noise, radius at rest.

The collapse beside Rayleigh's: :mod:`en4dvar_bubble.collapse`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from en4dvar.inputs.window import minima
from en4dvar.state import Array
from en4dvar_bubble.collapse import Lobe, lobe

Start = Literal["acoustic", "laser"]
NEAR_TOP = 0.7  # of R_max: the part of the history that the noise is estimated from
LASER_BEGINS = 0.8  # of R_max: a history that begins above is one of a released bubble
COLLAPSED = 0.2  # of R_max: from here on the wall of an acoustic bubble is too fast for the model
SETTLED = 0.15  # std of ln R in the last quarter of a history that has come to rest
ACOUSTIC_BEGINS = 0.1  # of R_max: one that begins below has grown from a nucleus


@dataclass(frozen=True)
class Look:
    """What one history shows; SI.

    ``noise`` is the std of the scatter about a smooth curve near the maximum, NaN with too few samples there.
    ``rebound`` is the second maximum over the first, NaN where none is seen; ``rest`` the median of the last quarter
    of a history that rebounds and comes to rest, NaN else. ``step`` is the median time between samples; ``descent``
    the last instant of the first descent, NaN where the history ends with it. ``n_minima`` follow the maximum with a
    ``prominence`` relative to the range. ``reason`` says in words why ``start`` is
    proposed, ``clear`` whether the data leave no doubt.
    """

    n: int
    times: tuple[float, float]
    lobe: Lobe
    step: float
    noise: float
    rebound: float
    rest: float
    n_minima: int
    prominence: float
    descent: float
    start: Start
    reason: str
    clear: bool


def look(times: Array, radius: Array, start: Start | None = None) -> Look:
    """Look at a history ``times`` (K,) s, increasing, ``radius`` (K,) m; ``start`` where the user says it.

    Raises
    ------
    DataError: no maximum with a descent after it.
    """
    top = int(np.argmax(radius))
    found = lobe(times, radius)
    scatter = noise(times, radius)
    prominence, after = _minima(radius[top:], scatter)
    rebound = second_maximum(radius)
    first = float(radius[0] / radius[top])
    tail = radius[-max(3, len(radius) // 4) :]
    settled = np.isfinite(rebound) and np.all(tail > 0) and float(np.std(np.log(tail))) < SETTLED
    rest = float(np.median(tail)) if settled else float("nan")
    chosen, reason, clear = _start(first, np.isfinite(rebound))
    if start is not None and start != chosen:
        chosen, reason, clear = start, "as you say", True
    return Look(
        n=len(times),
        times=(float(times[0]), float(times[-1])),
        lobe=found,
        step=float(np.median(np.diff(times))),
        noise=scatter,
        rebound=rebound,
        rest=rest,
        n_minima=after,
        prominence=prominence,
        descent=_end_of_descent(times, radius),
        start=chosen,
        reason=reason,
        clear=clear,
    )


def _minima(radius: Array, scatter: float) -> tuple[float, int]:
    """How prominent minima have to be for two of them to be seen, well above the scatter; and how many there are."""
    spread = float(np.ptp(radius))
    for prominence in (0.1, 0.05, 0.03):
        found = len(minima(radius, prominence))
        if found >= 2 and (prominence == 0.1 or prominence * spread > 4 * scatter):
            return prominence, found
    return 0.1, len(minima(radius))


def _end_of_descent(times: Array, radius: Array) -> float:
    """The last sample before the radius falls below 20 % of its maximum; NaN where none is below."""
    top = int(np.argmax(radius))
    below = np.flatnonzero(radius[top:] < COLLAPSED * radius[top])
    return float(times[top + below[0] - 1]) if len(below) else float("nan")


def second_maximum(radius: Array) -> float:
    """The largest radius between the first two collapses over the maximum; NaN where there is no rebound."""
    top = int(np.argmax(radius))
    found = minima(radius[top:]) + top
    if not len(found):
        return float("nan")
    last = int(found[1]) if len(found) > 1 else len(radius) - 1
    between = radius[int(found[0]) : last + 1]
    peak = int(np.argmax(between))
    return float(between[peak] / radius[top]) if 0 < peak < len(between) - 1 else float("nan")


def noise(times: Array, radius: Array) -> float:
    """Std of the residuals about a polynomial through the samples around the maximum (above 70 % of it).

    Degree four, with fewer than nine samples two; divided by the degrees of freedom left. NaN with fewer than two.
    """
    top = first = last = int(np.argmax(radius))
    while first > 0 and radius[first - 1] > NEAR_TOP * radius[top]:
        first -= 1
    while last + 1 < len(radius) and radius[last + 1] > NEAR_TOP * radius[top]:
        last += 1
    t, r = times[first : last + 1], radius[first : last + 1]
    degree = 4 if len(t) >= 9 else 2
    left = len(t) - degree - 1
    if left < 2:
        return float("nan")
    z = (t - times[top]) / np.abs(t - times[top]).max()
    residual = r - np.polyval(np.polyfit(z, r, degree), z)
    return float(np.sqrt(np.sum(residual**2) / left))


def _start(first: float, rebounds: bool) -> tuple[Start, str, bool]:
    """The start that the data suggest, from the first radius over the maximum."""
    begins = f"the history begins at {100 * first:.0f} % of R_max"
    if first >= LASER_BEGINS:
        return "laser", begins, True
    if first < ACOUSTIC_BEGINS:
        return "acoustic", f"{begins}: it grows from small", True
    if rebounds:
        return "laser", f"{begins}, but goes on through a rebound, as gas made by a laser does", False
    return "acoustic", f"{begins}, grows and ends with the first collapse", False


def typical(values: Sequence[float]) -> float:
    """Median of the finite values; NaN where there is none."""
    finite = [v for v in values if np.isfinite(v)]
    return float(np.median(finite)) if finite else float("nan")
