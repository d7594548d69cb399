"""Observations (y, t, R) of one data set: of one observable in time, or of several series, one after the other.

The error of observation k is ``s_k² = std_k² + (ẏ_k · time_std_k)²``: a measured value and, where given, the instant
it was measured at. With ``time_std`` the variance depends on the state through the rate ẏ, so the normalisation
``ln s_k`` belongs to the cost and the Gauss–Newton step is Fisher scoring (see :mod:`en4dvar.data.noise`).
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy import special

from en4dvar.data.noise import Linearisation, Noise, Predicted, joint_noise, sides_of
from en4dvar.data.noise.own import require_sound
from en4dvar.data.series import Part, Series
from en4dvar.model.state import Array, hold_floats
from en4dvar.plumbing.caution import Caution
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.hints import shown
from en4dvar.priors.prior import LARGEST

SEVERAL = ", "  # between the names of several sources
BY_CHANCE = 1e-6  # chance that two recordings of a campaign agree, below which they are one
CLOSE = 1e-4  # standard deviations: readings that differ by what a shorter way to write them leaves out
ROUNDING = 1e-8  # of the largest reading
ALIKE = 1e-3  # chance of another number of a row of a table to agree
TELL_SCALE = 4  # readings
SAME_TIME = 1e-9  # of the whole duration: times of different series that are this close are the same instant


@dataclass(frozen=True)
class Observations:
    """One data set.

    Attributes
    ----------
    times: (K,) in the model's time unit, from the model's time zero; strictly increasing
        within a series, of a field not decreasing.
    values: (K,) finite, in the observable's unit.
    noise: the observation errors (:func:`en4dvar.data.noise.noise_of` makes them of std, timing error and correlation).
    weights: (K,) β_k ≥ 0; 1 counts an observation fully (``weights: sum``), 1/K is ``weights: mean``.
    name: of the data set. source: where it was read from (for the record).
    scalars: further numbers found beside the series (e.g. a size at rest), as read, no units applied.
    doubts: what makes the times of the file implausible.
    parts: which readings belong to which series, see :meth:`of_series`; () where all are of one observable, which has
        one value at a time.
    continued: these readings and those after the window, which are predicted; None where there are none.
    error_unit: in which the user states the errors of one series; "": the display unit of the observable.
    next_end: the trough after the window, as ``data.window.to`` names it; "" where there is none, or none is known.
    zero: what the clock of the data shows at the model's time zero; (K,) of several series, which may differ.

    Raises
    ------
    DataError: shapes do not fit, there is no observation, or one of the above does not hold.
    """

    times: Array
    values: Array
    noise: Noise
    weights: Array
    name: str = "data"
    source: str = ""
    scalars: Mapping[str, float] = field(default_factory=dict)
    doubts: tuple[Caution, ...] = ()
    parts: tuple[Part, ...] = ()
    continued: "Observations | None" = None
    error_unit: str = ""
    next_end: str = ""
    zero: Array | float = 0.0

    @classmethod
    def of_series(
        cls, series: Sequence[Series], correlation: Mapping[tuple[str, str], float] | None = None, name: str = "data"
    ) -> Self:
        """Several series as one data set, their readings one series after the other.

        Parameters
        ----------
        correlation: of the errors of two series at equal times, by their names, in either order; see
            :func:`en4dvar.data.noise.joint_noise`.

        Raises
        ------
        DataError: names that are not unique, or that ``correlation`` mentions and no series has; errors that cannot be
            joined; what is wrong with the observations.
        """
        names = [readings.name for readings in series]
        if len(set(names)) < len(names):
            raise DataError(f"{name}: two series have the same name; the names are {', '.join(names)}")
        between = np.eye(len(series))
        for (a, b), value in (correlation or {}).items():
            if a == b or not {a, b} <= set(names):
                raise DataError(f"{name}: a correlation of {a!r} and {b!r}; it is of two of: {', '.join(names)}")
            i, j = names.index(a), names.index(b)
            between[i, j] = between[j, i] = value
        times = [readings.times for readings in series]
        times = _same_instants(times) if len(times) > 1 else times
        with retold(ValueError, DataError, f"{name}: "):
            each = [readings.noise for readings in series]
            noise = joint_noise(times, each, between) if len(each) > 1 else each[0]
        more = series[0].continued if len(series) == 1 else None
        ends = np.cumsum([len(t) for t in times]).tolist()
        parts = tuple(
            Part(readings.name, readings.observable, end - len(readings.times), end, readings.places, readings.group)
            for readings, end in zip(series, ends, strict=True)
        )
        return cls(
            times=np.concatenate(times),
            values=np.concatenate([readings.values for readings in series]),
            noise=noise,
            weights=np.concatenate([np.asarray(readings.weights) for readings in series]),
            name=name,
            source=SEVERAL.join(dict.fromkeys(readings.source for readings in series if readings.source)),
            scalars={key: value for readings in series for key, value in readings.scalars.items()},
            doubts=tuple(doubt for readings in series for doubt in readings.doubts),
            parts=() if len(series) == 1 and series[0].places is None else parts,
            continued=None if more is None else cls(*more, np.ones(len(more[0])), name, zero=series[0].zero),
            error_unit=series[0].error_unit if len(series) == 1 else "",
            next_end=series[0].next_end if len(series) == 1 else "",
            zero=np.concatenate([np.full(len(s.times), s.zero) for s in series]) if len(series) > 1 else series[0].zero,
        )

    def __post_init__(self) -> None:
        where = self.source or self.name
        with retold((TypeError, ValueError), DataError, f"{where}: "):
            hold_floats(self, "times", "values", "weights")
        k = self.times.size
        for key in ("times", "values", "weights"):
            if np.shape(getattr(self, key)) != (k,):
                raise DataError(f"{where}: {key} has shape {np.shape(getattr(self, key))}, not ({k},)")
        if k < 1:
            raise DataError(f"{where}: no usable observation in the window")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise DataError(f"{where}: observations must be finite")
        largest = float(np.max(np.abs([self.times, self.values])))
        if not largest < LARGEST:
            raise DataError(f"{where}: {largest:g} among the observations; is the unit right? (less than {LARGEST:g})")
        for begin, end, field_ in [(p.begin, p.end, p.places) for p in self.parts] or [(0, len(self), None)]:
            step = np.diff(self.times[begin:end])
            wrong = np.flatnonzero(step <= 0 if field_ is None else step < 0)
            if len(wrong):
                a, b = self.times[begin:end][wrong[0] : wrong[0] + 2]
                raise DataError(f"{where}: times must increase; {a:g} is followed by {b:g}")
        if not np.all(self.weights >= 0):
            raise DataError(f"{where}: weights must not be negative")
        with retold(ValueError, DataError, f"{where}: "):
            if not isinstance(self.noise, Noise):
                raise ValueError(f"noise is {shown(self.noise)}; give a Noise, such as noise_of(std)")
            self.noise.check(self.weights)
            require_sound(self.noise, self.weights)
        smallest, std = float(self.std.min()), float(self.std.max())
        if not (std < LARGEST and largest < LARGEST * smallest and smallest * LARGEST > 1):
            beside = f"an error std of {smallest if std < LARGEST else std:g} beside observations up to {largest:g}"
            raise DataError(f"{where}: {beside}: their ratio is too large; is the unit right?")

    @cached_property
    def instants(self) -> tuple[Array, npt.NDArray[np.intp] | slice]:
        """The times (T,), each once and increasing, and where among them each reading (K,) was taken."""
        if not self.parts:
            return self.times, slice(None)
        times, rows = np.unique(self.times, return_inverse=True)
        return times, rows

    @property
    def span(self) -> tuple[float, float]:
        """First and last time."""
        times, _ = self.instants
        return float(times[0]), float(times[-1])

    @property
    def file_times(self) -> Array:
        """(K,) on the clock of the data."""
        return self.times + self.zero

    @property
    def std(self) -> Array:
        """(K,) error std of the readings alone."""
        return self.noise.std

    @cached_property
    def used(self) -> npt.NDArray[np.intp]:
        """Which have a weight β > 0 and are no bound: those whose residuals are random numbers of a known variance."""
        return np.flatnonzero((self.weights > 0) & (sides_of(self.noise) == 0))

    def cost(self, predicted: Predicted) -> Array:
        """J_o (…,) of predictions (…, K); +inf where one is not finite."""
        return self.noise.cost(self.values, self.weights, predicted)

    def log_likelihood(self, predicted: Predicted) -> Array:
        """Normalised log density of each observation (…, K) in its own unit, unweighted."""
        return self.noise.log_likelihood(self.values, predicted)

    def log_conditional(self, predicted: Predicted) -> Array | None:
        """Log density of each observation given all others (…, K), unweighted; None where the errors have none."""
        return self.noise.log_conditional(self.values, predicted)

    def log_normalisation(self) -> float:
        """The amount by which −Σ β_k ln p(y_k) exceeds J_o."""
        return self.noise.log_normalisation(self.weights)

    def whiten(self, at: Linearisation) -> tuple[Array, Array]:
        """Whitened innovation d (K',) and whitened anomalies S (K', N); see :meth:`en4dvar.data.noise.Noise.whiten`."""
        return self.noise.whiten(self.values, self.weights, at)

    def whitened_rows(self, rows: Array, predicted: Predicted) -> Array:
        """√β times :meth:`en4dvar.data.noise.Noise.whitened_rows`."""
        return self.noise.whitened_rows(self.values, rows, predicted) * np.sqrt(self.weights)

    def precision_times(self, at: Predicted, vectors: Array) -> Array:
        """β R⁻¹ applied to vectors (…, K), R at a prediction."""
        return self.noise.precision_times(self.values, self.weights, at, vectors)

    def chi2_per_observation(self, predicted: Predicted) -> Array:
        """(y − m)ᵀR⁻¹(y − m) per observation of :attr:`used` (…,), for predictions (…, K); NaN where there is none.

        With a robust cost each square is v ρ'(v), whose expectation under the density of ρ is 1 as well. A bound adds
        its square where it does not hold, and is no observation otherwise; of bounds alone it is the sum.
        """
        counted = np.flatnonzero(self.weights > 0)
        squares = self.noise.squares(self.values, predicted).take(counted, axis=-1)
        return np.asarray(np.add.reduce(squares, axis=-1) / (len(self.used) or (1.0 if len(counted) else np.nan)))

    def __len__(self) -> int:
        return len(self.times)


def require_distinct(sets: Sequence[Observations]) -> None:
    """Refuse data sets that count together and of which some hold one recording, whole or in part, on the same clock.

    They do where most readings at instants that both have, up to half of a step between readings, are closer to each
    other than independent errors, of the stated size and read on the coarser of the two scales, bring any two of the
    sets with a chance of :data:`BY_CHANCE`; scalars help where all of them agree. Bounds, readings without weight and
    several series are not compared.

    Raises :class:`ConfigError`, which names all of them.
    """
    each, pairs = [_Recording.of(o) for o in sets], math.comb(len(sets), 2)
    usual = [max(recording.scale, 2.5 * CLOSE * recording.std.max(initial=0.0)) for recording in each]
    width, step = (max([it for it in its if it < math.inf], default=1.0) for its in (usual, [r.step for r in each]))
    first, holders = list(range(len(sets))), dict[tuple[int, int], set[int]]()
    instants = [{round(time / step) for time in recording.times.tolist()} for recording in each]
    for e, own in enumerate(each):
        cells = [(round(t / step), round(value / width)) for t, value in np.stack(own[:2], axis=1).tolist()]
        about = ([(t + i, v + j) for i in (-1, 0, 1) for j in (-1, 0, 1)] for t, v in cells)
        met = Counter(i for near in about for i in set[int]().union(*(holders.get(cell, ()) for cell in near)))
        for i in (i for i, count in sorted(met.items()) if 2 * count > len(instants[e] & instants[i])):
            numbers = {*sets[e].scalars.values()} if sets[i].scalars == sets[e].scalars else set()
            if first[i] == i and pairs * own.chance(each[i]) * ALIKE ** len(numbers) < BY_CHANCE:
                first[e] = i
                break
        for held in cells:
            holders.setdefault(held, set()).add(e)
    named = [f"{o.name} ({o.source})" if o.source else o.name for o in sets]
    groups = [[named[e] for e in range(len(sets)) if first[e] == i] for i in dict.fromkeys(first)]
    if copies := [f"{', '.join(group[:-1])} and {group[-1]}" for group in groups if len(group) > 1]:
        raise ConfigError(
            f"{'; '.join(copies)} hold the same readings, which would count more than once: give each recording once; "
            "what two configurations say of one recording is told by 'en4dvar compare'"
        )


class _Recording(NamedTuple):
    """Readings (K,) that count, on the clock of the data, the scale that they are read on, 0 where they are too few to
    tell it, and the step between them."""

    times: Array
    values: Array
    std: Array
    scale: float
    step: float

    @classmethod
    def of(cls, observations: Observations) -> Self:
        used = np.empty(0, dtype=int) if observations.parts else observations.used
        times, values = observations.file_times[used], observations.values[used]
        step = float(np.median(np.diff(times))) if len(times) > 1 else math.inf
        return cls(times, values, observations.std[used], _scale(values) if len(values) >= TELL_SCALE else 0.0, step)

    def chance(self, other: "_Recording") -> float:
        """The chance that independent readings of two recordings agree as often as these do."""
        few, many = (self, other) if len(self.times) < len(other.times) else (other, self)
        at = np.searchsorted(0.5 * (many.times[1:] + many.times[:-1]), few.times)
        step = min(few.step, many.step)
        near_in_time = 0.5 * step if step < math.inf else SAME_TIME * np.abs(few.times)
        common = np.abs(few.times - many.times[at]) <= near_in_time
        apart, var = np.abs(few.values - many.values[at])[common], (few.std**2 + many.std[at] ** 2)[common]
        scale, likely = max(few.scale, many.scale) or _scale(np.concatenate([few.values, many.values])), 1.0
        for least in (CLOSE, 0.0):  # of the errors
            near = np.maximum((0.5 + ROUNDING) * scale, least * np.sqrt(var / 2))
            alike, count = int(np.count_nonzero(apart <= near)), len(apart)
            if 2 * alike <= count:
                break
            of_each = float(np.mean(special.erf(np.maximum(scale, near) / np.sqrt(2 * var))))
            likely = min(likely, float(special.bdtrc(alike - 1, count, of_each)))
        return likely


def _scale(values: Array) -> float:
    """The step of the scale that all values lie on: their greatest common divisor, as far as rounding tells."""
    step, least = 0.0, ROUNDING * float(np.max(np.abs(values), initial=0.0))
    for value in np.abs(values):
        step, rest = max(step, float(value)), min(step, float(value))
        while rest > least:
            step, rest = rest, min(step % rest, rest - step % rest)
        step = value / round(value / step) if value else step  # the errors of remainders would grow from value to value
    return float(step) or math.inf


def _same_instants(times: Sequence[Array]) -> list[Array]:
    """The times of each series; those that differ by rounding alone are made equal to the earliest of them."""
    every = np.unique(np.concatenate(times))
    begins = np.diff(every, prepend=-np.inf) > SAME_TIME * float(np.ptp(every))
    earliest = every[begins][np.cumsum(begins) - 1]
    return [earliest[np.searchsorted(every, own)] for own in times]
