"""Route 1, the paper's "IMR Approach": every trajectory of one design against every data set, best fit by NRMSE.

The design is a scrambled Sobol sequence, uniform in the transformed coordinates of the priors within ``width`` standard
deviations of their means. It is shared by all data sets, so a trajectory is computed once: where their priors differ
(two gels) it fills the smallest box around all of them, and each set takes its fit from within its own. Trajectories
stream through in chunks; of each chunk only the best fit of every set is kept, on disk where a folder is given, and an
interrupted sweep continues with the chunks that are missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from en4dvar.errors import ConfigError, DataError, OutputError
from en4dvar.files import atomic_path, write_text
from en4dvar.forward import ForwardModel
from en4dvar.prior import member_stream
from en4dvar.problem import InverseProblem
from en4dvar.state import TIME_SHIFT, Array, Parameter
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.study.nearest import Targets, best_over_shifts, targets

BATCH = 128  # trajectories whose full solution is in memory at once, a thread
T = TypeVar("T")
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SweepSettings:
    """``shift`` and ``step`` (s): the largest time shift and the step of the traces' time grid.

    After the design come ``rounds`` of local refinement of every set's best fit by differential evolution (Storn &
    Price 1997, "best/1"): ``local`` trajectories a set, first in ±``width``/4 prior standard deviations about it. They
    follow the narrow valleys of parameters that make up for each other.
    """

    trajectories: int = 50_000
    shift: float = 0.8e-6
    step: float = 0.025e-6
    width: float = 3.0
    chunk: int = 2048
    rounds: int = 0
    local: int = 32


@dataclass(frozen=True)
class Best:
    """The best fit of each of S sets so far: transformed ``x`` (S, n), ``shift`` (S,) s, ``nrmse`` (S,)."""

    x: Array
    shift: Array
    nrmse: Array

    def merged(self, other: Best) -> Best:
        """The better of the two, set by set; this one where they are equal."""
        better = other.nrmse > self.nrmse
        pick = {f.name: (getattr(self, f.name), getattr(other, f.name)) for f in fields(self)}
        return Best(**{k: np.where(better[:, None] if a.ndim == 2 else better, b, a) for k, (a, b) in pick.items()})


@dataclass(frozen=True)
class SweepResult:
    """Best fits of S data sets. ``theta`` (S, n) physical, SI, in the order of ``parameters``; ``shift`` (S,) s."""

    names: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    theta: Array
    shift: Array
    nrmse: Array
    trajectories: int

    def part(self, rows: slice) -> SweepResult:
        """Of some of the data sets."""
        return replace(
            self, names=self.names[rows], theta=self.theta[rows], shift=self.shift[rows], nrmse=self.nrmse[rows]
        )

    @property
    def mean(self) -> Array:
        """(n,) NRMSE-weighted mean over the sets, Σ w θ / Σ w with w the NRMSE of the best fit."""
        return np.asarray(np.average(self.theta, axis=0, weights=self.nrmse))

    @property
    def std(self) -> Array:
        """(n,) NRMSE-weighted standard deviation over the sets, √(Σ w (θ − mean)² / Σ w)."""
        return np.asarray(np.sqrt(np.average((self.theta - self.mean) ** 2, axis=0, weights=self.nrmse)))


def run_sweep(
    problems: Sequence[InverseProblem],
    settings: SweepSettings,
    seed: int,
    workers: int = 1,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> SweepResult:
    """Fit every data set.

    Parameters
    ----------
    problems: of one model and the same parameters with the same transforms, whose priors may differ. A prior on
        ``t_s`` plays no part: the shift is searched within its limits.
    folder: where finished chunks are kept, and found again by a sweep that continues; the caller clears it.
    progress: called with the trajectories done and to do.

    Raises
    ------
    ConfigError: the data sets do not share a model, fixed values or parameters; nothing but t_s is estimated.
    DataError: no trajectory fits a set.
    """
    sweep = _Sweep(problems, settings, workers, folder)
    total = settings.trajectories + refinement_size(settings, len(problems))
    done, best = 0, None
    low, high = sweep.low.min(axis=0), sweep.high.max(axis=0)
    design = sobol_box((low + high) / 2, (high - low) / 2, settings.trajectories, seed)
    for x, found in sweep.run(design):
        best = found if best is None else best.merged(found)
        done += len(x)
        if progress is not None:
            progress(done, total)
    assert best is not None
    for count, refined in sweep.refine(best, seed):
        best = refined
        done += count
        if progress is not None:
            progress(done, total)
    names = tuple(p.observations.name for p in problems)
    lost = [name for name, value in zip(names, best.nrmse, strict=True) if not math.isfinite(value)]
    if lost:
        raise DataError(f"no trajectory of the design could be integrated for {', '.join(lost)}")
    return SweepResult(names, sweep.parameters, sweep.physical(best.x), best.shift, best.nrmse, done)


def refinement_size(settings: SweepSettings, n_sets: int) -> int:
    """Trajectories of the local refinement."""
    return (settings.rounds + 1) * settings.local * n_sets if settings.rounds else 0


def sobol_box(centre: Array, half: Array, count: int, seed: int) -> Array:
    """Scrambled Sobol points (count, n) in ``centre`` ± ``half``; more points leave the first ones as they were."""
    from scipy.stats import qmc

    unit = qmc.Sobol(len(centre), rng=seed).random_base2(max(1, math.ceil(math.log2(count))))[:count]
    return np.asarray(centre + (2 * unit - 1) * half)


def _same_model(a: BubbleModel, b: ForwardModel) -> bool:
    """Whether two configurations made the same model. A law has no settings but its parameters: its class is all."""
    if a is b:
        return True
    if not isinstance(b, BubbleModel) or type(a.law) is not type(b.law):
        return False
    return all(getattr(a, f.name) == getattr(b, f.name) for f in fields(a) if f.name != "law")


class _Sweep:
    """What all chunks share: model, targets, and how a coordinate becomes a state."""

    def __init__(self, problems: Sequence[InverseProblem], settings: SweepSettings, workers: int, folder: Path | None):
        first = problems[0]
        if not isinstance(first.model, BubbleModel):
            raise ConfigError("a sweep needs the model 'bubble'")
        for other in problems[1:]:
            same = [(t.parameter.name, t.transform, t.bounds) for t in other.prior.terms] == [
                (t.parameter.name, t.transform, t.bounds) for t in first.prior.terms
            ]
            if not same or other.fixed != first.fixed or not _same_model(first.model, other.model):
                raise ConfigError(
                    f"{other.observations.name}: the design is shared, but model, parameters or fixed values are not "
                    f"those of {first.observations.name}"
                )
        self.model, self.settings, self.workers, self.folder = first.model, settings, workers, folder
        self.terms = tuple(t for t in first.prior.terms if t.parameter.name != TIME_SHIFT.name)
        if not self.terms:
            raise ConfigError("nothing but the time shift is estimated; a sweep needs a prior on a parameter")
        self.fixed = {name: v for name, v in first.fixed.items() if name != TIME_SHIFT.name}
        self.parameters = tuple(t.parameter for t in self.terms)
        kept = [first.prior.names.index(p.name) for p in self.parameters]
        self.std = np.stack([p.prior.std[kept] for p in problems])  # (S, n), as the range of each set
        means = np.stack([p.prior.mean[kept] for p in problems])
        self.low, self.high = means - settings.width * self.std, means + settings.width * self.std
        earliest = 0.0 if first.model.start == "acoustic" else -np.inf
        try:
            self.aims: Targets = targets([p.observations for p in problems], settings.shift, settings.step, earliest)
        except ValueError as error:
            raise DataError(str(error)) from None

    def physical(self, x: Array) -> Array:
        return np.stack([t.to_physical(x[:, j]) for j, t in enumerate(self.terms)], axis=1)

    def run(self, design: Array) -> Iterator[tuple[Array, Best]]:
        """Chunks of the design with the best fits among them, in order."""
        chunks = [design[i : i + self.settings.chunk] for i in range(0, len(design), self.settings.chunk)]
        files = [self.folder / f"chunk_{i:05d}.npz" if self.folder else None for i in range(len(chunks))]
        yield from zip(chunks, self._map(self._chunk, chunks, files), strict=True)

    def refine(self, best: Best, seed: int) -> Iterator[tuple[int, Best]]:
        """Trajectories run and the best fits after each round."""
        settings, n_sets = self.settings, len(best.nrmse)
        if not settings.rounds:
            return
        half = settings.width / 4 * self.std
        x = np.stack(
            [sobol_box(c, h, settings.local, seed + 1 + s) for s, (c, h) in enumerate(zip(best.x, half, strict=True))]
        )
        nrmse, shift = self._own(x)
        stream = member_stream(seed, "sweep refinement")
        for number in range(settings.rounds + 1):
            if number:
                trial = self._trials(x, best, stream)
                new, moved = self._own(trial)
                better = new > nrmse
                x, nrmse, shift = (
                    np.where(better[..., None], trial, x),
                    np.where(better, new, nrmse),
                    np.where(better, moved, shift),
                )
            top, sets = np.argmax(nrmse, axis=1), np.arange(n_sets)
            best = best.merged(Best(x[sets, top], shift[sets, top], nrmse[sets, top]))
            yield nrmse.size, best

    def _trials(self, x: Array, best: Best, stream: np.random.Generator) -> Array:
        """best + F (x_b − x_c) of each set, inside the range of the design."""
        n_sets, count, _ = x.shape
        pairs = np.argsort(stream.uniform(size=(n_sets, count, count)), axis=2)[..., :2]
        b, c = (np.take_along_axis(x, pairs[..., k, None], axis=1) for k in (0, 1))
        step = stream.uniform(0.4, 1.0, (n_sets, count, 1)) * (b - c)
        return np.clip(best.x[:, None] + step, self.low[:, None], self.high[:, None])

    def _own(self, x: Array) -> tuple[Array, Array]:
        """NRMSE and shift (S, L) of coordinates (S, L, n), each against its own set."""
        n_sets, count, n = x.shape
        flat = x.reshape(-1, n)
        parts = list(self._map(self._score, [flat[i : i + BATCH] for i in range(0, len(flat), BATCH)]))
        nrmse, shift = (np.concatenate(p).reshape(n_sets, count, n_sets) for p in zip(*parts, strict=True))
        sets = np.arange(n_sets)
        return nrmse[sets, :, sets], shift[sets, :, sets]

    def _map(self, function: Callable[..., T], *columns: Sequence[Any]) -> Iterator[T]:
        with ThreadPoolExecutor(self.workers) as pool:
            try:
                yield from pool.map(function, *columns)
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    def _chunk(self, x: Array, file: Path | None) -> Best:
        if file is not None and file.exists():
            with np.load(file) as stored:
                return Best(**{f.name: stored[f.name] for f in fields(Best)})
        best = self._fit(x[:BATCH])
        for i in range(BATCH, len(x), BATCH):
            best = best.merged(self._fit(x[i : i + BATCH]))
        if file is not None:
            with atomic_path(file, durable=False) as partial, partial.open("wb") as stream:
                np.savez(stream, **{f.name: getattr(best, f.name) for f in fields(Best)})
        return best

    def _fit(self, x: Array) -> Best:
        nrmse, shift = self._score(x)
        # the box around all priors holds coordinates that belong to no range of a set; a rounding is not outside
        edge = 1e-9 * self.std
        inside = np.all((x[:, None] >= self.low - edge) & (x[:, None] <= self.high + edge), axis=2)
        nrmse = np.where(inside, nrmse, -np.inf)
        row, sets = np.argmax(nrmse, axis=0), np.arange(nrmse.shape[1])
        return Best(x[row], shift[row, sets], nrmse[row, sets])

    def _score(self, x: Array) -> tuple[Array, Array]:
        """NRMSE and shift (B, S) of coordinates (B, n)."""
        theta = {p.name: column for p, column in zip(self.parameters, self.physical(x).T, strict=True)}
        theta |= {name: np.full(len(x), value) for name, value in self.fixed.items()}
        states = self.model.initial_states({p.name: theta[p.name] for p in self.model.parameters})
        path = self.model.integrate(states, np.broadcast_to(self.aims.grid, (len(x), len(self.aims.grid))))
        return best_over_shifts(np.where(path.solution.status[:, None] == 0, path["R"], np.nan), self.aims)


def prepare_folder(folder: Path, key: str, mode: str) -> Path:
    """The folder of a sweep's chunks: ``new`` wants it empty, ``force`` empties it, ``resume`` wants the same ``key``.

    Raises
    ------
    OutputError: it holds another sweep, or cannot be written.
    """
    mark = folder / "sweep.key"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stored = mark.read_text(encoding="utf-8") if mark.exists() else ""
        if mode == "force":
            for file in (mark, *folder.glob("*.npz")):
                file.unlink(missing_ok=True)
            stored = ""
        if stored and mode == "new":
            raise OutputError(f"{folder}: holds a sweep; give --resume to continue it or --force to replace it")
        if stored and stored != key:
            raise OutputError(f"{folder}: holds the sweep of another configuration; give --force to replace it")
        for partial in folder.glob(".*.tmp"):  # of a process that was killed
            partial.unlink()
        write_text(mark, key)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be used: {error.strerror or error}") from None
    return folder
