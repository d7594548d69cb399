"""Sequential assimilation of a long series, cycle by cycle: filters, and smoothers on a sliding window.

The ensemble stands at the start of a window that reaches ``lag`` observation times ahead. A cycle runs it to the newest
observations, iterates the scheme's weights at the start, inflates, and moves the window on by ``shift`` times; a filter
is a window without length. The control vector is the whole state, parameters included, and with a model error what it
changed in the window.

With ``mda_weights`` an observation is assimilated in every window that holds it, by a share each time. What a cycle
says of the states is then that of a second analysis beside it, with the shares that are still missing.

A member that cannot be integrated is dropped and the window done again with the survivors, so that the statistics stay
those of one ensemble; its reason is kept.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from en4dvar.descent.loop import minimise
from en4dvar.ensemble.linalg import centre
from en4dvar.ensemble.members import EVERYONE, Rows
from en4dvar.ensemble.repeat import check_repeats
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.priors.prior import member_stream
from en4dvar.schemes.base import Weights
from en4dvar.series.model_error import fresh_noise
from en4dvar.series.moments import InnovationRecorder, Moments, MomentsRecorder, SequentialState
from en4dvar.series.series import CycleSeries as CycleSeries
from en4dvar.series.settings import SequentialSettings as SequentialSettings
from en4dvar.series.window import Ahead, CycleDescent, CycleWindow, Flow, MembersLost, Share

R = TypeVar("R")
REFLECTIONS = 4  # of a rotation
BYSTANDERS = 16  # constants beside the state that nothing depends on
BLOCK = 64  # rotations drawn together; part of the random numbers' definition


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
) -> SequentialState:
    """Assimilate ``series`` into ``members`` (N, n_state), the ensemble at time zero.

    The operators of ``observables`` act at each instant by itself; their outputs side by side are the p predictions.

    ``members``: in ``settings.coordinates``. ``seed``: of the rotations and model errors. ``on_cycle``: called with the
    index of the last observation time of each cycle, from 0. ``resume``: where an earlier call with the same arguments
    was interrupted; the result has the same bits as without. ``keep``: called after each cycle with a function that
    gives the state to resume from. ``truth``: (K, n_state) in a twin experiment, for its rank among the members.

    Raises TooFewMembersError: the ensemble is lost. ValueError: localisation with correlated errors. ConfigError: the
    model gives other numbers when a member is run again.
    """
    if settings.localisation is not None and series.correlation is not None:
        raise ValueError("localisation needs observations with independent errors")
    with one_blas_thread():
        times = [0.0, *series.times.tolist()]
        executor = executor or SerialExecutor()
        flow = Flow(model, tuple(observables), times, executor, settings.coordinates, settings.model_error)
        run = _Run(flow, members, series, settings, seed, resume, truth)
        if not settings.stochastic_model:
            run.check_repeats()
        while run.done < len(series.times):
            run.cycle()
            if on_cycle is not None:
                on_cycle(run.done - 1)
            if keep is not None:
                keep(run.state)
        return run.result()


class _Run:
    """The ensemble at the start of the window and what has been recorded."""

    def __init__(
        self,
        flow: Flow,
        members: Array,
        series: CycleSeries,
        settings: SequentialSettings,
        seed: int,
        resume: SequentialState | None,
        truth: Array | None,
    ):
        self.flow, self.error = flow, flow.error
        self.series, self.settings, self.scheme, self.seed = series, settings, settings.scheme, seed
        self.physical = settings.coordinates.to_physical
        self.initial_members, size = members.shape
        self.rotations = Rotations(seed, self.initial_members) if settings.rotation else None
        cycles = len(series.times)
        self.iterations, self.effective, self.left = np.zeros(cycles), np.full(cycles, np.nan), np.zeros(cycles)
        self.residuals = np.full(series.values.shape, np.nan)
        self.trail: list[Array] = []
        self.bystanders = np.empty((len(members), 0))
        if self.scheme.perturbs and settings.localisation is None:
            drawn = member_stream(seed, "bystanders").standard_normal((len(members), BYSTANDERS))
            drawn = fresh_noise(centre(members)[1], drawn)
            self.bystanders = drawn / drawn.std(axis=0, ddof=1)
        self.covariances: tuple[Array, ...] = ()  # (n, p) and (p, p), averages over the forecasts so far
        self.ensemble, self.start = members, 0  # start: k is the k-th observation time
        self.failures: list[str] = []
        self.kept: list[tuple[int, Array]] = []
        earlier: tuple[Moments | None, ...] = (None, None, None)
        self.done = 0
        if resume is not None:
            self.ensemble, self.start, self.flow.runs = resume.members, resume.start, resume.forward_runs
            self.failures, self.kept, self.done = list(resume.failures), list(resume.kept), resume.cycle
            self.iterations[: resume.cycle], self.effective[: resume.cycle] = resume.iterations, resume.effective
            self.trail, self.covariances = list(resume.trail), resume.covariances
            self.bystanders, self.residuals[: resume.cycle] = resume.bystanders, resume.residuals
            self.left[: resume.cycle] = resume.left
            earlier = resume.forecast, resume.analysis, resume.smoothed
        self.before, self.after, self.smooth = (MomentsRecorder(cycles, size, moments, truth) for moments in earlier)
        self.predicted = InnovationRecorder(series, truth is None, resume)

    def state(self) -> SequentialState:
        done = self.done  # the next forecast may be there already
        before, predicted = (recorder.moments().until(done + 1) for recorder in (self.before, self.predicted))
        after, smooth = (recorder.moments().until(done) for recorder in (self.after, self.smooth))
        ranks, evidence = (numbers[: done + 1].copy() for numbers in (self.predicted.ranks, self.predicted.evidence))
        return SequentialState(
            before, after, smooth, predicted, ranks, evidence, self.iterations[:done].copy(),
            self.effective[:done].copy(), self.ensemble, tuple(self.kept), tuple(self.failures), self.flow.runs, done,
            self.start, tuple(self.trail), self.covariances, self.bystanders,
            self.residuals[:done].copy(), self.left[:done].copy(),
        )  # fmt: skip

    def result(self) -> SequentialState:
        if self.settings.smoother is not None:
            self.settings.smoother.ended(self.trail, len(self.iterations) - 1, self.put_smoothed)
        return replace(self.state(), trail=(), covariances=())

    def cycle(self) -> None:
        """Assimilate the next observations and move the window to its next start."""
        first, newest = self.done + 1, min(self.done + self.scheme.shift, len(self.series.times))
        forecasts = self.forecast(first, newest)
        repeated = len(self.scheme.mda_weights) > 1
        batch = self.shares(newest) if repeated else [(i, 1.0) for i in range(first, newest + 1)]
        rows, window, descent = self.analyse(forecasts[-1], batch)
        forecasts = [each[rows] for each in forecasts]
        members = forecasts[-1]
        self.iterations[newest - 1] = descent.iteration
        self.left[newest - 1] = self.scheme.left(descent.step)
        self.effective[newest - 1] = getattr(descent.step, "effective", np.nan)
        mean, anomalies = window.posterior(descent)
        if self.scheme.climatological and window.localised is None:
            mean, anomalies = self.interpolated(window, newest)
        posterior = mean + anomalies if repeated else self.ensemble
        if self.rotations is not None:
            turned = self.rotations.of_cycle(newest - 1, len(anomalies))
            anomalies = rotate(anomalies, turned)
        inflated = self.settings.inflation.apply(members, anomalies)
        if self.bystanders.size:
            still, stood = centre(self.bystanders)
            by = descent.weights.T @ stood
            by = by if self.rotations is None else rotate(by, turned)
            self.bystanders = still + descent.weights.w @ stood + self.settings.inflation.apply(self.bystanders, by)
        if window.localisation is not None:
            kept = window.localisation.without_place
            inflated[:, kept] = anomalies[:, kept]
        if self.settings.smoother is not None:
            transform = descent.weights.dense
            if self.rotations is not None:
                transform = rotate(transform, turned)
            analyses = [mean + each for each in ((anomalies,) if inflated is anomalies else (anomalies, inflated))]
            weights = descent.weights.w + transform
            self.settings.smoother.passed(self.trail, newest - 1, forecasts, analyses, weights, self.put_smoothed)
        self.ensemble = mean + inflated
        if not repeated or first == 1:
            self.record_ahead([at for at in window.ahead if at.index >= first])
        complete = self.completed(posterior, newest) if repeated else self.ensemble
        self.advance(complete, first, newest, repeated)
        if not self.scheme.cycled:
            self.ensemble = members
        self.done = newest

    def forecast(self, first: int, newest: int) -> list[Array]:
        """The members to analyse; before them, where a square root takes their past, those that the model has made."""
        members = self.ensemble
        if self.scheme.lag == 0:
            _, (members,) = self.run(members, [newest])
            self.start = newest
            if self.error is None:
                return [members]
            if self.error.form == "square-root":
                return [members, self.error.widened(members, self.flow.elapsed(newest))]
            return [self.error.added(members, self.noise(members, newest), self.flow.elapsed(newest))]
        for index in range(first, newest + 1) if self.error else ():
            members = np.hstack([members, self.noise(members, index)])
        return [members]

    def noise(self, members: Array, index: int) -> Array:
        """Standard normal changes (N, q) of the state at the time of ``index``, independent of what members hold."""
        assert self.error is not None
        stream = member_stream(self.seed, "model error", index)
        draws = stream.standard_normal((self.initial_members, len(self.error.where)))
        return fresh_noise(centre(members)[1], draws[: len(members)])

    def shares(self, newest: int, missing: bool = False) -> Share:
        """Which observations count in the window that ends at the ``newest``, and how much; or how much is missing."""
        shares = np.array(self.scheme.mda_weights)
        if missing:
            shares = 1 - np.cumsum(shares)
        oldest = max(self.start, newest - len(shares)) + 1
        return [(i, float(shares[newest - i])) for i in range(oldest, newest + 1) if shares[newest - i] > 1e-12]

    def completed(self, posterior: Array, newest: int) -> Array:
        """The members after the shares of the observations that later windows will give."""
        missing = self.shares(newest, missing=True)
        if not missing:
            return posterior
        rows, window, descent = self.analyse(posterior, missing)
        self.ensemble = self.ensemble[rows]
        mean, anomalies = window.posterior(descent)
        return np.asarray(mean + anomalies)

    def advance(self, complete: Array, first: int, newest: int, repeated: bool) -> None:
        """Record what the ``complete`` members at the start say of later times, and move the ensemble on."""
        lag, last = self.scheme.lag, len(self.series.times)
        std = np.broadcast_to(self.series.std, self.series.values.shape)
        next_start = min(newest, max(self.start, newest + self.scheme.shift - lag)) if lag else newest
        smoothed = range(max(self.start, 1), next_start)
        if lag and newest == last and self.settings.to_end:
            smoothed = range(max(self.start, 1), last + 1)
        if self.start in smoothed:
            self.smooth.put(self.start - 1, self.physical(complete[:, : self.flow.size]))
        beyond = repeated and newest < last
        if beyond and self.error is not None:
            complete = np.hstack([complete, self.noise(complete, newest + 1)])
        wanted = {next_start, *smoothed, *range(first, newest + 1), *((newest + 1,) if beyond else ())}
        indices = sorted(i for i in wanted if i >= self.start)
        rows, states = self.run(complete, indices)
        self.ensemble = self.ensemble[rows]
        at = dict(zip(indices, states, strict=True))
        for index in range(first, newest + 1):
            self.after.put(index - 1, self.physical(at[index]))
            if lag:
                predicted = self.flow.predict(at[index], index).mean(axis=0)
                self.residuals[index - 1] = (self.series.values[index - 1] - predicted) / std[index - 1]
        for index in smoothed:
            if index > self.start:
                self.smooth.put(index - 1, self.physical(at[index]))
        if beyond:
            ahead = at[newest + 1]
            self.record_ahead([Ahead(newest + 1, ahead, self.flow.predict(ahead, newest + 1), 1.0)])
        every = self.settings.members_every
        if newest == last or (every and any(i % every == 0 for i in range(first, newest + 1))):
            self.kept.append((newest - 1, self.physical(at[newest])))
        if repeated:
            rows, (moved,) = self.run(self.ensemble, [next_start])
            self.ensemble = self.ensemble[rows]
        else:
            moved = at[next_start]
        changes = (next_start - self.start) * len(self.error.where) if self.error and lag else 0
        rest = self.ensemble[:, self.flow.size + changes :]
        self.ensemble = np.hstack([moved, rest]) if rest.size else moved
        self.start = next_start

    def interpolated(self, window: CycleWindow, newest: int) -> tuple[Array, Array]:
        """Mean and anomalies (N, n) after an analysis with averaged covariances, in which a time weighs by its number:
        what the members were before they had forgotten their start fades.
        """
        (ahead,) = window.ahead
        reference, predicted = centre(ahead.predicted)
        now = (each.T @ predicted / (len(predicted) - 1) for each in (window.anomalies, predicted))
        before: Sequence[Array | float] = self.covariances or (0.0, 0.0)
        self.covariances = tuple(c + 2 / (newest + 1) * (n - c) for c, n in zip(before, now, strict=True))
        d, S = self.series.whiten(newest - 1, reference, predicted)
        (_, cross), (_, half) = (self.series.whiten(newest - 1, reference, c) for c in self.covariances)
        values, vectors = np.linalg.eigh(self.series.whiten(newest - 1, reference, half)[1] + np.eye(len(d)))
        cross = vectors.T @ cross
        increment = (vectors.T @ d / values) @ cross
        return window.mean + increment, window.anomalies - (S.T @ vectors / (values + np.sqrt(values))) @ cross

    def put_smoothed(self, cycle: int, states: Array) -> None:
        self.smooth.put(cycle, self.physical(states))

    def record_ahead(self, expected: Sequence[Ahead]) -> None:
        """What was expected of observations before they were assimilated."""
        for at in expected:
            self.before.put(at.index - 1, self.physical(at.states), 1 / at.width)
            if not self.settings.innovations:
                continue
            predicted = at.predicted
            if at.width != 1:
                mean, anomalies = centre(predicted)
                predicted = mean + anomalies / at.width
            self.predicted.put(at.index - 1, predicted)

    def check_repeats(self) -> None:
        """Two members, over the first interval, twice: in one order and in the other; no cycle uses these runs.

        Raises :class:`ConfigError`: they differ.
        """
        flow, start = self.flow, self.start
        end = next((i for i in range(start + 1, len(flow.times)) if flow.times[i] > flow.times[start]), None)
        if end is None:
            return

        def run(members: list[int]) -> tuple[Array, list[str]]:
            states, failures = np.full((len(members), flow.size), np.nan), [""] * len(members)
            for row, i in enumerate(members):  # one by one: where one is lost, the other is not
                try:
                    states[row] = flow.move(self.ensemble[[i], : flow.size], start, [end])[0, 0]
                except MembersLost as lost:
                    (failures[row],) = lost.reasons
            return states, failures

        both = [0, len(self.ensemble) - 1]
        states, failures = run(both)
        check_repeats(flow.model, states, failures, lambda again: run([both[i] for i in again]))

    def analyse(self, members: Array, batch: Share) -> tuple[Rows, CycleWindow, CycleDescent]:
        """Which rows of the members survive, their window, and its descent; members lost are dropped from the prior."""

        def descend(rows: Rows) -> tuple[CycleWindow, CycleDescent]:
            alive = members[rows]
            # the numbers of a member are the same however many follow it
            window = CycleWindow(
                self.flow, self.series, alive, self.start, batch, self.settings.localisation, self.scheme,
                lambda name, size: member_stream(self.seed, name).standard_normal((len(alive), size)),
            )  # fmt: skip
            descent = CycleDescent(Weights.prior(len(alive)))
            minimise(window, [descent])
            return window, descent

        rows, (window, descent) = self.surviving(descend)
        return rows, window, descent

    def run(self, members: Array, indices: Sequence[int]) -> tuple[Rows, list[Array]]:
        """Which rows survive, and the states (N', n) at the times of ``indices``."""
        return self.surviving(lambda rows: self.flow.forecast(members[rows], self.start, indices))

    def surviving(self, attempt: Callable[[Rows], R]) -> tuple[Rows, R]:
        """The rows that none fails of, and what an attempt with them gives."""
        rows: Rows = EVERYONE
        while True:
            try:
                return rows, attempt(rows)
            except MembersLost as lost:
                rows = self.survivors(rows, lost.reasons)

    def survivors(self, rows: Rows, failed: Sequence[str]) -> Rows:
        """Those of ``rows`` that did not fail. Raises :class:`TooFewMembersError`."""
        newest = min(self.done + self.scheme.shift, len(self.series.times))
        since, until = (self.flow.times[k] for k in (min(self.start, self.done), newest))
        self.failures += [f"{reason} (t = {since:.6g} to {until:.6g})" for reason in failed if reason]
        left = self.initial_members - len(self.failures)
        needed = max(2, int(np.ceil(self.settings.min_active_fraction * self.initial_members)))
        if left < needed:
            raise TooFewMembersError(
                f"{len(self.failures)} of {self.initial_members} members failed, at least {needed} must survive; "
                f"the last: {self.failures[-1]}"
            )
        alive = np.flatnonzero([not reason for reason in failed])
        self.trail = [ensembles[..., alive, :] for ensembles in self.trail]
        self.bystanders = self.bystanders[alive]
        return alive if isinstance(rows, slice) else rows[alive]


def reflections(directions: Array) -> tuple[Array, Array]:
    """Factors (…, N, m) and (…, m, N) of what H_m … H_1 takes away, from directions (…, m, N), not yet in 1⊥."""
    v = directions - directions.mean(axis=-1, keepdims=True)
    gram = v @ np.swapaxes(v, -1, -2)
    inverse = np.tril(gram, -1) + 0.5 * (np.eye(gram.shape[-1]) * gram)
    return np.asarray(np.swapaxes(np.linalg.solve(np.swapaxes(inverse, -1, -2), v), -1, -2)), v


def rotate(anomalies: Array, factors: tuple[Array, Array]) -> Array:
    """Anomalies (N, n) rotated by what :func:`reflections` made of directions (m, N)."""
    left, right = factors
    return np.asarray(anomalies - left @ (right @ anomalies))


class Rotations:
    """Random rotations of an ensemble that keep its mean and covariance; cycle k has its own, whatever came before.

    A rotation is a product of Householder reflections H_j = 1 − 2 v_j v_jᵀ / |v_j|² with directions uniform on the unit
    sphere of 1⊥: a random walk on the group of such maps whose stationary law is Haar's, at O(N n) where drawing from
    Haar's law itself costs O(N³). In compact form H_m … H_1 = 1 − V L Vᵀ with L⁻¹ the lower triangle of VᵀV, its
    diagonal halved. Why rotate: Sakov & Oke (2008), Mon. Wea. Rev. 136, 1042; compact form: Schreiber & Van Loan
    (1989), SIAM J. Sci. Stat. Comput. 10, 53.
    """

    def __init__(self, seed: int, n_members: int):
        self._seed, self._drawn = seed, n_members
        self._block: tuple[int, int] = (-1, -1)
        self._factors = (np.empty(0), np.empty(0))

    def of_cycle(self, cycle: int, n_members: int) -> tuple[Array, Array]:
        """Factors for ``n_members`` ≤ N members, N those of the start."""
        block, within = divmod(cycle, BLOCK)
        if self._block != (block, n_members):
            stream = member_stream(self._seed, "rotation", block)
            directions = stream.standard_normal((BLOCK, REFLECTIONS, self._drawn))[..., :n_members]
            self._factors, self._block = reflections(directions), (block, n_members)
        return self._factors[0][within], self._factors[1][within]
