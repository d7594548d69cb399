r"""What a radius history shows by itself: maximum, collapse, start, noise, radius at rest; when it was largest and how
large. The collapse beside Rayleigh's: :mod:`en4dvar_bubble.collapse`.

About the top R^{5/2} is a parabola in t (Rayleigh's collapse), up to what growth and collapse differ by, a term t³.
With n readings of relative error ε within ± T of it the parabola's top is known to

    σ_t = ε t_c² √(3/n) / (0.84 T),

so that a wide window is the better one as long as it is not biased; beside readings that are exact, its bias is its
error. A cubic takes away what that term does, and has 2.5 times the error. The width is chosen by intersecting
confidence intervals (Goldenshluger & Nemirovski 1997, Math. Methods Statist. 6, 135): from narrow to wide, until one
of the estimates contradicts those before it. The largest reading itself, which is no estimate, lies up to √(ε/0.42) t_c
off and is too high by about ε √(2 ln n).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np

from en4dvar.data.extrema import minima, with_unseen
from en4dvar.inputs.implausible import scatter_of
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.hints import listed
from en4dvar_bubble.collapse import REBOUND, TOLD, Lobe, lobe, single

WINDOWS = (0.15, 0.2, 0.27, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85)  # half widths in collapse times
LOWEST = 0.45  # of R_max: what lies lower belongs to the end of the collapse, or to the beginning of the growth
FEWEST, CUBIC = 5, 8  # readings through which a parabola and a cubic are laid
AGREE = 2.0  # standard deviations
FORM = 0.002  # of the height: what R^{5/2} is not a polynomial by
LATE = 0.12  # collapse times: the std of a top of which nothing else is known; at three of them R has fallen by 6 %
CHOSEN, ONE_SIDED = 1.3, 2.5  # errors of a window that the readings chose themselves are larger by these factors


@dataclass(frozen=True)
class Top:
    """``time`` (s) and ``height`` (m) of the maximum, and their standard errors."""

    time: float
    height: float
    time_std: float
    height_std: float


def top(times: Array, radius: Array, scatter: float) -> Top:
    """Of a history ``times`` (K,) s, ``radius`` (K,) m without bad readings, whose errors have the std ``scatter``."""
    late, estimates = math.nan, list[tuple[Array, Array]]()
    with suppress(DataError):
        excursion = lobe(times, radius)
        late, estimates = LATE * excursion.t_c, list(_estimates(times, radius, scatter, excursion))
    if not estimates:  # a few readings between which anything may lie, or a history that begins behind the top
        height, time_std = float(radius.max()), float(np.fmax(np.median(np.diff(times)), late))
        return Top(float(times[np.argmax(radius)]), height, time_std, 0.03 * height)
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
    time_std, height_std = wider * std
    return Top(float(value[0]), float(value[1]), float(np.fmin(time_std, late)), float(height_std))


def _estimates(times: Array, radius: Array, scatter: float, excursion: Lobe) -> Iterator[tuple[Array, Array]]:
    """Time and height, and their std, by windows from narrow to wide."""
    before = 0
    for share in WINDOWS:
        near = (np.abs(times - excursion.t_max) <= share * excursion.t_c) & (radius > LOWEST * excursion.R_max)
        count = int(near.sum())
        if count < FEWEST or count == before:
            continue
        before = count
        if (estimate := _vertex(times[near], radius[near], scatter, excursion.t_c)) is not None:
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
    coefficients, covariance = np.polyfit(z, y, degree, w=weight, cov="unscaled")
    poly = np.poly1d(coefficients)
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


Start = Literal["acoustic", "laser"]
T = TypeVar("T")
LASER_BEGINS = 0.8  # of R_max: a history that begins above is one of a released bubble
COLLAPSED = 0.2  # of R_max: from here on the wall of an acoustic bubble is too fast for the model
SETTLED = 0.15  # std of ln R in the last quarter of a history that has come to rest
UNKNOWN = 0.01  # of R_max: errors where the scatter cannot be told
DRIFTS = 0.15  # of ln R from one quarter of a history to the next
STEADY = 0.6  # correlation of ln R with time in the last quarter of a history that falls to the end, also with ripples
GAS = 0.6  # of R_max: a bubble at rest is smaller
QUIET, SETTLES = 0.45, (3.0, 0.5)  # of R_max: below it lie the readings 3 to 0.5 collapse times before another bubble
ACOUSTIC_BEGINS = 0.1  # of R_max: one that begins below has grown from a nucleus
EMERGES = 0.5  # of R_max: a nucleus that grows is seen before it is as large
SEVERAL = 4  # readings before a bubble, or at least of one
AWAY = 3.0  # standard deviations: farther from the first readings a bubble has left its rest
TOP_WIDTH = 3.0  # standard errors of a top or rest that its prior takes: it is not to count the readings there twice
SWINGS = 0.5  # of R_max: a bubble that rests above and then grows is driven; a laser leaves far more than it found
EQUAL = 1e-6  # of a level: what rounded readings that are equal differ by
RESOLVED = 5.0  # standard deviations: of a level that is read, and is not what a camera shows of next to nothing
FALLS = 0.9  # of R_max: readings that end above do not tell when it collapses
COUNTED = (
    "a window counts that collapse ('trough 1' lies in the hole), but its readings would tell more: recover "
    "them if you can"
)
UNCOUNTED = (
    "the minima behind are later ones ('trough 1' is not the first), and what a run makes of them may be wrong by a "
    "factor of 2: leave the file out, or recover those readings"
)
GAS_FRACTION = 0.12  # R_eq/R_max of laser-induced bubbles, where no radius at rest is seen
BETWEEN = 1.645  # standard deviations from the median to 5 and 95 %
SHALLOW = 1.3  # of a minimum: readings beside it that are lower resolve it
TALL = 0.5  # of R_max: a lower rebound is that of a collapse that may be steeper than it seems
CREEPS = 1.5  # collapse times after the maximum: a history that goes on for longer without a rebound is damped


@dataclass(frozen=True)
class Look:
    """What one history shows; SI.

    ``noise`` is the std of the readings' scatter (:mod:`en4dvar.inputs.implausible`), NaN with too few of them;
    ``top`` is where and how high the maximum was.
    ``rebound`` is the second maximum over the first, NaN where none is seen; ``rest`` the median of the last quarter
    of a history that rebounds and comes to rest, NaN else; ``drift`` says in words what it does instead of resting, "".
    ``trough`` is the minimum before the rebound where the readings resolve it, NaN else.
    ``before`` is the radius at rest before an acoustic bubble grows, and the std of a reading of it, NaN without one.
    ``begin`` is the first instant, ``step`` the median time between samples; ``falls`` tells whether the radius falls
    below :data:`COLLAPSED` of its maximum. ``n_minima`` follow the maximum with a ``prominence`` relative to the
    range; a ``short`` laser bubble ends before the first rebound has a top, an ``early`` one before it has collapsed,
    or has a ``hole`` there, told in words, so that the time of the collapse is where a fit goes on to. ``reason`` says
    in words why ``start`` is proposed, ``clear`` whether the data leave no doubt. ``another`` is the instant of the
    last reading before another bubble, NaN where none follows; what is behind it does not count. ``earlier`` is that
    before this bubble where it follows another one, NaN where it does not.
    """

    begin: float
    lobe: Lobe
    top: Top
    step: float
    noise: float
    rebound: float
    rest: float
    drift: str
    trough: float
    before: tuple[float, float]
    n_minima: int
    prominence: float
    falls: bool
    short: bool
    early: bool
    hole: str
    start: Start
    reason: str
    clear: bool
    another: float = float("nan")
    earlier: float = float("nan")

    @property
    def resting(self) -> tuple[float, float, str]:
        """R_eq: a median (m), the std of its logarithm, and where it is from. A bubble swings about it, so that it lies
        above every minimum; where that is beyond what is usual, about their geometric mean with the maximum.
        """
        if np.isfinite(self.rest):
            words = (
                "the radius at rest; wide, because a real bubble loses gas to the gel and the model's bubble keeps it"
            )
            return self.rest, 0.3, words
        if self.trough > GAS_FRACTION * math.exp(BETWEEN * 0.4) * self.lobe.R_max:
            words = "between the first minimum, which the readings resolve, and R_max, since no radius at rest is seen"
            return math.sqrt(self.trough * self.lobe.R_max), 0.4, words
        return GAS_FRACTION * self.lobe.R_max, 0.4, f"{GAS_FRACTION:g} R_max, since no radius at rest is seen"


def look(times: Array, radius: Array, start: Start | None = None) -> Look:
    """Look at a history ``times`` (K,) s, increasing, ``radius`` (K,) m; ``start`` where the user says it. Raises
    :class:`DataError`: no maximum with a descent after it.
    """
    _require_collapse(radius, start)
    scatter = scatter_of(times, radius)
    rests = before(times, radius, scatter)
    seen, lost = _before_a_hole(times, radius)
    peak = _lobe(times[:seen], radius[:seen], start != "laser" and np.isfinite(rests[0]))
    highest = top(times[:seen], radius[:seen], scatter if np.isfinite(scatter) else UNKNOWN * float(radius.max()))
    largest = int(np.argmax(radius[:seen]))
    prominence, n_minima = _minima(with_unseen(times[largest:], radius[largest:])[1], scatter)
    rebound = second_maximum(radius)
    begins = _begins(radius, largest)
    first = float(radius[begins] / radius[largest])
    rest, drift = _rest(times, radius, peak) if np.isfinite(rebound) else (float("nan"), "")
    chosen, reason, clear = _start(first, np.isfinite(rebound), times[-1] > peak.t_max + CREEPS * peak.t_c, begins)
    if rests[0] > SWINGS * radius[largest] and chosen == "laser":
        chosen, reason, clear = "acoustic", f"it rests at {1e6 * rests[0]:.3g} um before it grows", False
    if start is not None:
        chosen, reason, clear = start, reason if start == chosen else "as you say", True
    if chosen == "acoustic" and begins:
        when = f"{1e6 * times[begins]:g} us"
        raise DataError(
            f"the first {begins} readings are small beside the bubble, which appears at {when}: ultrasound makes it "
            f"grow from there; leave out what is before (data.since: '{when}')"
        )
    shots = [*_shots(times, radius, peak)] if chosen == "laser" else []
    for count in [count for count in shots if count > largest][:1]:
        return replace(look(times[:count], radius[:count], start), another=float(times[count - 1]))
    step, falls = float(np.median(np.diff(times))), bool(radius[largest:].min() < COLLAPSED * radius[largest])
    noise = min(scatter, rests[1]) if chosen == "acoustic" else scatter  # NaN is not smaller
    early, hole = bool(radius[largest:].min() > TOLD * radius[largest] and times[-1] < peak.t_max + peak.t_c), ""
    if seen < len(times) and chosen == "laser":
        early, rebound = True, float("nan")
        hole = f"no readings from {1e6 * times[seen - 1]:.4g} to {1e6 * times[seen]:.4g} us, where it collapses; {lost}"
    return Look(
        float(times[0]), peak, highest, step, noise, rebound, rest, drift, _trough(radius[largest:], rebound), rests,
        n_minima, prominence, falls, chosen == "laser" and not hole and (early or single(times, radius)), early,
        hole, chosen, reason, clear, earlier=float(times[shots[-1] - 1]) if shots else math.nan,
    )  # fmt: skip


def without_rebound(looks: Mapping[str, Look]) -> list[str]:
    """Which recordings end before the first rebound has a top, or have a hole there, and what to do."""
    short = [name for name, view in looks.items() if view.short]
    holes = [f"{name}: {view.hole}" for name, view in looks.items() if view.hole]
    if not short:
        return holes
    who = f"{listed(short, 5)}: " * (len(looks) > 1)
    away = "; move those files away, or accept that they count beside the others" * (len(short) < len(looks))
    return [
        *holes,
        f"{who}the readings end before the top of the first rebound, so a run takes stiffness and viscosity from the "
        f"collapse alone, often several times too large; record longer, until that top is past{away}",
    ]


def before(times: Array, radius: Array, scatter: float) -> tuple[float, float]:
    """The level (m) of several readings before the bubble grows, and their std; NaN where there is no such plateau.

    It is resolved, and rises less than half as fast as the bubble does from there to its maximum: a history that
    begins in the midst of growth rises fastest at first. The std is ``scatter``, or that of the level where it is far
    smaller: few readings a cycle are not smooth between each other.
    """
    largest = int(np.argmax(radius))
    std = scatter if np.isfinite(scatter) else UNKNOWN * float(radius[largest])
    unsure = math.sqrt(1 + 0.5 * math.pi / SEVERAL)  # the median of few errs, too
    away = np.abs(radius[:largest] - np.median(radius[:SEVERAL])) > AWAY * std * unsure
    left = np.flatnonzero(away[1:] & away[:-1])  # one reading alone may be odd
    count = int(left[0]) if len(left) else 0
    if count >= SEVERAL:
        t, resting = times[:count], radius[: max(SEVERAL, count // 2)]  # before growth begins
        level, own = float(np.median(resting)), float(np.std(resting, ddof=1))
        slope = np.polyfit(t, radius[:count], 1)[0] + AGREE * std / (np.std(t) * np.sqrt(count))
        slow = slope < 0.5 * (radius[largest] - level) / (times[largest] - t[-1])
        if slow and level > max(RESOLVED * std, ACOUSTIC_BEGINS * radius[largest]):
            return level, own if EQUAL * level < AWAY * own < std else std
    return float("nan"), float("nan")


def at_rest(
    looks: Mapping[str, Look], histories: Mapping[str, tuple[Array, Array]], edge: float, scale: float
) -> tuple[str, float] | None:
    """Median, as text, and log_std of a prior of R0 from readings before the bubbles grow; None where none shows any.

    The errors of these readings, of the ``edge`` (m) and of the ``scale`` (relative) of all count :data:`TOP_WIDTH`
    times. Of several bubbles that all rest it is the first reading of each, off by what it is; else one for all, off by
    as much as they differ.
    """
    seen = {name: view.before for name, view in looks.items() if np.isfinite(view.before[0])}
    if not seen:
        return None
    levels, stds = np.array([*seen.values()]).T
    text, off = "first", levels - [histories[name][1][0] for name in seen]
    if not 1 < len(seen) == len(looks):
        levels, stds, off = np.median(levels), np.median(stds), np.std(levels)
        text = f"{1e6 * levels:.4g} um"
    relative = np.max(np.hypot(TOP_WIDTH * np.hypot(stds, edge), off) / levels)
    return text, math.hypot(relative, TOP_WIDTH * scale)


def _begins(radius: Array, largest: int) -> int:
    """The reading in which a bubble appears large at once, behind several that show next to nothing; else the first."""
    after = int(np.flatnonzero(np.append(0.0, radius[:largest]) < ACOUSTIC_BEGINS * radius[largest])[-1])
    return after if after >= SEVERAL and radius[after] > EMERGES * radius[largest] else 0


def _lobe(times: Array, radius: Array, rests: bool) -> Lobe:
    """That of :func:`~en4dvar_bubble.collapse.lobe`; of a bubble that rests and then swings, with too few readings for
    it, from the largest reading to the lowest one behind it. Raises :class:`DataError`."""
    try:
        return lobe(times, radius)
    except DataError:
        top = int(np.argmax(radius))
        lowest = minima(radius[top:])[:1] + top
        if not rests or not len(lowest):
            raise
        return Lobe(float(radius[top]), float(times[top]), float(times[lowest[0]] - times[top]))


def _before_a_hole(times: Array, radius: Array) -> tuple[int, str]:
    """How many readings precede a hole of several steps in which a bubble collapses and its rebound has a top, and what
    that does to a window, in words; else all, and "".
    """
    largest, steps = int(np.argmax(radius)), np.diff(times)
    t, r = with_unseen(times[largest:], radius[largest:])
    first = t[minima(r)[:1]]
    if len(first) and first[0] not in times:
        return int(np.searchsorted(times, first[0])), COUNTED
    for last in largest + np.flatnonzero(steps[largest:] > SEVERAL * np.median(steps))[:1]:
        with suppress(DataError):  # too few to tell
            peak = lobe(times[: last + 1], radius[: last + 1])
            hidden = times[last] < peak.t_max + peak.t_c < times[last + 1] - REBOUND * peak.t_c
            if hidden and radius[last] < FALLS * radius[largest]:
                return int(last) + 1, UNCOUNTED
    return len(times), ""


def _shots(times: Array, radius: Array, peak: Lobe) -> Iterator[int]:
    """How many readings precede each bubble that follows another one, as of the next shot of a laser. What oscillates
    by itself does not grow again when it was small for longer than a period."""
    largest, (begun, ended) = float(radius.max()), SETTLES
    tall = radius > GAS * largest
    shown = np.union1d(np.flatnonzero(tall[:-2] & tall[1:-1] & tall[2:]), np.argmax(radius))  # two may be wild
    for first in shown[np.diff(times[shown], prepend=times[shown[:1]]) > (1 + begun) * peak.t_c]:
        start, stop = np.searchsorted(times, times[first] - np.array([begun, ended]) * peak.t_c)
        if (quiet := radius[min(start, stop - 1) : stop].max()) < QUIET * largest:
            yield int(np.flatnonzero(radius[:first] <= quiet)[-1]) + 1


def _require_collapse(radius: Array, start: Start | None) -> None:
    """Raise :class:`DataError` where a bubble that a laser may have made is not recorded behind its maximum."""
    largest, count = int(np.argmax(radius)), len(radius)
    if largest > count - 3 and (start == "laser" or (start is None and radius[0] > ACOUSTIC_BEGINS * radius[largest])):
        raise DataError(
            f"the recording ends {'with' if largest == count - 1 else 'next to'} the maximum, reading {largest + 1} of "
            f"{count}: it shows only growth, and a bubble made by a laser is estimated from its maximum on; "
            "record the collapse, or if ultrasound made it grow, give --start acoustic"
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
    that blurs: it is no bubble of a constant amount of gas. One that falls may be that of rebounds which die away: it
    drifts where it had settled before, or where it falls steadily to the end.
    """
    quarter = max(3, len(radius) // 4)
    tail = radius[-quarter:]
    if not np.all(tail > 0) or float(np.std(np.log(tail))) > SETTLED or times[-quarter] < peak.t_max + 2 * peak.t_c:
        return float("nan"), ""
    rest, begun = float(np.median(tail)), int(np.searchsorted(times, peak.t_max + 2 * peak.t_c))
    before = np.maximum(radius[max(begun, len(radius) - 2 * quarter) : -quarter], 1e-3 * rest)
    earlier = float(np.median(before)) if len(before) >= 3 else rest
    change, moments = math.log(rest / earlier), np.cov(times[-quarter:], np.log(tail))
    steadily = moments[0, 1] < -STEADY * math.sqrt(moments[0, 0] * moments[1, 1])
    falls = change <= -DRIFTS and (steadily or np.std(np.log(before)) <= SETTLED)
    if rest > GAS * peak.R_max:
        told = f"R rests at {1e6 * rest:.3g} um, above {GAS:g} of its maximum, {1e6 * peak.R_max:.3g} um"
        return float("nan"), f"{told} (do the readings begin behind a larger one, or behind the collapse?)"
    if change >= DRIFTS or falls:
        return float("nan"), f"R goes from {1e6 * earlier:.3g} to {1e6 * rest:.3g} um where it should rest"
    return rest, ""


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


def _trough(falling: Array, rebound: float) -> float:
    """The least radius after the top, where a tall ``rebound`` is seen and the readings beside it are nearly as low.
    About a collapse between two frames R ~ |t|^{2/5}, of the rebound times its height to the power 3/5, so that one of
    them is at least 1.4 times as large.
    """
    least = int(np.argmin(falling))
    resolved = rebound > TALL and 0 < least < len(falling) - 1
    resolved = resolved and falling[least - 1 : least + 2].max() < SHALLOW * falling[least]
    return float(falling[least]) if resolved else float("nan")


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
    return "acoustic", f"{begins}, grows and shows no rebound", False


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


def typical_look(views: Sequence[Look]) -> Look:
    """One look at several data sets: medians of the numbers, words of the first that is not clear. Bubbles of one gel
    differ in size more than in their radius at rest over the maximum, which not all of them show.
    """
    medians = {key: typical([getattr(v, key) for v in views]) for key in ("step", "noise", "rebound")}
    least: dict[str, Any] = {key: min(getattr(v, key) for v in views) for key in ("begin", "n_minima", "prominence")}
    R_max, t_max, t_c = (typical([getattr(v.lobe, k) for v in views]) for k in ("R_max", "t_max", "t_c"))
    return replace(
        next((v for v in views if not v.clear), views[0]),
        **medians | least,
        lobe=Lobe(R_max, t_max, t_c),
        rest=R_max * typical([v.rest / v.lobe.R_max for v in views]),
        drift=next((v.drift for v in views if v.drift), ""),
        before=(typical([v.before[0] for v in views]), typical([v.before[1] for v in views])),
        early=all(v.early for v in views),
    )
