"""Paths that were run piece by piece, seen as one."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from en4dvar.model.batch import Batch
from en4dvar.model.forward import Failure, Trajectory, ValidityLimit
from en4dvar.model.state import Array, StateLayout

Outcomes = Sequence[Trajectory | Failure]


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


class JoinedTrajectory(Trajectory):
    """One member: ``parts`` are its paths over the pieces, and which of their instants are asked for."""

    _x: Array
    _parts: Sequence[tuple[Trajectory, Array]]

    def __init__(self, times: Array, x: Array, layout: StateLayout, parts: Sequence[tuple[Trajectory, Array]]):
        self.__dict__.update(times=times, layout=layout, _x=x, _parts=parts)  # the dataclass is frozen

    def __getitem__(self, name: str) -> Array:
        if constant(name, self.layout, self._parts[0][0].layout):
            value = np.asarray(self.layout.part(self._x, name))
            return np.broadcast_to(value, (len(self.times), *value.shape))
        return np.concatenate([path[name][asked] for path, asked in self._parts])

    def largest(self, name: str) -> float:
        """The largest of all pieces."""
        return max(path.largest(name) for path, _ in self._parts)

    def beyond(self, limit: ValidityLimit) -> float:
        """The earliest of all pieces."""
        return min(path.beyond(limit) for path, _ in self._parts)

    @property
    def states(self) -> Array:
        """(K, n_state)."""
        inner = np.concatenate([path.states[asked] for path, asked in self._parts])
        own = self._x[inner.shape[1] :]
        return np.hstack([inner, np.broadcast_to(own, (len(inner), len(own)))])


class JoinedBatch(Batch):
    """Members none of which failed, run in batches over all pieces."""

    def __init__(self, walk: Walk):
        self.walk, self.times, self.layout, self.whole = walk, walk.times, walk.layout, True
        self._fields: dict[str, Array] = {}

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self.walk.path(i) for i in range(*index.indices(len(self)))]
        if not isinstance(index, str):
            return self.walk.path(range(len(self))[index])
        if index not in self._fields:  # (N, K) or (N, K, size)
            if constant(index, self.layout, next(self._batches()).layout):
                value = np.asarray(self.layout.part(self.walk.x, index))
                self._fields[index] = np.repeat(value[:, None], self.times.shape[1], axis=1)
            else:
                self._fields[index] = self._joined([batch[index] for batch in self._batches()])
        return self._fields[index]

    def _joined(self, values: Sequence[Array]) -> Array:
        """Values (N, C + 1, …) of the pieces as one array (N, K, …)."""
        joined = np.empty((*self.times.shape, *values[0].shape[2:]))
        for run, part in zip(self.walk.runs, values, strict=True):
            joined[:, run.columns][run.within] = part[:, :-1][run.within]
        return joined

    def _batches(self) -> Iterator[Batch]:
        for run in self.walk.runs:
            assert isinstance(run.outcomes, Batch)
            yield run.outcomes

    def largest(self, name: str) -> Array:
        """(N,) the largest of all pieces."""
        return np.asarray(np.max([batch.largest(name) for batch in self._batches()], axis=0))

    def beyond(self, limit: ValidityLimit) -> Array:
        """(N,) the earliest of all pieces."""
        return np.asarray(np.min([batch.beyond(limit) for batch in self._batches()], axis=0))

    @property
    def states(self) -> Array:  # type: ignore[override]
        """(N, K, n_state)."""
        inner = self._joined([batch.states for batch in self._batches()])
        own = self.walk.x[:, inner.shape[2] :]
        return np.concatenate([inner, np.repeat(own[:, None], inner.shape[1], axis=1)], axis=2)


def constant(name: str, layout: StateLayout, inner: StateLayout) -> bool:
    """True if a field of ``layout`` is no part of the state that is integrated."""
    return name in layout.slices and name not in inner.slices
