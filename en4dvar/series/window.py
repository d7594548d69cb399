"""One window of a series: members on their way from its start to later instants, and the observations there that are
assimilated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.descent.loop import Descends, Objective
from en4dvar.descent.step_control import Move
from en4dvar.ensemble.linalg import centre
from en4dvar.ensemble.missing import fitted
from en4dvar.executor import Executor
from en4dvar.model.forward import Batch, Failure, ForwardModel, Observable, Trajectory, read_along
from en4dvar.model.state import Array, floats
from en4dvar.plumbing.hints import listed
from en4dvar.schemes.asked import is_done, linearised, members_of, step_of
from en4dvar.schemes.base import Evaluation, GaussNewtonStep, Runs, Scheme, Step, Weights
from en4dvar.schemes.localisation import BlockDescents, BlockLocalisation
from en4dvar.series.model_error import ModelError
from en4dvar.series.series import CycleSeries
from en4dvar.series.start import EnsembleCoordinates

Share = Sequence[tuple[int, float]]  # index of each observation time in the window, and how much its observations count


class MembersLost(Exception):
    """Members that failed: ``reasons`` (N,), "" for the others."""

    def __init__(self, reasons: list[str]):
        self.reasons = reasons


class _Started(ForwardModel):
    """A model seen from a later time zero."""

    def __init__(self, model: ForwardModel, start: float):
        self.model, self._begins, self._who = model, start, f"{type(model).__name__}.resumed"
        self.parameters, self.layout, self.observables = model.parameters, model.layout, model.observables
        self.batch, self.compiled, self.threaded = model.batch, model.compiled, model.threaded

    def initial_state(self, theta: object) -> Array:
        raise NotImplementedError("the ensemble is already under way")

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return self.model.resumed(x, np.full(len(x), self._begins), self._begins + own)


def propagate(model: ForwardModel, states: Array, start: float, times: Array, executor: Executor) -> Array:
    """Members (N, n_state) from ``start`` to later ``times`` (K,): (N, K, n_state). Raises :class:`MembersLost`."""
    mover = model if model.autonomous or start == 0 else _Started(model, start)
    outcomes = executor.trajectories(mover, states, times - start)
    if isinstance(outcomes, Batch) and outcomes.whole:
        return outcomes.states
    reasons = [outcome.reason if isinstance(outcome, Failure) else "" for outcome in outcomes]
    if any(reasons):
        raise MembersLost(reasons)
    return require_finite(np.array([floats(outcome.states) for outcome in outcomes if isinstance(outcome, Trajectory)]))


def require_finite(paths: Array, reason: str = "non-finite state") -> Array:
    """Paths (N, K, n) as they are. Raises :class:`MembersLost` for those that are not finite, with the ``reason``."""
    if not np.isfinite(paths).all():
        raise MembersLost(["" if np.isfinite(path).all() else reason for path in paths])
    return paths


def predictions(observables: Sequence[Observable], trajectory: Trajectory) -> Array:
    """(K, p): outputs (K,) or (K, q) of the operators along a trajectory, side by side."""
    outputs = [read_along(observable.operator, observable.name, None, trajectory) for observable in observables]
    return outputs[0] if len(outputs) == 1 and outputs[0].ndim == 2 else np.column_stack(outputs)


@dataclass
class Flow:
    """F and H of a series, of members in the coordinates of the ensemble.

    ``times``: index 0 is time zero, k the k-th observation time. A member at the start of a window is a state (n,) and,
    with a model error, its standard normal changes (q,) at the times behind the start, one after the other.
    ``runs``: of one member over a window, so far.
    """

    model: ForwardModel
    observables: tuple[Observable, ...]
    times: Sequence[float]
    executor: Executor
    coordinates: EnsembleCoordinates
    error: ModelError | None
    runs: int = 0

    @property
    def size(self) -> int:
        """n, the length of a state."""
        return self.model.layout.size

    def forecast(self, members: Array, start: int, indices: Sequence[int]) -> list[Array]:
        """Members (N, n + q m) at ``start`` → states (N, n) at the times of ``indices``, or :class:`MembersLost`."""
        ahead, states = [i for i in indices if i > start], members[:, : self.size]
        if not ahead:
            return [states] * len(indices)
        self.runs += len(members)
        if self.error is None or members.shape[1] == self.size:
            paths = self.move(states, start, ahead)
            return [states] * (len(indices) - len(ahead)) + [paths[:, j] for j in range(len(ahead))]
        reached, q = {start: states}, len(self.error.where)
        for i in range(start + 1, max(ahead) + 1):
            first = self.size + (i - start - 1) * q
            moved, noise = self.move(reached[i - 1], i - 1, [i])[:, 0], members[:, first : first + q]
            reached[i] = self.error.added(moved, noise, self.elapsed(i))
        return [reached[i] for i in indices]

    def move(self, states: Array, start: int, indices: Sequence[int]) -> Array:
        """States (N, n) → (N, K, n), without model error. Raises :class:`MembersLost`."""
        times = np.array([self.times[i] for i in indices])
        if times[-1] == self.times[start]:  # the first observation may be at time zero
            return states[:, None].repeat(len(times), axis=1)
        physical = self.coordinates.to_physical(states)
        paths = propagate(self.model, physical, self.times[start], times, self.executor)
        moved = self.coordinates.from_physical(paths, states)
        if not self.coordinates.logarithms:
            return moved
        layout = self.model.layout
        fell = listed([field.name for field in layout if not np.isfinite(moved[..., layout[field.name]]).all()])
        advice = "give its initial_std in its unit, not in %, and leave it out of sequence.positive"
        return require_finite(moved, f"{fell} is not positive, and cannot be estimated by its logarithm: {advice}")

    def elapsed(self, index: int) -> float:
        """Time between an observation and the one before it."""
        return self.times[index] - self.times[index - 1]

    def predict(self, states: Array, index: int) -> Array:
        """Predictions (N, p): H acts at one instant, so members stand where it expects times.

        What some members lack is regressed on the states of the others.
        """
        physical = self.coordinates.to_physical(states)
        path = Trajectory(np.full(len(states), self.times[index]), physical, self.model.layout)
        return fitted(states, predictions(self.observables, path), np.ones(len(states), dtype=bool))


@dataclass
class CycleDescent(Descends):
    """The descent of one cycle."""

    weights: Weights
    iteration: int = 0


@dataclass(frozen=True)
class Ahead:
    """Forecasts of the members before the analysis, at the time of ``index``: ``states`` (N, n), ``predicted`` (N, p).

    Anomalies of the states are ``width`` times those of the ensemble.
    """

    index: int
    states: Array
    predicted: Array
    width: float


@dataclass
class CycleWindow(Objective[CycleDescent]):
    """The window that begins at the time of index ``start`` with ``members`` (N, n + q m), see :class:`Flow`."""

    flow: Flow
    series: CycleSeries
    members: Array
    start: int
    batch: Share
    localisation: BlockLocalisation | None
    scheme: Scheme
    stream: Callable[[str, int], Array]

    def __post_init__(self) -> None:
        self.indices = [index for index, _ in self.batch]
        self.mean, self.anomalies = centre(self.members)
        self.localised: Array | None = None
        local = self.localisation and _over(self.localisation, self.flow, self.members.shape[1], len(self.batch))
        self.localisation = local
        self.local = BlockDescents(local, self.members) if local and not self.scheme.filters else None
        self.runs: Runs | None = None
        self.ahead: list[Ahead] = []

    def linearise(self, going: Sequence[CycleDescent]) -> list[Step | GaussNewtonStep]:
        (descent,), scheme = going, self.scheme
        self.runs = self.run(descent)
        evaluation = self.whiten(*linearised(scheme, descent.weights, self.runs))
        if self.localisation is not None and self.local is None:
            self.localised = self.localisation.analysis(scheme, self.members, evaluation, self.draw)
        return [step_of(scheme, descent.weights, evaluation, descent.iteration, self.draw)]

    def run(self, descent: CycleDescent) -> Runs:
        """The members of the scheme through the window. Raises :class:`MembersLost`."""
        scheme = self.scheme
        if descent.iteration == 0:  # here w = 0 and the members are those of the window, or close to their mean
            width = 1.0 if scheme.filters else float(members_of(scheme, descent.weights)[0, 0])
            members = self.members if width == 1 else self.mean + width * self.anomalies
        elif self.local:
            members = self.local.members(lambda _, weights: members_of(scheme, weights))
        else:
            members = self.mean + members_of(scheme, descent.weights) @ self.anomalies
        states = self.flow.forecast(members, self.start, self.indices)
        each = [self.flow.predict(at, index) for at, index in zip(states, self.indices, strict=True)]
        predicted = each[0] if len(each) == 1 else np.hstack(each)
        if not np.isfinite(predicted).all():
            raise MembersLost(["" if row.all() else "non-finite prediction" for row in np.isfinite(predicted)])
        if descent.iteration == 0:
            self.ahead = [Ahead(i, at, p, width) for i, at, p in zip(self.indices, states, each, strict=True)]
        return Runs(predicted)

    def whiten(self, reference: Array, anomalies: Array) -> Evaluation:
        """The observations of every time in the window, one below the other."""
        p, parts = self.series.values.shape[1], []
        for j, (index, weight) in enumerate(self.batch):
            own = slice(j * p, (j + 1) * p)
            d, S = self.series.whiten(index - 1, reference[own], anomalies[:, own])
            parts.append((np.sqrt(weight) * d, np.sqrt(weight) * S))
        return Evaluation(np.concatenate([d for d, _ in parts]), np.concatenate([S for _, S in parts]))

    def draw(self, purpose: str, columns: int | None = None) -> Array:
        size = columns or self.series.values.shape[1] * len(self.batch)
        return self.stream(f"{purpose}, cycle {self.indices[-1] - 1}", size)

    def move(self, going: Sequence[CycleDescent], moves: Sequence[Move | None]) -> None:
        (descent,), scheme = going, self.scheme
        if self.local is None:
            descent.weights = descent.step.weights
        else:  # the blocks' own steps from the same runs, of which the largest tells when a cycle ends
            assert self.runs is not None
            step = self.local.advance(scheme, self.runs, self.whiten, descent.iteration, self.draw)
            descent.step = Step(descent.weights, step)
        descent.ended = is_done(scheme, descent.iteration, descent.step)
        if self.local and self.localisation and descent.ended:
            self.localised = self.local.members(self.localisation.rows)
        descent.iteration += 1

    def posterior(self, descent: CycleDescent) -> tuple[Array, Array]:
        """Mean and anomalies of the members after the analysis."""
        if self.localised is not None:
            return centre(self.localised)
        weights = descent.weights
        return self.mean + weights.w @ self.anomalies, weights.T @ self.anomalies


def _over(localisation: BlockLocalisation, flow: Flow, size: int, times: int) -> BlockLocalisation:
    """The same for members that hold model errors too, and for observations at several ``times``.

    The changes of a variable are localised as the variable is.
    """
    blocks = localisation.blocks
    if flow.error is not None and size > flow.size:
        where = flow.error.where
        firsts = range(flow.size, size, len(where))
        blocks = [
            np.concatenate([block, *(first + np.flatnonzero(np.isin(where, block)) for first in firsts)])
            for block in blocks
        ]
    return replace(localisation, blocks=blocks, taper=np.tile(localisation.taper, (1, times)))
