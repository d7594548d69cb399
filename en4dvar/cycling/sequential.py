"""Sequential assimilation of a long series: the loop around ETKF and IEnKS.

The ensemble stands at the start of a window of ``lag`` observation times. A cycle runs it to the newest observation,
iterates the scheme's weights at the start, inflates, and moves the window on by one (shift 1); a filter is a window
without length. The control vector is the whole state, parameters included.

A member that cannot be integrated is dropped and the window done again with the survivors, so that the statistics stay
those of one ensemble; its reason is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from en4dvar.batch import Batch
from en4dvar.cycling.moments import Moments, MomentsRecorder
from en4dvar.cycling.rotation import Rotations, rotate
from en4dvar.cycling.series import Series
from en4dvar.ensemble.linalg import centre
from en4dvar.errors import TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.forward import Failure, ForwardModel, Observable, Trajectory
from en4dvar.schemes import Evaluation, FullStep, Weights
from en4dvar.schemes.inflation import Inflation
from en4dvar.schemes.localisation import Localisation
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
    def step(self, weights: Weights, evaluation: Evaluation) -> FullStep: ...


@dataclass(frozen=True)
class SequentialSettings:
    """How the loop treats the ensemble of ``scheme``; ``localisation`` only with a filter (lag 0).

    ``rotation``: every analysis is turned by a random mean-preserving rotation (:mod:`en4dvar.cycling.rotation`).
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
class SequentialState:
    """All that the rest of a run depends on, besides its arguments, and what it has found so far.

    ``cycle`` is the next one; ``ensemble`` (N', n_state) stands at ``start`` (0: time zero, k: observation time k).
    Random numbers are drawn by cycle, so that no generator has a state. Rows of the arrays are the cycles done.
    """

    cycle: int
    start: int
    ensemble: Array
    forecast: Moments
    analysis: Moments
    smoothed: Moments
    iterations: Array
    forward_runs: int
    failures: tuple[str, ...] = ()


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
    resume: SequentialState | None = None,
    keep: Callable[[Callable[[], SequentialState]], None] | None = None,
) -> SequentialResult:
    """Assimilate ``series`` into ``members`` (N, n_state), the ensemble at time zero.

    The operators of ``observables`` act at each instant by itself; their outputs side by side are the p predictions.

    Parameters
    ----------
    seed: of the rotations. on_cycle: called with the number of each cycle, from 0.
    resume: where an earlier call with the same arguments was interrupted; the result has the same bits as without.
    keep: called after each cycle with a function that gives the state to resume from.

    Raises
    ------
    TooFewMembersError: the ensemble is lost. ValueError: localisation with correlated errors.
    """
    if settings.localisation is not None and series.correlation is not None:
        raise ValueError("localisation needs observations with independent errors")
    with one_blas_thread():
        loop = _Loop(model, tuple(observables), members, series, settings, seed, executor or SerialExecutor(), resume)
        for cycle in range(resume.cycle if resume else 0, len(series.times)):
            loop.cycle(cycle)
            if on_cycle is not None:
                on_cycle(cycle)
            if keep is not None:
                keep(loop.state)
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
) -> tuple[Array, list[str]]:
    """Members (N, n_state) from ``start`` to later ``times`` (K,): (N, K, n_state) and no reasons, or reasons (N,)."""
    mover = model if model.autonomous or start == 0 else _Started(model, start)
    outcomes = executor.trajectories(mover, states, times - start)
    if isinstance(outcomes, Batch) and outcomes.whole:
        return outcomes.states, []
    failed = [outcome.reason if isinstance(outcome, Failure) else "" for outcome in outcomes]
    if any(failed):
        return np.empty(0), failed
    return np.array([outcome.states for outcome in outcomes if isinstance(outcome, Trajectory)]), []


def predictions(observables: Sequence[Observable], trajectory: Trajectory) -> Array:
    """(K, p): outputs (K,) or (K, q) of the operators along a trajectory, side by side."""
    outputs = [observable.operator(trajectory) for observable in observables]
    return outputs[0] if len(outputs) == 1 and outputs[0].ndim == 2 else np.column_stack(outputs)


