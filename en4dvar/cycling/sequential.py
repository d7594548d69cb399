"""Sequential assimilation of a long series, cycle by cycle: filters, and smoothers on a sliding window.

The ensemble stands at the start of a window of ``lag`` observation times. A cycle runs it to the newest observation,
iterates the scheme's weights at the start, inflates, and moves the window on by one (shift 1); a filter is a window
without length. The control vector is the whole state, parameters included.

A member that cannot be integrated is dropped and the window done again with the survivors, so that the statistics stay
those of one ensemble; its reason is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.batch import Batch
from en4dvar.cycling.moments import Moments, MomentsRecorder
from en4dvar.cycling.rotation import Rotations, rotate
from en4dvar.cycling.series import CycleSeries
from en4dvar.cycling.smoothers import EnKS, Smoother
from en4dvar.descent.loop import iterate
from en4dvar.ensemble.linalg import centre
from en4dvar.ensemble.repeat import check_repeats
from en4dvar.errors import TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.forward import Failure, ForwardModel, Observable, Trajectory
from en4dvar.prior import member_stream
from en4dvar.schemes.base import Evaluation, GaussNewtonStep, Runs, Scheme, Step, Weights
from en4dvar.schemes.etkf import ETKF
from en4dvar.schemes.inflation import Inflation
from en4dvar.schemes.localisation import LocalDescent, Localisation
from en4dvar.schemes.particle_filter import ParticleFilter
from en4dvar.state import Array

NO_INFLATION = Inflation()


@dataclass(frozen=True)
class SequentialSettings:
    """How the loop treats the ensemble of ``scheme``.

    ``rotation``: every analysis is turned by a random mean-preserving rotation (:mod:`en4dvar.cycling.rotation`).
    ``stochastic_model``: a model that gives other numbers when a member is run again is accepted.
    ``smoother``: what goes behind a filter (:mod:`en4dvar.cycling.smoothers`).

    Raises
    ------
    ValueError: a smoother behind what is no cycled filter, localisation of what has no local analysis.
    """

    scheme: Scheme
    inflation: Inflation = NO_INFLATION
    rotation: bool = False
    localisation: Localisation | None = None
    min_active_fraction: float = 0.5
    stochastic_model: bool = False
    smoother: Smoother | None = None

    def __post_init__(self) -> None:
        if self.smoother and (self.scheme.lag or not self.scheme.cycled):
            raise ValueError("a smoother goes behind a filter that is cycled, not behind ienks or a baseline")
        if self.localisation and isinstance(self.smoother, EnKS):
            raise ValueError("enks needs the weights of one analysis for all of the state; with localisation use enrts")
        if self.localisation and isinstance(self.scheme, ParticleFilter):
            raise ValueError("particles survive as a whole: the particle filter takes no localisation")


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
    effective: Array
    forward_runs: int
    failures: tuple[str, ...] = ()
    trail: tuple[Array, ...] = ()


@dataclass(frozen=True)
class SequentialResult:
    """What a run leaves: moments of forecast, analysis (by y_1…y_k) and smoothed ensemble (by y_1…y_{k+L}).

    The last L smoothed rows of the IEnKS, and all of a filter without a smoother, are NaN. ``iterations`` (K,)
    forecasts of the window, ``effective`` (K,) members that the weights of a particle filter leave (NaN: all),
    ``members`` (N', n) the final ensemble, ``failures`` the reasons of the members lost.
    """

    forecast: Moments
    analysis: Moments
    smoothed: Moments
    iterations: Array
    effective: Array
    members: Array
    failures: tuple[str, ...] = ()
    forward_runs: int = 0


def run_sequential(
    model: ForwardModel,
    observables: Sequence[Observable],
    members: Array,
    series: CycleSeries,
    settings: SequentialSettings,
    seed: int = 0,
    executor: Executor | None = None,
    on_cycle: Callable[[int], None] | None = None,
    resume: SequentialState | None = None,
    keep: Callable[[Callable[[], SequentialState]], None] | None = None,
    truth: Array | None = None,
) -> SequentialResult:
    """Assimilate ``series`` into ``members`` (N, n_state), the ensemble at time zero.

    The operators of ``observables`` act at each instant by itself; their outputs side by side are the p predictions.

    Parameters
    ----------
    seed: of the rotations. on_cycle: called with the number of each cycle, from 0.
    resume: where an earlier call with the same arguments was interrupted; the result has the same bits as without.
    keep: called after each cycle with a function that gives the state to resume from.
    truth: (K, n_state) in a twin experiment, for its rank among the members.

    Raises
    ------
    TooFewMembersError: the ensemble is lost. ValueError: localisation with correlated errors. ConfigError: the model
        gives other numbers when a member is run again.
    """
    if settings.localisation is not None and series.correlation is not None:
        raise ValueError("localisation needs observations with independent errors")
    with one_blas_thread():
        run = _Run(
            model, tuple(observables), members, series, settings, seed, executor or SerialExecutor(), resume, truth
        )
        if not settings.stochastic_model:
            run.check_repeats()
        for cycle in range(resume.cycle if resume else 0, len(series.times)):
            run.cycle(cycle)
            if on_cycle is not None:
                on_cycle(cycle)
            if keep is not None:
                keep(run.state)
        return run.result()


class _Started(ForwardModel):
    """A model seen from a later time zero, member by member."""

    def __init__(self, model: ForwardModel, start: float):
        self.model, self.start = model, start
        self.parameters, self.layout, self.observables = model.parameters, model.layout, model.observables

    def initial_state(self, theta: object) -> Array:
        raise NotImplementedError("the ensemble is already under way")

    def step(self, x: Array, t0: float, t1: float) -> Array:
        return self.model.step(x, self.start + t0, self.start + t1)


class MembersLost(Exception):
    """Members that failed: ``reasons`` (N,), "" for the others."""

    def __init__(self, reasons: list[str]):
        self.reasons = reasons


def propagate(model: ForwardModel, states: Array, start: float, times: Array, executor: Executor) -> Array:
    """Members (N, n_state) from ``start`` to later ``times`` (K,): (N, K, n_state). Raises :class:`MembersLost`."""
    mover = model if model.autonomous or start == 0 else _Started(model, start)
    outcomes = executor.trajectories(mover, states, times - start)
    if isinstance(outcomes, Batch) and outcomes.whole:
        return outcomes.states
    reasons = [outcome.reason if isinstance(outcome, Failure) else "" for outcome in outcomes]
    if any(reasons):
        raise MembersLost(reasons)
    return np.array([outcome.states for outcome in outcomes if isinstance(outcome, Trajectory)])


def predictions(observables: Sequence[Observable], trajectory: Trajectory) -> Array:
    """(K, p): outputs (K,) or (K, q) of the operators along a trajectory, side by side."""
    outputs = [observable.operator(trajectory) for observable in observables]
    return outputs[0] if len(outputs) == 1 and outputs[0].ndim == 2 else np.column_stack(outputs)


class _Run:
    """The ensemble (N, n) at the start of the window and what has been recorded."""

    def __init__(
        self,
        model: ForwardModel,
        observables: tuple[Observable, ...],
        members: Array,
        series: CycleSeries,
        settings: SequentialSettings,
        seed: int,
        executor: Executor,
        resume: SequentialState | None,
        truth: Array | None,
    ):
        self.model, self.observables, self.seed, self.executor = model, observables, seed, executor
        self.series, self.settings, self.scheme = series, settings, settings.scheme
        self.initial_members, size = members.shape
        self.rotations = Rotations(seed, self.initial_members) if settings.rotation else None
        self.times = [0.0, *series.times.tolist()]
        cycles = len(series.times)
        self.iterations, self.effective = np.zeros(cycles), np.full(cycles, np.nan)
        self.trail: list[Array] = []
        self.ensemble, self.start, self.forward_runs = members, 0, 0  # start: k is the k-th observation time
        self.failures: list[str] = []
        earlier: tuple[Moments | None, ...] = (None, None, None)
        if resume is not None:
            self.ensemble, self.start, self.forward_runs = resume.ensemble, resume.start, resume.forward_runs
            self.failures = list(resume.failures)
            self.iterations[: resume.cycle], self.effective[: resume.cycle] = resume.iterations, resume.effective
            self.trail = list(resume.trail)
            earlier = resume.forecast, resume.analysis, resume.smoothed
        self.before, self.after, self.smooth = (MomentsRecorder(cycles, size, moments, truth) for moments in earlier)
        self.cycles_done = resume.cycle if resume else 0

    def state(self) -> SequentialState:
        done = self.cycles_done
        before, after, smooth = (recorder.moments().until(done) for recorder in (self.before, self.after, self.smooth))
        return SequentialState(
            done, self.start, self.ensemble, before, after, smooth, self.iterations[:done].copy(),
            self.effective[:done].copy(), self.forward_runs, tuple(self.failures), tuple(self.trail),
        )  # fmt: skip

    def result(self) -> SequentialResult:
        if self.settings.smoother is not None:
            self.settings.smoother.ended(self.trail, len(self.iterations) - 1, self.smooth.put)
        before, after, smooth = (recorder.moments() for recorder in (self.before, self.after, self.smooth))
        return SequentialResult(
            before, after, smooth, self.iterations, self.effective, self.ensemble, tuple(self.failures),
            self.forward_runs,
        )  # fmt: skip

    def cycle(self, k: int) -> None:
        """Assimilate observation k (index k + 1 of ``times``) and move the window to its next start."""
        newest, lag = k + 1, self.scheme.lag
        if lag == 0:
            (self.ensemble,) = self.run(self.ensemble, [newest])
            self.start = newest
        mean, anomalies, weights = self.analyse(k)
        transform = weights.T
        if self.rotations is not None:
            turned = self.rotations.of_cycle(k, len(anomalies))
            anomalies = rotate(anomalies, turned)
            if self.settings.smoother is not None:
                transform = rotate(transform, turned)
        forecast = self.ensemble
        self.ensemble = mean + self.settings.inflation.apply(forecast, anomalies)
        if self.settings.smoother is not None:
            rows = weights.w + transform
            self.settings.smoother.passed(self.trail, k, forecast, mean + anomalies, rows, self.smooth.put)
        next_start = max(self.start, newest + 1 - lag) if lag else newest
        if 0 < self.start < next_start:
            self.smooth.put(self.start - 1, self.ensemble)
        at = self.run(self.ensemble, sorted({next_start, newest}))
        self.after.put(k, at[-1])
        self.ensemble, self.start = at[0] if self.scheme.cycled else forecast, next_start
        self.cycles_done = newest

    def check_repeats(self) -> None:
        """Two members, over the first interval, twice: in one order and in the other; no cycle uses these runs.

        Raises :class:`ConfigError`: they differ.
        """
        if self.start + 1 >= len(self.times):
            return
        start, end = self.times[self.start : self.start + 2]

        def run(members: list[int]) -> tuple[Array, list[str]]:
            states, failures = np.full((len(members), self.ensemble.shape[1]), np.nan), [""] * len(members)
            for row, i in enumerate(members):  # one by one: where one is lost, the other is not
                try:
                    states[row] = propagate(self.model, self.ensemble[[i]], start, np.array([end]), self.executor)[0, 0]
                except MembersLost as lost:
                    (failures[row],) = lost.reasons
            return states, failures

        both = [0, len(self.ensemble) - 1]
        states, failures = run(both)
        check_repeats(self.model, states, failures, lambda again: run([both[i] for i in again]))

    def analyse(self, k: int) -> tuple[Array, Array, Weights]:
        """Mean and anomalies of the posterior at the start of the window; members lost are dropped from the prior.

        The weights are those of the analysis where it is not local.
        """
        while True:
            window = _CycleWindow(self, k)
            descent = _Cycle(Weights.prior(len(self.ensemble)))
            try:
                iterate(window, self.scheme, [descent])
            except MembersLost as lost:
                self.drop(lost.reasons)
                self.ensemble = self.ensemble[[not reason for reason in lost.reasons]]
                continue
            weights = descent.weights
            if window.localised is not None:
                return *centre(window.localised), weights
            return window.mean + weights.w @ window.anomalies, weights.T @ window.anomalies, weights

    def predict(self, states: Array, index: int) -> Array:
        """Predictions (N, p): H acts at one instant, so members stand where it expects times."""
        return predictions(
            self.observables, Trajectory(np.full(len(states), self.times[index]), states, self.model.layout)
        )

    def forecast(self, states: Array, indices: Sequence[int]) -> list[Array]:
        """Members at the start of the window → ensembles (N, n) at times of ``indices``, or :class:`MembersLost`."""
        ahead = [i for i in indices if i > self.start]
        if not ahead:
            return [states] * len(indices)
        self.forward_runs += len(states)
        times = np.array([self.times[i] for i in ahead])
        paths = propagate(self.model, states, self.times[self.start], times, self.executor)
        return [states] * (len(indices) - len(ahead)) + [paths[:, j] for j in range(len(ahead))]

    def run(self, states: Array, indices: Sequence[int]) -> list[Array]:
        """As :meth:`forecast`, again with the survivors where members are lost."""
        while True:
            try:
                return self.forecast(states, indices)
            except MembersLost as lost:
                self.drop(lost.reasons)
                states = states[[not reason for reason in lost.reasons]]

    def drop(self, failed: Sequence[str]) -> None:
        self.trail = [ensembles[..., [not reason for reason in failed], :] for ensembles in self.trail]
        self.failures += [reason for reason in failed if reason]
        alive = self.initial_members - len(self.failures)
        needed = max(2, int(np.ceil(self.settings.min_active_fraction * self.initial_members)))
        if alive < needed:
            raise TooFewMembersError(
                f"{len(self.failures)} of {self.initial_members} members failed, at least {needed} must survive; "
                f"the last: {self.failures[-1]}"
            )


@dataclass
class _Cycle:
    """The descent of one cycle."""

    weights: Weights
    iteration: int = 0
    step: Step | GaussNewtonStep | None = None
    ended: bool = False


class _CycleWindow:
    """The window of one cycle: the members at its start, its newest observation."""

    def __init__(self, run: _Run, k: int):
        self.of, self.k = run, k
        self.mean, self.anomalies = centre(run.ensemble)
        self.localised: Array | None = None
        local = run.settings.localisation
        self.local = LocalDescent(local, run.ensemble) if local and not isinstance(run.scheme, ETKF) else None
        self.runs: Runs | None = None

    def begin(self, going: Sequence[_Cycle]) -> None:
        pass  # a cycle is short: what is kept is the ensemble between two

    def run(self, scheme: Scheme, going: Sequence[_Cycle]) -> list[Runs | None]:
        (descent,) = going
        rows = scheme.members(descent.weights)
        if descent.iteration == 0:  # here w = 0 and the members are those of the window, or close to their mean
            width = float(rows[0, 0])
            members = self.of.ensemble if width == 1 else self.mean + width * self.anomalies
        elif self.local:
            members = self.local.members(scheme.members)
        else:
            members = self.mean + rows @ self.anomalies
        (states,) = self.of.forecast(members, [self.k + 1])
        if descent.iteration == 0:
            self.of.before.put(self.k, states, 1 / width)
        predicted = self.of.predict(states, self.k + 1)
        if not np.isfinite(predicted).all():
            raise MembersLost(["" if row.all() else "non-finite prediction" for row in np.isfinite(predicted)])
        self.runs = Runs(predicted)
        return [self.runs]

    def whiten(self, scheme: Scheme, descent: _Cycle, reference: Array, anomalies: Array) -> Evaluation:
        evaluation = Evaluation(*self.of.series.whiten(self.k, reference, anomalies))
        if self.of.settings.localisation is not None and self.local is None:
            self.localised = self.of.settings.localisation.analysis(scheme, self.of.ensemble, evaluation, self.draw)
        return evaluation

    def draw(self, purpose: str, columns: int | None = None) -> Array:
        size = columns or self.of.series.values.shape[1]
        streams = (member_stream(self.of.seed, f"{purpose}, cycle {self.k}", i) for i in range(len(self.anomalies)))
        return np.stack([stream.standard_normal(size) for stream in streams])

    def move(self, scheme: Scheme, going: Sequence[_Cycle]) -> None:
        (descent,) = going
        assert descent.step is not None
        if self.local is None:
            descent.weights = descent.step.weights
        else:
            descent.step = Step(descent.weights, self._local_step(scheme, self.local, descent.iteration))
        descent.ended = scheme.done(descent.iteration, descent.step)
        if self.local and descent.ended:
            self.localised = self.local.members(lambda weights: weights.rows)
        descent.iteration += 1
        self.of.iterations[self.k] = descent.iteration
        self.of.effective[self.k] = getattr(descent.step, "effective", np.nan)

    def _local_step(self, scheme: Scheme, local: LocalDescent, iteration: int) -> float:
        """The blocks' own steps from the same runs, of which the largest tells when a cycle ends."""
        assert self.runs is not None

        def whiten(reference: Array, anomalies: Array) -> Evaluation:
            return Evaluation(*self.of.series.whiten(self.k, reference, anomalies))

        return local.advance(scheme, self.runs, whiten, iteration, self.draw)
