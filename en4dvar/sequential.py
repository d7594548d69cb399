"""Sequential assimilation of a long series: the loop around ETKF and IEnKS.

The ensemble stands at the start of a window of ``lag`` observation times. A cycle runs it to the newest observation,
iterates the scheme's weights at the start, inflates, and moves the window on by one (shift 1); a filter is a window
without length. The control vector is the whole state, parameters included.

A member that cannot be integrated is dropped and the window done again with the survivors, so that the statistics stay
those of one ensemble; its reason is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from en4dvar.errors import TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.forward import Failure, ForwardModel, Observable, Trajectory
from en4dvar.inflation import Inflation
from en4dvar.linalg import apply_weights, centre, rotate
from en4dvar.localisation import Localisation
from en4dvar.prior import member_stream
from en4dvar.schemes import Evaluation, Step, Weights
from en4dvar.state import Array

NO_INFLATION = Inflation()


class SequentialScheme(Protocol):
    """What the loop needs of a scheme; see :class:`~en4dvar.schemes.ienks.IEnKS` for the shapes."""

    @property
    def lag(self) -> int: ...
    @property
    def max_iterations(self) -> int: ...
    @property
    def tolerance(self) -> float: ...
    def init(self, n_members: int) -> Weights: ...
    def spread(self, weights: Weights) -> Array: ...
    def linearise(self, weights: Weights, predictions: Array) -> tuple[Array, Array]: ...
    def step(self, weights: Weights, evaluation: Evaluation) -> Step: ...


@dataclass(frozen=True)
class Series:
    """Observations ``values`` (K, p) at increasing ``times`` (K,) > 0 with independent errors ``std`` (p,) or (K, p).

    Raises
    ------
    ValueError: shapes that do not fit, times that do not increase from zero, std that is not positive.
    """

    times: Array
    values: Array
    std: Array

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.times.shape != self.values.shape[:1]:
            raise ValueError(f"values {self.values.shape} do not match times {self.times.shape}")
        if self.std.shape not in (self.values.shape, self.values.shape[1:]):
            raise ValueError(f"std {self.std.shape} does not match values {self.values.shape}")
        if not (np.all(np.diff(self.times, prepend=0.0) > 0) and np.all(self.std > 0)):
            raise ValueError("times must increase from zero and std must be positive")


@dataclass(frozen=True)
class SequentialSettings:
    """How the loop treats the ensemble of ``scheme``; ``localisation`` only with a filter (lag 0).

    ``rotation``: every analysis is turned by a random mean-preserving rotation (:func:`~en4dvar.linalg.rotate`).
    """

    scheme: SequentialScheme
    inflation: Inflation = NO_INFLATION
    rotation: bool = False
    localisation: Localisation | None = None
    min_active_fraction: float = 0.5

    def __post_init__(self) -> None:
        if self.localisation is not None and (self.scheme.lag > 0 or self.scheme.max_iterations > 1):
            raise ValueError("localisation needs a filter that does not iterate (etkf)")


@dataclass(frozen=True)
class Moments:
    """Ensemble mean and standard deviation (K, n_state) at the observation times; NaN where there is none."""

    mean: Array
    std: Array

    @classmethod
    def empty(cls, cycles: int, size: int) -> Moments:
        return cls(np.full((cycles, size), np.nan), np.full((cycles, size), np.nan))

    def put(self, cycle: int, ensemble: Array, scale: float = 1.0) -> None:
        mean, anomalies = centre(ensemble)
        self.mean[cycle] = mean
        self.std[cycle] = scale * np.sqrt(np.einsum("ij,ij->j", anomalies, anomalies) / (len(ensemble) - 1))


@dataclass(frozen=True)
class SequentialResult:
    """What a run leaves: moments of forecast, analysis (by y_1…y_k) and smoothed ensemble (by y_1…y_{k+L}).

    The last L smoothed rows, and all of a filter's, are NaN. ``iterations`` (K,) forecasts of the window,
    ``members`` (N', n) the final ensemble, ``failures`` the reasons of the members lost.
    """

    forecast: Moments
    analysis: Moments
    smoothed: Moments
    iterations: Array
    members: Array
    failures: tuple[str, ...] = ()
    forward_runs: int = 0


def run_sequential(
    model: ForwardModel,
    observables: Sequence[Observable],
    members: Array,
    series: Series,
    settings: SequentialSettings,
    seed: int = 0,
    executor: Executor | None = None,
    on_cycle: Callable[[int], None] | None = None,
) -> SequentialResult:
    """Assimilate ``series`` into ``members`` (N, n_state), the ensemble at time zero.

    The operators of ``observables`` act at each instant by itself; their outputs side by side are the p predictions.
    ``seed`` drives the rotations. Raises :class:`TooFewMembersError`.
    """
    with one_blas_thread():
        loop = _Loop(model, tuple(observables), members, series, settings, seed, executor or SerialExecutor())
        for cycle in range(len(series.times)):
            loop.cycle(cycle)
            if on_cycle is not None:
                on_cycle(cycle)
        return loop.result()


class _Started(ForwardModel):
    """A model seen from a later time zero, member by member."""

    def __init__(self, model: ForwardModel, start: float):
        self.model, self.start = model, start
        self.parameters, self.layout, self.observables = model.parameters, model.layout, model.observables

    def initial_state(self, theta: object) -> Array:
        raise NotImplementedError("the ensemble is already under way")

    def step(self, x: Array, t0: float, t1: float) -> Array:
        return self.model.step(x, self.start + t0, self.start + t1)


def propagate(
    model: ForwardModel, states: Array, start: float, times: Array, executor: Executor
) -> list[Trajectory | Failure]:
    """Members (N, n_state) from ``start`` to ``times`` (later than ``start``), in order."""
    mover = model if model.autonomous or start == 0 else _Started(model, start)
    return executor.trajectories(mover, states, times - start)


def predictions(observables: Sequence[Observable], trajectory: Trajectory) -> Array:
    """(K, p): outputs (K,) or (K, q) of the operators along a trajectory, side by side."""
    return np.column_stack([observable.operator(trajectory) for observable in observables])


@dataclass
class _Loop:
    model: ForwardModel
    observables: tuple[Observable, ...]
    ensemble: Array  # (N, n) at the start of the window
    series: Series
    settings: SequentialSettings
    seed: int
    executor: Executor
    start: int = 0  # of the window: 0 is time zero, k the k-th observation time
    forward_runs: int = 0
    failures: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.initial_members = len(self.ensemble)
        self.rng = member_stream(self.seed, "rotation")
        self.times = np.concatenate([[0.0], self.series.times])
        cycles, size = len(self.series.times), self.ensemble.shape[1]
        self.before, self.after, self.smooth = (Moments.empty(cycles, size) for _ in range(3))
        self.iterations = np.zeros(cycles)

    def result(self) -> SequentialResult:
        return SequentialResult(
            self.before,
            self.after,
            self.smooth,
            self.iterations,
            self.ensemble,
            tuple(self.failures),
            self.forward_runs,
        )

    def cycle(self, k: int) -> None:
        """Assimilate observation k (index k + 1 of ``times``) and move the window to its next start."""
        newest, lag = k + 1, self.settings.scheme.lag
        if lag == 0:
            (self.ensemble,) = self.run(self.ensemble, [newest])
            self.start = newest
        posterior = self.window(k)
        mean, anomalies = centre(posterior)
        if self.settings.rotation:
            anomalies = rotate(anomalies, self.rng)
        self.ensemble = mean + self.settings.inflation.apply(self.ensemble, anomalies)
        next_start = max(self.start, newest + 1 - lag) if lag else newest
        if 0 < self.start < next_start:
            self.smooth.put(self.start - 1, self.ensemble)
        at = self.run(self.ensemble, sorted({next_start, newest}))
        self.after.put(k, at[-1])
        self.ensemble, self.start = at[0], next_start

    def window(self, k: int) -> Array:
        """The posterior ensemble at the start of the window; members lost on the way are dropped from the prior."""
        while True:
            posterior, failed = self.iterate(k)
            if posterior is not None:
                return posterior
            self.drop(failed)
            self.ensemble = self.ensemble[[not reason for reason in failed]]

    def iterate(self, k: int) -> tuple[Array | None, list[str]]:
        scheme, newest, n_members = self.settings.scheme, k + 1, len(self.ensemble)
        mean, anomalies = centre(self.ensemble)
        weights = scheme.init(n_members)
        for iteration in range(1, scheme.max_iterations + 1):
            spread = scheme.spread(weights)
            states, failed = self.forecast(mean + (weights.w + spread) @ anomalies, [newest])
            if any(failed):
                return None, failed
            if iteration == 1:  # here the scheme's spread is a multiple of I
                self.before.put(k, states[-1], 1 / spread[0, 0])
            self.iterations[k] = iteration
            predicted = self.predict(states[-1], newest)
            if not np.isfinite(predicted).all():
                return None, ["" if row.all() else "non-finite prediction" for row in np.isfinite(predicted)]
            evaluation = self.evaluate(k, weights, predicted)
            if self.settings.localisation is not None:
                return self.settings.localisation.analysis(self.ensemble, evaluation), []
            step = scheme.step(weights, evaluation)
            weights = Weights(weights.w + step.direction, step.transform)
            if step.norm <= scheme.tolerance:
                break
        return apply_weights(self.ensemble, weights.rows), []

    def evaluate(self, k: int, weights: Weights, predictions: Array) -> Evaluation:
        std = self.series.std if self.series.std.ndim == 1 else self.series.std[k]
        reference, spread = self.settings.scheme.linearise(weights, predictions)
        return Evaluation((self.series.values[k] - reference) / std, (spread / std).T)

    def predict(self, states: Array, index: int) -> Array:
        """Predictions (N, p): H acts at one instant, so members stand where it expects times."""
        return predictions(
            self.observables, Trajectory(np.full(len(states), self.times[index]), states, self.model.layout)
        )

    def forecast(self, states: Array, indices: Sequence[int]) -> tuple[list[Array], list[str]]:
        """Members at the start of the window → ensembles (N, n) at times of ``indices``, and reasons (N,)."""
        ahead = [i for i in indices if i > self.start]
        if not ahead:
            return [states] * len(indices), []
        self.forward_runs += len(states)
        outcomes = propagate(self.model, states, self.times[self.start], self.times[ahead], self.executor)
        failed = [o.reason if isinstance(o, Failure) else "" for o in outcomes]
        if any(failed):
            return [], failed
        paths = np.array([o.states for o in outcomes if isinstance(o, Trajectory)])
        return [states] * (len(indices) - len(ahead)) + [paths[:, j] for j in range(len(ahead))], failed

    def run(self, states: Array, indices: Sequence[int]) -> list[Array]:
        """As :meth:`forecast`, again with the survivors where members are lost."""
        while True:
            ensembles, failed = self.forecast(states, indices)
            if ensembles:
                return ensembles
            self.drop(failed)
            states = states[[not reason for reason in failed]]

    def drop(self, failed: Sequence[str]) -> None:
        self.failures += [reason for reason in failed if reason]
        alive = self.initial_members - len(self.failures)
        needed = max(2, int(np.ceil(self.settings.min_active_fraction * self.initial_members)))
        if alive < needed:
            raise TooFewMembersError(
                f"{len(self.failures)} of {self.initial_members} members failed, at least {needed} must survive; "
                f"the last: {self.failures[-1]}"
            )