class _Loop:
    """The ensemble (N, n) at the start of the window and what has been recorded."""

    def __init__(
        self,
        model: ForwardModel,
        observables: tuple[Observable, ...],
        members: Array,
        series: Series,
        settings: SequentialSettings,
        seed: int,
        executor: Executor,
        resume: SequentialState | None,
    ):
        self.model, self.observables, self.executor = model, observables, executor
        self.series, self.settings, self.scheme = series, settings, settings.scheme
        self.initial_members, size = members.shape
        self.rotations = Rotations(seed, self.initial_members) if settings.rotation else None
        self.times = [0.0, *series.times.tolist()]
        cycles = len(series.times)
        self.iterations = np.zeros(cycles)
        self.ensemble, self.start, self.forward_runs = members, 0, 0  # start: k is the k-th observation time
        self.failures: list[str] = []
        earlier: tuple[Moments | None, ...] = (None, None, None)
        if resume is not None:
            self.ensemble, self.start, self.forward_runs = resume.ensemble, resume.start, resume.forward_runs
            self.failures = list(resume.failures)
            self.iterations[: resume.cycle] = resume.iterations
            earlier = resume.forecast, resume.analysis, resume.smoothed
        self.before, self.after, self.smooth = (MomentsRecorder(cycles, size, moments) for moments in earlier)
        self.cycles_done = resume.cycle if resume else 0

    def state(self) -> SequentialState:
        done = self.cycles_done
        before, after, smooth = (recorder.moments().until(done) for recorder in (self.before, self.after, self.smooth))
        return SequentialState(
            done, self.start, self.ensemble, before, after, smooth, self.iterations[:done].copy(),
            self.forward_runs, tuple(self.failures),
        )  # fmt: skip

    def result(self) -> SequentialResult:
        before, after, smooth = (recorder.moments() for recorder in (self.before, self.after, self.smooth))
        return SequentialResult(
            before, after, smooth, self.iterations, self.ensemble, tuple(self.failures), self.forward_runs
        )

    def cycle(self, k: int) -> None:
        """Assimilate observation k (index k + 1 of ``times``) and move the window to its next start."""
        newest, lag = k + 1, self.scheme.lag
        if lag == 0:
            (self.ensemble,) = self.run(self.ensemble, [newest])
            self.start = newest
        mean, anomalies = self.window(k)
        if self.rotations is not None:
            anomalies = rotate(anomalies, self.rotations.of_cycle(k, len(anomalies)))
        self.ensemble = mean + self.settings.inflation.apply(self.ensemble, anomalies)
        next_start = max(self.start, newest + 1 - lag) if lag else newest
        if 0 < self.start < next_start:
            self.smooth.put(self.start - 1, self.ensemble)
        at = self.run(self.ensemble, sorted({next_start, newest}))
        self.after.put(k, at[-1])
        self.ensemble, self.start = at[0], next_start
        self.cycles_done = newest

    def window(self, k: int) -> tuple[Array, Array]:
        """Mean and anomalies of the posterior at the start of the window; members lost are dropped from the prior."""
        while True:
            posterior, failed = self.iterate(k)
            if posterior is not None:
                return posterior
            self.drop(failed)
            self.ensemble = self.ensemble[[not reason for reason in failed]]

    def iterate(self, k: int) -> tuple[tuple[Array, Array] | None, list[str]]:
        scheme, newest = self.scheme, k + 1
        mean, anomalies = centre(self.ensemble)
        weights = scheme.init(len(anomalies))
        for iteration in range(1, scheme.max_iterations + 1):
            spread = scheme.spread(weights)
            if iteration == 1:  # here w = 0 and the scheme's spread is a multiple of I
                width = float(spread[0, 0])
                states, failed = self.forecast(self.ensemble if width == 1 else mean + width * anomalies, [newest])
            else:
                states, failed = self.forecast(mean + (weights.w + spread) @ anomalies, [newest])
            if failed:
                return None, failed
            if iteration == 1:
                self.before.put(k, states[-1], 1 / width)
            self.iterations[k] = iteration
            predicted = self.predict(states[-1], newest)
            if not np.isfinite(predicted).all():
                return None, ["" if row.all() else "non-finite prediction" for row in np.isfinite(predicted)]
            evaluation = Evaluation(*self.series.whiten(k, *scheme.linearise(weights, predicted)))
            if self.settings.localisation is not None:
                return centre(self.settings.localisation.analysis(self.ensemble, evaluation)), []
            step = scheme.step(weights, evaluation)
            weights = step.weights
            if step.norm <= scheme.tolerance:
                break
        return (mean + weights.w @ anomalies, weights.T @ anomalies), []

    def predict(self, states: Array, index: int) -> Array:
        """Predictions (N, p): H acts at one instant, so members stand where it expects times."""
        return predictions(
            self.observables, Trajectory(np.full(len(states), self.times[index]), states, self.model.layout)
        )

    def forecast(self, states: Array, indices: Sequence[int]) -> tuple[list[Array], list[str]]:
        """Members at the start of the window → ensembles (N, n) at times of ``indices``, or reasons (N,)."""
        ahead = [i for i in indices if i > self.start]
        if not ahead:
            return [states] * len(indices), []
        self.forward_runs += len(states)
        times = np.array([self.times[i] for i in ahead])
        paths, failed = propagate(self.model, states, self.times[self.start], times, self.executor)
        if failed:
            return [], failed
        return [states] * (len(indices) - len(ahead)) + [paths[:, j] for j in range(len(ahead))], []

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
