"""What a radius history shows by itself: maximum, collapse, start, noise, radius at rest.

The collapse beside Rayleigh's: :mod:`en4dvar_bubble.collapse`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from en4dvar.inputs.implausible import scatter_of
from en4dvar.inputs.window import minima
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar_bubble.collapse import Lobe, lobe
from en4dvar_bubble.starter.top import Top, top

Start = Literal["acoustic", "laser"]
T = TypeVar("T")
LASER_BEGINS = 0.8  # of R_max: a history that begins above is one of a released bubble
COLLAPSED = 0.2  # of R_max: from here on the wall of an acoustic bubble is too fast for the model
SETTLED = 0.15  # std of ln R in the last quarter of a history that has come to rest
UNKNOWN = 0.01  # of R_max: errors where the scatter cannot be told
DRIFTS = 0.15  # of ln R from one quarter of a history to the next
GAS = 0.6  # of R_max: a bubble at rest is smaller
ACOUSTIC_BEGINS = 0.1  # of R_max: one that begins below has grown from a nucleus
EMERGES = 0.5  # of R_max: a nucleus that grows is seen before it is as large
SEVERAL = 4  # readings before a bubble, or at least of one
CREEPS = 1.5  # collapse times after the maximum: a history that goes on for longer without a rebound is damped


@dataclass(frozen=True)
class Look:
    """What one history shows; SI.

    ``noise`` is the std of the readings' scatter (:mod:`en4dvar.inputs.implausible`), NaN with too few of them;
    ``top`` is where and how high the maximum was.
    ``rebound`` is the second maximum over the first, NaN where none is seen; ``rest`` the median of the last quarter
    of a history that rebounds and comes to rest, NaN else; ``drift`` says in words what it does instead of resting, "".
    ``begin`` is the first instant, ``step`` the median time between samples; ``descent`` the last instant of the first
    descent, NaN where the history ends with it. ``n_minima`` follow the maximum with a ``prominence`` relative to the
    range. ``reason`` says in words why ``start`` is proposed, ``clear`` whether the data leave no doubt.
    """

    begin: float
    lobe: Lobe
    top: Top
    step: float
    noise: float
    rebound: float
    rest: float
    drift: str
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
    _require_collapse(radius, start)
    scatter = scatter_of(times, radius)
    peak = lobe(times, radius)
    highest = top(times, radius, scatter if np.isfinite(scatter) else UNKNOWN * float(radius.max()))
    largest = highest.reading
    prominence, after = _minima(radius[largest:], scatter)
    rebound = second_maximum(radius)
    begins = _begins(radius, largest)
    first = float(radius[begins] / radius[largest])
    rest, drift = _rest(times, radius, peak) if np.isfinite(rebound) else (float("nan"), "")
    chosen, reason, clear = _start(first, np.isfinite(rebound), times[-1] > peak.t_max + CREEPS * peak.t_c, begins)
    if start is not None:
        chosen, reason, clear = start, reason if start == chosen else "as you say", True
    if chosen == "acoustic" and begins:
        when = f"{1e6 * times[begins]:g} us"
        raise DataError(
            f"the first {begins} readings are small beside the bubble, which appears at {when}: ultrasound makes it "
            f"grow from there; leave out what is before (data.since: '{when}')"
        )
    return Look(
        begin=float(times[0]),
        lobe=peak,
        top=highest,
        step=float(np.median(np.diff(times))),
        noise=scatter,
        rebound=rebound,
        rest=rest,
        drift=drift,
        n_minima=after,
        prominence=prominence,
        descent=_end_of_descent(times, radius),
        start=chosen,
        reason=reason,
        clear=clear,
    )


def _begins(radius: Array, largest: int) -> int:
    """The reading in which a bubble appears large at once, behind several that show next to nothing; else the first."""
    after = int(np.flatnonzero(np.append(0.0, radius[:largest]) < ACOUSTIC_BEGINS * radius[largest])[-1])
    return after if after >= SEVERAL and radius[after] > EMERGES * radius[largest] else 0


def _require_collapse(radius: Array, start: Start | None) -> None:
    """Raise :class:`DataError` where a bubble that a laser may have made is not recorded behind its maximum."""
    largest, count = int(np.argmax(radius)), len(radius)
    if largest > count - 3 and (start == "laser" or (start is None and radius[0] > ACOUSTIC_BEGINS * radius[largest])):
        raise DataError(
            f"the recording ends {'with' if largest == count - 1 else 'next to'} the maximum, reading {largest + 1} of "
            f"{count}: it shows growth alone, and a bubble that a laser makes is estimated from its maximum on; "
            "record the collapse, or if ultrasound made it grow, say --start acoustic"
        )


def _minima(radius: Array, scatter: float) -> tuple[float, int]:
    """How prominent minima have to be for two of them to be seen, well above the scatter; and how many there are."""
    spread = float(np.ptp(radius))
    for prominence in (0.1, 0.05, 0.03):
        count = len(minima(radius, prominence))
        if count >= 2 and (prominence == 0.1 or prominence * spread > 4 * scatter):
            return prominence, count
    return 0.1, len(minima(radius))


def _rest(times: Array, radius: Array, peak: Lobe) -> tuple[float, str]:
    """The radius at rest, NaN where there is none; and what a history that seemed to rest does instead, in words.

    A radius that goes on growing after the oscillations is that of fragments, of gas that diffuses in, or of an edge
    that blurs: it is no bubble of a constant amount of gas.
    """
    quarter = max(3, len(radius) // 4)
    tail = radius[-quarter:]
    if not np.all(tail > 0) or float(np.std(np.log(tail))) > SETTLED or times[-quarter] < peak.t_max + 2 * peak.t_c:
        return float("nan"), ""
    rest, begun = float(np.median(tail)), int(np.searchsorted(times, peak.t_max + 2 * peak.t_c))
    before = radius[max(begun, len(radius) - 2 * quarter) : -quarter]
    earlier = float(np.median(before)) if len(before) >= 3 else rest
    if rest > GAS * peak.R_max or not abs(np.log(rest / max(earlier, 1e-3 * rest))) < DRIFTS:
        return float("nan"), f"R goes from {1e6 * earlier:.3g} to {1e6 * rest:.3g} um where it should rest"
    return rest, ""


def _end_of_descent(times: Array, radius: Array) -> float:
    """The last sample before the radius falls below 20 % of its maximum; NaN where none is below."""
    top = int(np.argmax(radius))
    below = np.flatnonzero(radius[top:] < COLLAPSED * radius[top])
    return float(times[top + below[0] - 1]) if len(below) else float("nan")


def second_maximum(radius: Array) -> float:
    """The largest radius between the first two collapses over the maximum; NaN where there is no rebound."""
    top = int(np.argmax(radius))
    indices = minima(radius[top:]) + top
    if not len(indices):
        return float("nan")
    last = int(indices[1]) if len(indices) > 1 else len(radius) - 1
    between = radius[int(indices[0]) : last + 1]
    peak = int(np.argmax(between))
    return float(between[peak] / radius[top]) if 0 < peak < len(between) - 1 else float("nan")


def _start(first: float, rebounds: bool, creeps: bool, before: int) -> tuple[Start, str, bool]:
    """The start that the data suggest; ``before``: as many readings show no bubble yet."""
    begins = f"{f'after {before} small readings ' if before else ''}the history begins at {100 * first:.0f} % of R_max"
    if first >= LASER_BEGINS:
        return "laser", begins, True
    if first < ACOUSTIC_BEGINS:
        return "acoustic", f"{begins}: it grows from small", True
    if rebounds:
        return "laser", f"{begins}, but goes on through a rebound, as gas made by a laser does", False
    if first >= EMERGES:
        return "laser", f"{begins}: one that grows from a nucleus is seen before", False
    if creeps:
        return "laser", f"{begins}, but goes on after the collapse, which a thick gel damps", False
    return "acoustic", f"{begins}, grows and ends with the first collapse", False


def usable(
    names: Iterable[str], result_of: Callable[[str], T], words: str = "{name}: {error}"
) -> tuple[dict[str, T], list[str]]:
    """Results by name, and in ``words`` why there is none of others. Raises :class:`DataError` where there is none."""
    results, faults = dict[str, T](), list[str]()
    for name in names:
        try:
            results[name] = result_of(name)
        except DataError as error:
            faults.append(words.format(name=name, error=error))
    if not results:
        raise DataError("\n".join(faults))
    return results, faults


def typical(values: Sequence[float]) -> float:
    """Median of the finite values; NaN where there is none."""
    finite = [v for v in values if np.isfinite(v)]
    return float(np.median(finite)) if finite else float("nan")
