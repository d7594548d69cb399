"""A model whose parameters vary in time, or whose state changes at knots, run piece by piece.

Its state at a knot goes on with the value of the next piece in the field that has the parameter's name. Any model whose
state carries the parameter, and that can be resumed from a state, can be run like this.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.model.forward import Alternative, Batch, Failure, ForwardModel, Trajectory, ValidityLimit
from en4dvar.model.state import Array, StateLayout
from en4dvar.plumbing.caution import Caution
from en4dvar.priors.varying.changes import RandomWalk, StateChanges

ATTRIBUTES = (
    "observables", "time_unit", "time_display_unit", "batch", "compiled", "dense", "validity", "path_quantities",
)  # fmt: skip

Outcomes = Sequence[Trajectory | Failure]
Varying = RandomWalk | StateChanges


def can_vary(model: ForwardModel, name: str) -> bool:
    """True if a parameter can change on the way: the state carries it, and it does not act at the start alone."""
    acts = not model.path_parameters or name in model.path_parameters
    return model.resumable and acts and any(f.name == name and f.size == 1 for f in model.layout)


@dataclass(frozen=True)
class PieceRun:
    """The run of ``members`` (N',) over one piece; their runs end with an instant that is not asked for.

    ``columns``: which of the instants (K,) the others are; ``within`` (N, C): those that lie within the piece.
    """

    outcomes: Outcomes
    members: npt.NDArray[np.intp]
    columns: slice
    within: npt.NDArray[np.bool_]


@dataclass
class Walk:
    """Members on their way from piece to piece: initial states ``x`` (N, n_state), instants ``times`` (N, K).

    ``layout`` is that of ``x``, whose last fields are no part of the state that is integrated.
    """

    x: Array
    times: Array
    layout: StateLayout
    runs: list[PieceRun] = field(default_factory=list)
    failures: dict[int, Failure] = field(default_factory=dict)

    @property
    def alive(self) -> npt.NDArray[np.intp]:
        """The members (N',) that have not failed."""
        return np.array([i for i in range(len(self.x)) if i not in self.failures], dtype=np.intp)

    def run(self, begin: float, end: float, integrate: Callable[[npt.NDArray[np.intp], Array], Outcomes]) -> Array:
        """The states (N'', n_state) at ``end`` of the members that survive the piece from ``begin`` to there.

        ``integrate`` runs members (N',) to the instants (N', C + 1) that it is given; no further than to their last.
        """
        members, inside = self.alive, (self.times > begin) & (self.times <= end)
        met = np.flatnonzero(inside.any(axis=0))
        columns = slice(int(met[0]), int(met[-1]) + 1) if len(met) else slice(0, 0)
        asked = np.column_stack([self.times[:, columns], self.times[:, -1]])
        outcomes = integrate(members, np.minimum(asked, end)[members])
        self.runs.append(PieceRun(outcomes, members, columns, inside[:, columns]))
        if isinstance(outcomes, Batch) and outcomes.whole:
            return outcomes.last
        pairs = zip(members.tolist(), outcomes, strict=True)
        self.failures |= {i: outcome for i, outcome in pairs if isinstance(outcome, Failure)}
        return np.array([path.states[-1] for path in outcomes if isinstance(path, Trajectory)])

    def outcomes(self) -> Outcomes:
        """The whole paths: a batch where all are well and were run in batches."""
        if not self.failures and all(isinstance(run.outcomes, Batch) for run in self.runs):
            return JoinedBatch(self)
        return [self.failures.get(i) or self.path(i) for i in range(len(self.x))]

    def path(self, i: int) -> "JoinedTrajectory":
        """The path of a member that has not failed."""
        parts = []
        for run in self.runs:
            path = run.outcomes[int(np.searchsorted(run.members, i))]
            assert isinstance(path, Trajectory)
            parts.append((path, np.append(run.within[i], False)))
        return JoinedTrajectory(self.times[i], self.x[i], self.layout, parts)


class Joined:
    """Paths over pieces seen as one, of a member or of all: ``times`` (…, K), initial states ``_x`` (…, n_state)."""

    times: Array
    layout: StateLayout
    _x: Array

    def _pieces(self) -> Sequence[Any]:
        """The paths over the pieces, or batches of them."""
        raise NotImplementedError

    def _joined(self, values: Sequence[Array]) -> Array:
        """Values along each of the pieces as one array (…, K, …)."""
        raise NotImplementedError

    def _constant(self, values: Array) -> Array:
        """(…, K, …) of what is no part of the state that is integrated."""
        along = self.times.ndim - 1
        return np.repeat(np.expand_dims(values, along), self.times.shape[-1], axis=along)

    def _field(self, name: str) -> Array:
        pieces = self._pieces()
        if name in self.layout.slices and name not in pieces[0].layout.slices:
            return self._constant(self.layout.part(self._x, name))
        return self._joined([piece[name] for piece in pieces])

    def largest(self, name: str) -> Any:
        """The largest of all pieces."""
        return np.max([piece.largest(name) for piece in self._pieces()], axis=0)

    def beyond(self, limit: ValidityLimit) -> Any:
        """The earliest of all pieces."""
        return np.min([piece.beyond(limit) for piece in self._pieces()], axis=0)

    @property
    def states(self) -> Any:
        """(…, K, n_state)."""
        inner = self._joined([piece.states for piece in self._pieces()])
        return np.concatenate([inner, self._constant(self._x[..., inner.shape[-1] :])], axis=-1)


class JoinedTrajectory(Joined, Trajectory):
    """One member: ``parts`` are its paths over the pieces, and which of their instants are asked for."""

    _parts: Sequence[tuple[Trajectory, Array]]

    def __init__(self, times: Array, x: Array, layout: StateLayout, parts: Sequence[tuple[Trajectory, Array]]):
        self.__dict__.update(times=times, layout=layout, _x=x, _parts=parts)  # the dataclass is frozen

    def __getitem__(self, name: str) -> Array:
        return self._field(name)

    def _pieces(self) -> Sequence[Trajectory]:
        return [path for path, _ in self._parts]

    def _joined(self, values: Sequence[Array]) -> Array:
        return np.concatenate([value[asked] for value, (_, asked) in zip(values, self._parts, strict=True)])


class JoinedBatch(Joined, Batch):  # type: ignore[override]
    """Members none of which failed, run in batches over all pieces."""

    def __init__(self, walk: Walk):
        self.walk, self.times, self.layout, self._x, self.whole = walk, walk.times, walk.layout, walk.x, True
        self._fields: dict[str, Array] = {}

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self.walk.path(i) for i in range(*index.indices(len(self)))]
        if not isinstance(index, str):
            return self.walk.path(range(len(self))[index])
        if index not in self._fields:  # (N, K) or (N, K, size)
            self._fields[index] = self._field(index)
        return self._fields[index]

    def _pieces(self) -> Sequence[Outcomes]:
        return [run.outcomes for run in self.walk.runs]

    def _joined(self, values: Sequence[Array]) -> Array:
        """Values (N, C + 1, …) of the pieces as one array (N, K, …)."""
        joined = np.empty((*self.times.shape, *values[0].shape[2:]))
        for run, part in zip(self.walk.runs, values, strict=True):
            joined[:, run.columns][run.within] = part[:, :-1][run.within]
        return joined


class PiecewiseModel(ForwardModel):
    """``model`` with what varies; the changes are parameters of its own, and its state carries their values along."""

    dense = False

    def __init__(self, model: ForwardModel, varying: Sequence[Varying]):
        self.model, self.varying = model, tuple(varying)
        self.walks = tuple(change for change in self.varying if isinstance(change, RandomWalk))
        self.state_changes = tuple(change for change in self.varying if isinstance(change, StateChanges))
        self.parameters = (*model.parameters, *(term.parameter for change in self.varying for term in change.terms))
        self.layout = StateLayout((*model.layout.fields, *(change.own for change in self.varying)))
        varied = {walk.name for walk in self.walks}
        self.path_parameters = tuple(name for name in model.path_parameters if name not in varied)
        for name in ATTRIBUTES:
            setattr(self, name, getattr(model, name))

    @property
    def unforeseen(self) -> Mapping[str, float]:  # type: ignore[override]
        """The same as of the model."""
        return self.model.unforeseen

    @property
    def alternatives(self) -> tuple[Alternative, ...]:  # type: ignore[override]
        """Those of the model, with the same parameters varying."""
        return tuple(
            replace(alternative, model=PiecewiseModel(alternative.model, self.varying))
            if alternative.model
            else alternative
            for alternative in self.model.alternatives
        )

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({name: np.array([value]) for name, value in theta.items()})[0])

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """Initial states of the model with the varying parameters appended. Raises ValueError where a piece lies
        outside of the parameter's bounds.
        """
        inner = self.model.initial_states({p.name: theta[p.name] for p in self.model.parameters})
        return np.hstack([inner, *(change.values(theta) for change in self.varying)])

    def changed(self, name: str, x: Array, change: Array) -> Array:
        """As of the model."""
        inner = self.model.layout.size
        return np.hstack([self.model.changed(name, x[:, :inner], change), x[:, inner:]])

    def doubts(
        self, observable: str, times: Array, values: Array, predicted: Array, members: Mapping[str, Array]
    ) -> Sequence[str | Caution]:
        """Those of the model."""
        return self.model.doubts(observable, times, values, predicted, members)

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """Raises RuntimeError with the model's reason where it fails."""
        (path,) = self.resumed(x[None], np.array([t0]), np.array([[t1]]))
        if isinstance(path, Failure):
            raise RuntimeError(path.reason)
        return np.asarray(path.states[-1])

    def trajectories(self, x: Array, times: Array) -> Outcomes:
        return self.resumed(x, np.zeros(len(x)), np.broadcast_to(times, (len(x), np.shape(times)[-1])))

    def resumed(self, x: Array, start: Array, times: Array) -> Outcomes:
        walk, inner = Walk(x, times, self.layout), np.array(x[:, : self.model.layout.size])
        knots = sorted({knot for change in self.varying for knot in change.knots})
        for begin, end in zip((-math.inf, *knots), (*knots, math.inf), strict=True):
            if not len(walk.alive) or begin >= times[:, -1].max():
                break
            for change in self.walks:
                piece = int(np.searchsorted(change.knots, begin, side="right"))
                inner[:, self.model.layout[change.name]] = x[:, [self.layout[change.pieces_name].start + piece]]
            since = np.maximum(start, begin)

            def integrate(members: npt.NDArray[np.intp], asked: Array, since: Array = since) -> Outcomes:
                return self.model.resumed(inner[members], since[members], asked)

            ends = walk.run(begin, end, integrate)
            inner[walk.alive] = ends.reshape(-1, inner.shape[1])
            self._change(walk, inner, end, start <= end)
        return walk.outcomes()

    def _change(self, walk: Walk, inner: Array, knot: float, concerned: npt.NDArray[np.bool_]) -> None:
        """Change the states (N, n_state) at a knot, of the members (N,) ``concerned``; some may not survive it."""
        for process in self.state_changes:
            if knot not in process.knots:
                continue
            members = walk.alive[concerned[walk.alive]]
            change = walk.x[members, self.layout[process.own.name].start + process.knots.index(knot)]
            inner[members], inside = process.applied(self.model, inner[members], change)
            for i in members[~inside].tolist():
                low, high = process.field.bounds
                reason = f"{process.name} outside ({low:g}, {high:g}) {process.field.unit} after its change"
                walk.failures[i] = Failure(reason, knot)
