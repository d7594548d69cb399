"""Every trajectory of one design against every data set: the best fit by NRMSE over a time shift.

This is the "IMR Approach" of Mancia et al. (2021). The design is a scrambled Sobol sequence, uniform in the transformed
coordinates of the priors within ``width`` standard deviations of their means. It is shared by all data sets, so a
trajectory is computed once: where their priors differ it fills the smallest box around all of them, and each set takes
its fit from within its own. Trajectories stream through in chunks; of each chunk only the best fit of every set is
kept, on disk where a folder is given, and an interrupted sweep continues with the chunks that are missing. The fit is

    NRMSE = 1 − ‖y − ŷ‖ / ‖y − ȳ‖        (section "IMR Approach")

ŷ_i is the trace at the instant of its time grid nearest to t_i + t_s. Shifts are multiples of the grid's step, so a
shift moves every index by the same number.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.ensemble.forecast import forecast
from en4dvar.executor import Executor, SerialExecutor
from en4dvar.model.state import TIME_SHIFT, Array, Parameter
from en4dvar.plumbing.compiled import kernel
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.files import atomic_path, inside, open_plain
from en4dvar.priors.prior import member_stream
from en4dvar.problem import InverseProblem

BATCH = 128  # trajectories whose full solution is in memory at once, a worker
LARGEST = 250_000_000  # numbers in these solutions, at most
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Targets:
    """Readings of S data sets on one time grid.

    ``grid`` (M,) s; ``values`` and ``nearest`` (sum K,) readings and indices of the grid without shift; readings of
    set s are ``offsets[s]:offsets[s+1]``; ``scale`` (S,) ‖y − ȳ‖²; ``reach``: the shifts are −reach…reach steps.
    """

    grid: Array
    step: float
    values: Array
    nearest: np.ndarray
    offsets: np.ndarray
    scale: Array
    reach: int


def targets(
    observations: Sequence[Observations], shift: float, step: float, earliest: float = -np.inf, most: float = np.inf
) -> Targets:
    """The grid covers every reading that counts at every shift within ±``shift`` (s), from ``earliest`` on.

    Raises ValueError: readings that count are all alike; one would be compared before ``earliest``; the grid would have
    more than ``most`` instants.
    """
    reach = int(np.floor(shift / step * (1 + 1e-9)))
    each = [(o.times[o.used], o.values[o.used]) for o in observations]
    for o, (_, y) in zip(observations, each, strict=True):
        if not len(y) or np.ptp(y) == 0:
            raise ValueError(f"{o.name}: a fit by NRMSE needs readings, no bounds, with a weight that differ")
    first = min(float(t[0]) for t, _ in each) - reach * step
    last = max(float(t[-1]) for t, _ in each) + reach * step
    if (count := (last - first) / step) > most:
        apart = np.median(np.concatenate([np.diff(t) for t, _ in each]))
        raise ValueError(
            f"from {first:g} to {last:g} in steps of {step:g} are {count:.2g} instants, more than memory is meant for "
            f"({most:.2g}): readings are {apart:g} apart, give a larger --step, and a --shift that fits it"
        )
    if first < earliest:
        raise ValueError(f"a reading shifted by {-reach * step:g} s would lie {earliest - first:g} s before the start")
    grid = first + step * np.arange(int(np.ceil((last - first) / step * (1 - 1e-9))) + 1)
    values = np.concatenate([y for _, y in each])
    nearest = np.concatenate([np.rint((t - first) / step).astype(np.int64) for t, _ in each])
    offsets = np.concatenate([[0], np.cumsum([len(y) for _, y in each])])
    scale = np.array([np.sum((y - y.mean()) ** 2) for _, y in each])
    return Targets(np.asarray(grid, dtype=float), step, values, nearest, offsets, scale, reach)


def best_over_shifts(traces: Array, aims: Targets) -> tuple[Array, Array]:
    """Largest NRMSE (B, S) over the shifts of traces (B, M), and that shift (B, S) in s; −inf where a trace is NaN."""
    shape = (len(traces), len(aims.scale))
    squares, steps = np.empty(shape), np.empty(shape, dtype=np.int64)
    _least_squares(np.ascontiguousarray(traces), aims.values, aims.nearest, aims.offsets, aims.reach, squares, steps)
    return np.asarray(1 - np.sqrt(squares / aims.scale)), np.asarray(steps * aims.step)


@kernel
def _least_squares(
    traces: Array,
    values: Array,
    nearest: npt.NDArray[np.int64],
    offsets: npt.NDArray[np.int64],
    reach: int,
    squares: Array,
    steps: npt.NDArray[np.int64],
) -> None:
    last = traces.shape[1] - 1
    for b in range(traces.shape[0]):
        trace = traces[b]
        alive = True
        for m in range(trace.size):
            alive &= np.isfinite(trace[m])
        for s in range(offsets.size - 1):
            squares[b, s] = np.inf
            steps[b, s] = 0
            if not alive:
                continue
            for k in range(2 * reach + 1):
                # from no shift outwards: of equal fits the smallest shift is kept
                move = (k + 1) // 2 if k % 2 else -(k // 2)
                total = 0.0
                for i in range(offsets[s], offsets[s + 1]):
                    at = min(max(nearest[i] + move, 0), last)
                    difference = values[i] - trace[at]
                    total += difference * difference
                    if total >= squares[b, s]:
                        break
                if total < squares[b, s]:
                    squares[b, s] = total
                    steps[b, s] = move


@dataclass(frozen=True)
class SweepSettings:
    """``shift`` and ``step``: the largest time shift and the step of the traces' time grid, in the model's time unit.

    After the design come ``rounds`` of local refinement of every set's best fit by differential evolution (Storn &
    Price 1997, "best/1"): ``local`` trajectories a set, first in ±``width``/4 prior standard deviations about it. They
    follow the narrow valleys of parameters that make up for each other.
    """

    trajectories: int
    shift: float
    step: float
    width: float = 3.0
    chunk: int = 2048
    rounds: int = 0
    local: int = 32


@dataclass(frozen=True)
class Best:
    """The best fit of each of S sets so far: transformed ``x`` (S, n), ``shift`` (S,), ``nrmse`` (S,)."""

    x: Array
    shift: Array
    nrmse: Array

    def merged(self, other: "Best") -> "Best":
        """The better of the two, set by set; this one where they are equal."""
        better = other.nrmse > self.nrmse
        x = np.where(better[:, None], other.x, self.x)
        return Best(x, np.where(better, other.shift, self.shift), np.where(better, other.nrmse, self.nrmse))


@dataclass(frozen=True)
class SweepResult:
    """Best fits of S data sets. ``theta`` (S, n) physical, SI, in the order of ``parameters``; ``shift`` (S,)."""

    names: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    theta: Array
    shift: Array
    nrmse: Array
    trajectories: int

    def part(self, rows: slice) -> "SweepResult":
        """The same of some of the data sets."""
        return replace(
            self, names=self.names[rows], theta=self.theta[rows], shift=self.shift[rows], nrmse=self.nrmse[rows]
        )

    @property
    def mean(self) -> Array:
        """(n,) NRMSE-weighted mean over the sets."""
        return by_fit(self.theta, self.nrmse)[0]

    @property
    def std(self) -> Array:
        """(n,) NRMSE-weighted standard deviation over the sets."""
        return by_fit(self.theta, self.nrmse)[1]


def by_fit(values: Array, fits: Array) -> tuple[Array, Array]:
    """Mean Σ w θ / Σ w and standard deviation √(Σ w (θ − mean)² / Σ w) of values θ (S, …) of data sets, w their NRMSE
    (S,), or 0 of a set that is fitted worse than by a constant; where all are they count alike.
    """
    weights = np.where(fits < 0, 0.0, fits) if np.any(fits > 0) else np.ones(len(fits))
    mean = np.average(values, axis=0, weights=weights)
    return np.asarray(mean), np.asarray(np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weights)))


def run_sweep(
    problems: Sequence[InverseProblem],
    settings: SweepSettings,
    seed: int,
    executor: Executor | None = None,
    folder: Path | None = None,
    progress: Progress | None = None,
    earliest: float = 0.0,
) -> SweepResult:
    """Fit every data set.

    ``problems``: of one model and the same parameters with the same transforms, whose priors may differ. Priors on
    ``t_s`` and on parameters of the errors play no part: the shift is searched within its limits. ``folder``: where
    finished chunks are kept, and found again by a sweep that continues; the caller clears it. ``progress``: called
    with the trajectories done and to do. ``earliest``: the instant before which the model has no path; −inf where
    it has one at any time.

    Raises ConfigError: the data sets do not share a model, fixed values or parameters; none of these is the model's;
    one has several series. DataError: no trajectory fits a set; readings are all alike, or one would be compared before
    ``earliest``; the step is far too small.
    """
    executor, told = executor or SerialExecutor(), progress or (lambda done, total: None)
    mean, std = _moments(problems)
    with retold(ValueError, DataError):
        most = LARGEST / BATCH / problems[0].model.layout.size
        aims = targets([p.observations for p in problems], settings.shift, settings.step, earliest, most)
    ones = np.ones(len(aims.grid))
    traced = Observations(aims.grid, ones, noise_of(ones, 0 * ones), ones)
    searched, reach = replace(_searched(problems[0]), observations=traced), settings.width * std
    score = _Score(searched, aims, mean - reach, mean + reach, std)
    low, high = score.low.min(axis=0), score.high.max(axis=0)
    design = sobol_box((low + high) / 2, (high - low) / 2, settings.trajectories, seed)
    parts = [design[i : i + settings.chunk] for i in range(0, len(design), settings.chunk)]
    files = [inside(folder, f"chunk_{i:05d}.npz") if folder else None for i in range(len(parts))]
    refining = (settings.rounds + 1) * settings.local * len(problems) if settings.rounds else 0
    total, done = settings.trajectories + refining, 0
    best_of_set: dict[int, Best] = {}
    for i, best in executor.results(score.chunk, list(zip(parts, files, strict=True))):
        best_of_set[i] = best
        done += len(parts[i])
        told(done, total)
    best = reduce(Best.merged, (best_of_set[i] for i in range(len(parts))))
    for count, refined in _refined(score, best, settings, seed, executor):
        best = refined
        done += count
        told(done, total)
    names = tuple(p.observations.name for p in problems)
    lost = [name for name, value in zip(names, best.nrmse, strict=True) if not math.isfinite(value)]
    if lost:
        raise DataError(f"no trajectory of the design could be integrated for {', '.join(lost)}")
    prior = score.problem.prior
    return SweepResult(names, prior.parameters, prior.to_physical(best.x), best.shift, best.nrmse, done)


def sobol_box(centre: Array, half: Array, count: int, seed: int) -> Array:
    """Scrambled Sobol points (count, n) in ``centre`` ± ``half``; more points leave the first ones as they were."""
    from scipy.stats import qmc  # not needed to import the package

    unit = qmc.Sobol(len(centre), rng=seed).random_base2(max(1, math.ceil(math.log2(count))))[:count]
    return np.asarray(centre + (2 * unit - 1) * half)


def _in_common(problem: InverseProblem) -> tuple[object, ...]:
    """The settings that data sets of one design have in common besides the model."""
    terms = [(t.parameter.name, t.transform, t.bounds, t.shape) for t in problem.prior.terms]
    return terms, problem.fixed, problem.perturbations, problem.tied, problem.observable.name


def _searched(problem: InverseProblem) -> InverseProblem:
    """The problem whose control vector is what a sweep searches: neither the time shift nor parameters of the errors.

    Raises :class:`ConfigError` where that is nothing.
    """
    apart = {TIME_SHIFT.name, *problem.of_errors}
    terms = tuple(t for t in problem.prior.terms if t.parameter.name not in apart)
    if not terms:
        words = "nothing but a time shift and errors is estimated; a sweep needs a prior on a parameter of the model"
        raise ConfigError(words)
    fixed = {name: value for name, value in problem.fixed.items() if name not in apart}
    return replace(problem, prior=problem.prior.of(terms), fixed=fixed)


def _moments(problems: Sequence[InverseProblem]) -> tuple[Array, Array]:
    """Mean and std (S, n) of the priors, transformed. Raises :class:`ConfigError`: they cannot share a design."""
    first = problems[0]
    if several := [p.observations.name for p in problems if p.observations.parts]:
        raise ConfigError(f"{several[0]}: a sweep fits data sets of one series, read at no places of a field")
    for other in problems[1:]:
        if other.model is not first.model or _in_common(other) != _in_common(first):
            raise ConfigError(
                "the design is shared: all data sets need one model, the same parameters and the same fixed values, "
                f"unlike {other.observations.name}"
            )
    priors = [_searched(p).prior for p in problems]
    return np.stack([p.mean for p in priors]), np.stack([p.std for p in priors])


@dataclass(frozen=True)
class _Score:
    """What all chunks share; each set is searched from ``low`` to ``high`` (S, n), its prior has the ``std`` (S, n)."""

    problem: InverseProblem  # its observations are those of a trace, on the time grid
    aims: Targets
    low: Array
    high: Array
    std: Array

    def chunk(self, x: Array, file: Path | None) -> Best:
        """The best fits among coordinates (B, n), from ``file`` where they are, or kept there."""
        if file is not None and (kept := _kept(file)) is not None:
            return kept
        best = reduce(Best.merged, (self._best(x[i : i + BATCH]) for i in range(0, len(x), BATCH)))
        if file is not None:
            with atomic_path(file, durable=False) as partial, partial.open("wb") as stream:
                np.savez(stream, **vars(best))
        return best

    def _best(self, x: Array) -> Best:
        nrmse, shift = self.of(x)
        # the box around all priors holds coordinates that belong to no range of a set; a rounding is not outside
        edge = 1e-9 * self.std
        inside = np.all((x[:, None] >= self.low - edge) & (x[:, None] <= self.high + edge), axis=2)
        nrmse = np.where(inside, nrmse, -np.inf)
        row, sets = np.argmax(nrmse, axis=0), np.arange(nrmse.shape[1])
        return Best(x[row], shift[row, sets], nrmse[row, sets])

    def of(self, x: Array) -> tuple[Array, Array]:
        """NRMSE and shift (B, S) of coordinates (B, n)."""
        return best_over_shifts(forecast(self.problem, x).predictions, self.aims)


def _refined(
    score: _Score, best: Best, settings: SweepSettings, seed: int, executor: Executor
) -> Iterator[tuple[int, Best]]:
    """Trajectories run and the best fits after each round."""
    if not settings.rounds:
        return
    n_sets, half = len(best.nrmse), settings.width / 4 * score.std
    x = np.stack([sobol_box(best.x[s], half[s], settings.local, seed + 1 + s) for s in range(n_sets)])
    nrmse, shift = _own(score, x, executor)
    stream = member_stream(seed, "sweep refinement")
    for number in range(settings.rounds + 1):
        if number:
            trial = _trials(score, x, best, stream)
            new, moved = _own(score, trial, executor)
            better = new > nrmse
            x, shift = np.where(better[..., None], trial, x), np.where(better, moved, shift)
            nrmse = np.where(better, new, nrmse)
        top, sets = np.argmax(nrmse, axis=1), np.arange(n_sets)
        best = best.merged(Best(x[sets, top], shift[sets, top], nrmse[sets, top]))
        yield nrmse.size, best


def _trials(score: _Score, x: Array, best: Best, stream: np.random.Generator) -> Array:
    """best + F (x_b − x_c) of each set, inside the range of the design."""
    n_sets, count, _ = x.shape
    pairs = np.argsort(stream.uniform(size=(n_sets, count, count)), axis=2)[..., :2]
    b, c = (np.take_along_axis(x, pairs[..., k, None], axis=1) for k in (0, 1))
    step = stream.uniform(0.4, 1.0, (n_sets, count, 1)) * (b - c)
    return np.clip(best.x[:, None] + step, score.low[:, None], score.high[:, None])


def _own(score: _Score, x: Array, executor: Executor) -> tuple[Array, Array]:
    """NRMSE and shift (S, L) of coordinates (S, L, n), each against its own set."""
    n_sets, count, n = x.shape
    flat = x.reshape(-1, n)
    scores = dict(executor.results(score.of, [(flat[i : i + BATCH],) for i in range(0, len(flat), BATCH)]))
    parts = zip(*(scores[i] for i in range(len(scores))), strict=True)
    nrmse, shift = (np.concatenate(p).reshape(n_sets, count, n_sets) for p in parts)
    sets = np.arange(n_sets)
    return nrmse[sets, :, sets], shift[sets, :, sets]


def _kept(file: Path) -> Best | None:
    """The content of a chunk; None where it is missing, or damaged as by a loss of power: it is computed again."""
    try:
        with open_plain(file) as stream, np.load(stream) as stored:
            return Best(**stored)
    except (OSError, ValueError, TypeError, EOFError, BadZipFile):
        return None
