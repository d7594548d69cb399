"""Readings and times that cannot be what a file says: far from their neighbours, no whole frames apart, out of order.

A window of seven neighbouring readings that is not steep is a polynomial of degree four and errors: the sum of squares
about it, two degrees of freedom, is χ²_2 times the variance of an error. The median over all windows tells that
variance whatever a few of them hold: a bad reading, a gap, a short rebound.

Readings of a film lie whole frames apart, also where some frames could not be read. A step that is none, among many
that are, is a time that was written wrongly. Steps of all kinds are those of another instrument, and nothing is said.

Rows of one series that are shuffled are sorted. Several series one after another are not: sorted they would be one that
nobody saw. Their times fall back with several increasing readings before and behind, or a column tells them apart.
"""

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from en4dvar.inputs.parts import Layout, cell, opened, table_of
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.units import convert, unit_after

WINDOW, DEGREE = 7, 4
STEEP = 0.5  # of the largest reading of a window: one that holds less, or crosses zero, falls too fast for a polynomial
MEDIAN_OF_CHI2 = 2 * math.log(2)  # of χ²_2
OUTLYING = 5.0  # standard deviations from what its neighbours say
ROUGH = 10.0  # standard deviations of these neighbours about a parabola, small since they were chosen to lie on one
NEAR, AGREEING = 8, 6  # neighbours, and how many of them speak
RARE = 0.2  # of all readings: a number that stands for none
IN_A_ROW = 3  # readings at least of a plateau
FALLS = 3.0  # standard deviations by which the nearest neighbours lie below the farthest at the bottom of a collapse
BESIDE = 4  # readings to either side of a plateau, or half as many as it has
CUT = 5.0  # standard deviations by which they lead higher: of 5500 tops that are rounded none comes above 3.5
LEVELS = np.linspace(0.99, 0.7, 15)  # of the largest reading: where the search for a level top begins
ROUNDS = 6  # of the search from there
POWER = 2.5  # of a radius, which is a parabola in time about its maximum


def scatter_of(times: Array, values: Array) -> float:
    """Standard deviation of the errors of readings ``values`` (K,) at ``times`` (K,); NaN without a window. It is not
    less than what the readings are rounded to.
    """
    if len(values) < WINDOW:
        return math.nan
    t, r = (sliding_window_view(it, WINDOW) for it in (times, values))
    steps = np.diff(t)
    smooth = (r.min(axis=1) > STEEP * r.max(axis=1)) & (steps.max(axis=1) < 2.5 * steps.min(axis=1))
    if not smooth.any():
        return math.nan
    t, r = t[smooth], r[smooth]
    with np.errstate(over="ignore"):  # of readings of 1e300, which are refused later
        squares = np.sum((r - _fitted(t, np.arange(WINDOW), DEGREE, r)[0]) ** 2, axis=1)
    return max(math.sqrt(float(np.median(squares)) / MEDIAN_OF_CHI2), _rounding(values))


def _rounding(values: Array) -> float:
    """Standard deviation of what readings lose by the smallest difference that there is between two of them."""
    steps = np.diff(np.unique(values))
    usual = steps[steps > 1e-9 * values.max()]
    return float(usual.min()) / math.sqrt(12) if len(usual) else 0.0


