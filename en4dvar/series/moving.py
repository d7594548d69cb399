"""Members of a series on their way: from one instant to later ones, and what is observed of them there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.ensemble.missing import fitted
from en4dvar.executor import Executor
from en4dvar.model.batch import Batch
from en4dvar.model.forward import Failure, ForwardModel, Observable, Trajectory
from en4dvar.model.state import Array
from en4dvar.series.coordinates import EnsembleCoordinates
from en4dvar.series.model_error import ModelError


class MembersLost(Exception):
    """Members that failed: ``reasons`` (N,), "" for the others."""

    def __init__(self, reasons: list[str]):
        self.reasons = reasons


class _Started(ForwardModel):
    """A model seen from a later time zero."""

    def __init__(self, model: ForwardModel, start: float):
        self.model, self.start = model, start
        self.parameters, self.layout, self.observables = model.parameters, model.layout, model.observables
        self.batch, self.compiled = model.batch, model.compiled

    @property
    def threaded(self) -> bool:
        return self.model.threaded

    def initial_state(self, theta: object) -> Array:
        raise NotImplementedError("the ensemble is already under way")

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return self.model.resumed(x, np.full(len(x), self.start), self.start + own)


def propagate(model: ForwardModel, states: Array, start: float, times: Array, executor: Executor) -> Array:
    """Members (N, n_state) from ``start`` to later ``times`` (K,): (N, K, n_state). Raises :class:`MembersLost`."""
    mover = model if model.autonomous or start == 0 else _Started(model, start)
    outcomes = executor.trajectories(mover, states, times - start)
    if isinstance(outcomes, Batch) and outcomes.whole:
        return outcomes.states
    reasons = [outcome.reason if isinstance(outcome, Failure) else "" for outcome in outcomes]
    if any(reasons):
        raise MembersLost(reasons)
    return require_finite(np.array([outcome.states for outcome in outcomes if isinstance(outcome, Trajectory)]))


def require_finite(paths: Array) -> Array:
    """Paths (N, K, n) as they are. Raises :class:`MembersLost` for those that are not finite."""
    if not np.isfinite(paths).all():
        raise MembersLost(["" if np.isfinite(path).all() else "non-finite state" for path in paths])
    return paths


def predictions(observables: Sequence[Observable], trajectory: Trajectory) -> Array:
    """(K, p): outputs (K,) or (K, q) of the operators along a trajectory, side by side."""
    outputs = [observable.operator(trajectory) for observable in observables]
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
        if members.shape[1] == self.size:
            paths = self.move(states, start, ahead)
            return [states] * (len(indices) - len(ahead)) + [paths[:, j] for j in range(len(ahead))]
        reached = {start: states}
        for i in range(start + 1, max(ahead) + 1):
            reached[i] = self.changed(self.move(reached[i - 1], i - 1, [i])[:, 0], self.noise_of(members, start, i), i)
        return [reached[i] for i in indices]

    def move(self, states: Array, start: int, indices: Sequence[int]) -> Array:
        """States (N, n) → (N, K, n), without model error. Raises :class:`MembersLost`."""
        times = np.array([self.times[i] for i in indices])
        if times[-1] == self.times[start]:  # the first observation may be at time zero
            return states[:, None].repeat(len(times), axis=1)
        physical = self.coordinates.to_physical(states)
        paths = propagate(self.model, physical, self.times[start], times, self.executor)
        moved = self.coordinates.from_physical(paths, states)
        return require_finite(moved) if self.coordinates.logarithms else moved

    def noise_of(self, members: Array, start: int, index: int) -> Array:
        """The changes (N, q) at the time of ``index``."""
        assert self.error is not None
        q = len(self.error.where)
        first = self.size + (index - start - 1) * q
        return members[:, first : first + q]

    def changed(self, states: Array, noise: Array, index: int) -> Array:
        """States (N, n) at the time of ``index`` with what the model has missed since the time before."""
        assert self.error is not None
        return self.error.added(states, noise, self.elapsed(index))

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