def outlying(times: Array, values: Array, scatter: float) -> npt.NDArray[np.bool_]:
    """Which readings (K,) are far from what their neighbours say, with ``scatter`` as errors have.

    Of the eight nearest those six speak that lie best on a parabola, for two of them may be wild as well (least trimmed
    squares: Rousseeuw 1984, J. Am. Stat. Assoc. 79, 871; all parabolas through three are tried). Below half of the
    largest reading, where a bubble collapses and rebounds, a reading has to be farther off than these six differ. One
    below neighbours that fall towards it from both sides is the bottom of a collapse; one that is higher than all of
    them, by a quarter, is no part of it, however steep it is. At the ends a reading is odd if it is above all of its
    neighbours: glare of a laser. Wild readings make the scatter seem larger than it is, so that without
    those that were found it is asked again.
    """
    odd, own = np.zeros(len(values), dtype=bool), np.arange(len(values))
    if len(values) <= NEAR:
        return odd
    near = np.clip(own - NEAR // 2, 0, len(values) - NEAR - 1)[:, None] + np.arange(NEAR)
    near += near >= own[:, None]
    t, r, least = times[near] - times[:, None], values[near], np.full(len(values), np.inf)
    valley = (near[:, 3] < own) & (own < near[:, 4]) & (r[:, 3] < r[:, 2]) & (r[:, 4] < r[:, 5])
    odd |= valley & (values - r.max(axis=1) > np.maximum(OUTLYING * scatter, 0.25 * r.max(axis=1)))
    best = np.tile(np.arange(AGREEING), (len(values), 1))
    for a, b, c in itertools.combinations(range(NEAR), 3):
        with np.errstate(all="ignore"):  # of bounds at one time
            slope, other = ((r[:, it] - r[:, a]) / (t[:, it] - t[:, a]) for it in (b, c))
            bend = (other - slope) / (t[:, c] - t[:, b])
            curve = slope[:, None] + bend[:, None] * (t - t[:, [b]])
            squares = (r - r[:, [a]] - (t - t[:, [a]]) * curve) ** 2
        closest = np.argsort(squares, axis=1)[:, :AGREEING]
        total = np.take_along_axis(squares, closest, axis=1).sum(axis=1)
        better = total < least
        least[better], best[better] = total[better], closest[better]
    best.sort(axis=1)
    t, r = (np.take_along_axis(it, best, axis=1) for it in (t, r))
    expected, spread = _fitted(np.column_stack([t, 0 * times]), np.arange(AGREEING), 2, r)
    rough = np.sqrt(np.sum((r - expected[:, :-1]) ** 2, axis=1) / (AGREEING - 3))
    off, low = values - expected[:, -1], np.maximum(values, expected[:, -1]) <= STEEP * values.max()
    far = np.abs(off) > spread[:, -1] * np.maximum(OUTLYING * scatter, np.where(low, 2, 1) * ROUGH * rough)
    steep = (r.min(axis=1) < STEEP * r.max(axis=1)) | (values < 0.2 * r.min(axis=1))
    before = np.sum(t < 0, axis=1)
    inner = np.clip(before, 1, AGREEING - 1)
    falls = r[:, [0, -1]].mean(axis=1) - 0.5 * (r[own, inner - 1] + r[own, inner]) > FALLS * scatter
    between = (np.minimum(before, AGREEING - before) > 0) & ~(falls & (off < 0))
    fits = np.where(low, between & (np.abs(off) > np.ptp(r, axis=1)), between | (values > r.max(axis=1)))
    odd[far & ~steep & fits] = True
    if odd.any():
        odd[~odd] = outlying(times[~odd], values[~odd], scatter_of(times[~odd], values[~odd]))
    return odd


def placeholders(values: Array) -> npt.NDArray[np.bool_]:
    """Which readings (K,) are one number, met more than once, more than twice as large as every other, and rare."""
    same = values == values.max(initial=-math.inf)
    others = values[~same].max(initial=0.0)
    is_one = bool(1 < same.sum() <= RARE * len(values) and values.max() > 2 * others > 0)
    return same if is_one else np.zeros_like(same)


def cut_off(times: Array, values: Array, scatter: float) -> npt.NDArray[np.bool_]:
    """Which readings (K,) are a plateau at the largest number above which nothing could be read, as of a bubble that
    leaves the picture: the parabola through those beside it lies higher than ``scatter``, and rounding in it, explain.
    """
    same, odd = values == values.max(), np.zeros(len(values), dtype=bool)
    first, last = np.flatnonzero(same)[[0, -1]]
    count = last + 1 - first
    beside = max(BESIDE, count // 2)
    near = np.r_[max(first - beside, 0) : first, last + 1 : min(last + 1 + beside, len(values))]
    near = near[values[near] > STEEP * values[first]]
    before = int(np.sum(near < first))
    if same.sum() < max(IN_A_ROW, 0.75 * count) or min(before, len(near) - before) < 2 or len(near) <= BESIDE:
        return odd
    powers = ((times - times[first]) / (times[last] - times[first]))[:, None] ** np.arange(3)
    inverse = np.linalg.pinv(powers[near])
    weights = powers[first : last + 1].mean(axis=0) @ inverse
    share = values[near] / values[first]
    rough = math.sqrt(np.sum((share - powers[near] @ inverse @ share) ** 2) / (len(near) - 3))
    odd[first : last + 1] = weights @ share - 1 > CUT * np.linalg.norm(weights) * max(scatter / values[first], rough)
    return odd


def level_top(times: Array, radius: Array, scatter: float) -> npt.NDArray[np.bool_]:
    """Which readings (K,) of a radius are a plateau at a level about which they scatter, as where a bubble leaves the
    picture and a tracker reads what is left of it.

    About a maximum R^{5/2} is nearly a parabola. Its cubic through the readings beside a plateau, cut off at a level,
    has as many numbers as a polynomial of degree four through all of them, which any rounded top follows better. It is
    cut off where the sum of squares about the latter is larger by CUT² variances, the cubic leads higher than one
    reading scatters, and readings rise to a level of their own scatter and fall from it: a bubble that oscillates does
    not. This met none of 4000 random tops whose errors are 0.2 to 3 %.
    """
    odd, largest = np.zeros(len(radius), dtype=bool), int(np.argmax(radius))
    low = np.flatnonzero(radius <= STEEP * radius[largest])
    first, stop = max(low[low < largest], default=-1) + 1, min(low[low > largest], default=len(radius))
    count = stop - first
    if count < IN_A_ROW + DEGREE + 1:
        return odd
    t, share = times[first:stop], radius[first:stop] / radius[largest]
    y, powers = share**POWER, np.vander(2 * (t - t[0]) / (t[-1] - t[0]) - 1, DEGREE + 1, increasing=True)
    smooth = np.clip(powers[:, :3] @ np.linalg.lstsq(powers[:, :3], y)[0], 0.05, None) ** (1 / POWER)
    weights = smooth ** (1 - POWER) / POWER  # an error of R is one of 5/2 R^{3/2} in R^{5/2}

    def cut(inside: npt.NDArray[np.bool_]) -> tuple[float, float, Array]:
        beside = weights * ~inside
        cubic = powers[:, :DEGREE] @ np.linalg.lstsq(beside[:, None] * powers[:, :DEGREE], beside * y)[0]
        level = float(np.average(y[inside], weights=weights[inside] ** 2))
        return float(np.sum((weights * (y - np.where(inside, level, cubic))) ** 2)), level, cubic

    best = (math.inf, 0.0, y, odd)
    for start in LEVELS:
        inside = share > start
        for _ in range(ROUNDS):
            within = np.flatnonzero(inside)
            if len(within) < IN_A_ROW or min(within[0], count - 1 - within[-1]) < 2:
                break
            inside[within[0] : within[-1]] = True
            if count - inside.sum() < DEGREE:
                break
            squares, level, cubic = cut(inside)
            best = min(best, (squares, level, cubic, inside), key=lambda fit: fit[0])
            inside = cubic > level
    squares, level, cubic, inside = best
    if squares < math.inf:
        own = float(np.nan_to_num(scatter / radius[largest]))
        variance = max(squares / (count - DEGREE - 1), own**2)
        quartic = powers @ np.linalg.lstsq(weights[:, None] * powers, weights * y)[0]
        lead = float(np.mean(np.clip(cubic[inside], 0, None) ** (1 / POWER))) / level ** (1 / POWER) - 1
        better = float(np.sum((weights * (y - quartic)) ** 2)) - squares
        sides = np.split(share, np.flatnonzero(inside)[[0, -1]])  # they rise and fall, where a bubble has no other tops
        dips = [np.max(np.maximum.accumulate(side) - side) for side in (sides[0], sides[-1][::-1])]
        dips.append(2 * float(np.std(share[inside])))
        clipped = better > CUT**2 * variance and lead > math.sqrt(variance) and max(dips) <= CUT * own
        odd[first:stop] = inside & clipped
    return odd


def _fitted(t: Array, near: npt.NDArray[np.intp], degree: int, values: Array) -> tuple[Array, Array]:
    """At all instants (n, m) of windows ``t`` (n, m), polynomials through ``values`` (n, k) at the instants ``near``
    (k,), and their standard deviations with that of a reading, in errors of one.
    """
    z = (t - t.mean(axis=1, keepdims=True)) / np.ptp(t, axis=1)[:, None]
    powers = z[:, :, None] ** np.arange(degree + 1)
    weights = powers @ np.linalg.pinv(powers[:, near])
    return (weights @ values[:, :, None])[:, :, 0], np.sqrt(1 + np.sum(weights**2, axis=2))


MOSTLY = 0.8  # of the steps are whole frames: this is a film
WHOLE = 0.1  # of a frame: times may be rounded
ODD = 0.25  # of a frame off the next whole number
SAME = 0.01  # rates that agree within this are the same
_STEP = re.compile(r"(?i)(.*\.)?(delta_?t|dt|t_?step|time_?step)(_[numµ]?s)?")
_RATE = re.compile(r"(?i)(.*\.)?(fps|frame_?rate|f_?rate)(_[kM]?Hz)?")


def step_doubts(
    times: Array, unit: str, display: str, scalars: Mapping[str, float], rate: float | None = None
) -> tuple[Caution, ...]:
    """What contradicts times (K,) in ``unit``, increasing, K > 1.

    ``scalars``: of the file, whose units nobody said, so factors of 1000 are not told from agreement. ``rate``: of the
    frames, as the user says, per ``unit``. ``display``: the unit that messages use.
    """
    steps, cautions, behind = np.diff(times), list[Caution](), unit_after(display)
    step = float(np.median(steps))
    told = f"the times are {convert(step, unit, display):.4g}{behind} apart"
    if rate is not None and _off(np.array([step * rate]))[0] > SAME * step * rate:
        words = f"{told}, which is not a whole number of frames: at the given rate one takes "
        cautions.append(caution("implausible-data", f"{words}{convert(1 / rate, unit, display):.4g}{behind}"))
    for name, value in scalars.items():
        if value > 0 and (_STEP.fullmatch(name) or _RATE.fullmatch(name)):
            frames = step / value if _STEP.fullmatch(name) else step * value
            frames /= 1000.0 ** np.rint(np.log10(frames) / 3)
            if abs(frames - 1) > SAME and _off(np.array([frames]))[0] > SAME * frames:
                cautions.append(caution("implausible-data", f"{told}, but {name} of the file is {value:g}"))
    off = _off(steps / step)
    odd = np.flatnonzero(off > ODD)
    if len(odd) and np.mean(off < WHOLE) >= MOSTLY:
        first, after, whole = convert(np.array([*times[odd[0] : odd[0] + 2], step]), unit, display)
        words = (
            f"{len(odd)} of {len(steps)} steps between readings are not a whole number of frames of {whole:.4g}"
            f"{behind}, the first from {first:.6g} to {after:.6g}{behind}: is a time wrong?"
        )
        cautions.append(caution("implausible-data", words, "caution"))
    return tuple(cautions)


def _off(frames: Array) -> Array:
    """How far steps (K,) in frames are from a whole number of them, at least one."""
    return np.abs(frames - np.maximum(np.rint(frames), 1))


AS_LARGE, FALLEN = 0.8, 0.5  # of the largest reading: no rebound is as high as that, behind such a fall
SHOTS = "if there are several, each is a data set: give each a file, or a window that begins and ends at times"


def once_more(values: Array, window: slice) -> int | None:
    """Outside a window that begins at the largest of ``values`` (K,), a reading nearly as large, of another event, for
    they fall between; None where there is none, and of what swings about zero, which rises again by itself.
    """
    if values.min() < -FALLEN * values[window.start]:
        return None
    low = np.flatnonzero(values < FALLEN * values[window.start])
    before, after = low[low < window.start], low[low > window.start]
    ends = before[-1] if len(before) else 0, max(window.stop, after[0]) if len(after) else len(values)
    tops = [int(np.argmax(values[: ends[0]]))] if ends[0] else []
    tops += [ends[1] + int(np.argmax(values[ends[1] :]))] if ends[1] < len(values) else []
    return next((int(k) for k in tops if values[k] > AS_LARGE * values[window.start]), None)


APART = "bounds of one time are series of their own: one of those that say at_least, one of at_most"
SEVERAL = 4  # readings: a series has as many, and two of them as many each while both go on


def check_order(
    path: Path, layout: Layout, kept: Indices, lines: Sequence[int], written: Array, unit: str, wanted: Sequence[str],
    bounds: bool, times: Array, values: Array,
) -> None:  # fmt: skip
    """Raise :class:`DataError` where ``times`` (K,) of ``values`` (K,) are not in order, or one occurs again and may
    not. They are those of the rows ``kept`` (K,) of a file, ``written`` (K,) there in ``unit``.

    ``lines``: the numbers of its lines, if it has any; ``wanted``: the columns that are read; ``bounds``: some of these
    are marks of bounds.
    """
    order = np.argsort(times, kind="stable") if layout.unsorted == "sort" else np.arange(len(times))
    steps = np.diff(times[order])
    wrong = np.flatnonzero(steps < 0 if layout.repeated == "average" else steps <= 0)
    if not len(wrong):
        return
    before, after = order[wrong[0] : wrong[0] + 2]
    apart = "give each a file of its own"
    apart += bool(lines) * ", or a column that says whose each row is, and name it by data.by"
    ends = np.flatnonzero(np.diff(times) < 0)
    if bounds and times[after] == times[before]:
        hint = APART
    elif column := _telling_apart(path, layout, kept, lines, wanted, times):
        name = column if column.isidentifier() else repr(column)
        hint = f"column {column!r} says which of several series a row belongs to (data.by: {name})"
    elif _several(times, ends):
        before, after = ends[0], ends[0] + 1
        hint = f"these look like {len(ends) + 1} series one after another: {apart}"
        hint += "; of one series whose clock began anew, add the time that had passed to the later times"
    elif len(ends) >= SEVERAL and np.all(np.diff(values) > 0):
        hint = "the readings do, from row to row: are the columns of times and readings exchanged?"
    elif times[after] != times[before]:
        hint = "correct it, or sort the rows (data.unsorted: sort)"
    elif _differ(times, values):
        hint = f"readings of one time differ by far more than they scatter: keep one; of several series, {apart}"
    else:
        hint = "keep one of the two readings, or their mean (data.repeated: average)"
    unit = "" if "*" in unit else unit_after(unit)
    where = f":{lines[kept[after]]}" if lines else f": sample {kept[after] + 1}"
    told = f"times must increase, but {written[after]:g}{unit} follows {written[before]:g}{unit}"
    raise DataError(f"{path}{where}: {told}; {hint}")


def _telling_apart(
    path: Path, layout: Layout, kept: Indices, lines: Sequence[int], wanted: Sequence[str], times: Array
) -> str | None:
    """The column of a table that tells several series apart, each with increasing ``times`` (K,), and nothing else."""
    if layout.by is not None or not lines:
        return None
    with opened(path, layout) as kind:
        table = table_of(path, kind, layout, wanted)
    for i, name in enumerate(table.names):
        cells = np.array([cell(table.rows[k][1], i) for k in kept])
        each, which, counts = np.unique(cells, return_inverse=True, return_counts=True)
        if name not in ("", *wanted) and "" not in each and len(each) > 1 and counts.min() >= SEVERAL:
            sort = layout.unsorted == "sort"
            rows = np.lexsort((times, which)) if sort else np.argsort(which, kind="stable")
            increase = np.all((np.diff(times[rows]) > 0) | (np.diff(which[rows]) > 0))
            stacked = np.count_nonzero(np.diff(which)) < len(each)
            beside = np.count_nonzero(np.diff(which[np.lexsort((which, times))])) - len(each) >= SEVERAL
            if increase and beside and (stacked or len(times) - len(np.unique(times)) >= SEVERAL):
                return name
    return None


def _several(times: Array, ends: npt.NDArray[np.intp]) -> bool:
    """Whether ``times`` (K,), which fall back behind the ``ends``, are those of several series."""
    pairs = itertools.pairwise(np.split(times, ends + 1))
    both = [min(np.sum((c >= max(a[0], b[0])) & (c <= min(a[-1], b[-1]))) for c in (a, b)) for a, b in pairs]
    return bool(both) and min(both) >= SEVERAL


def _differ(times: Array, values: Array) -> bool:
    """Whether readings of one time differ by more than their errors can explain."""
    _, first, which = np.unique(times, return_index=True, return_inverse=True)
    apart = np.delete(np.abs(values - values[first][which]), first)
    return bool(np.median(apart) > OUTLYING * scatter_of(times[first], values[first]))
