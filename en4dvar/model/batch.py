"""Paths of many members in one array: what a vectorised model may return instead of a list."""

from collections.abc import Sequence
from typing import overload

import numpy as np

from en4dvar.model.forward import Failure, Trajectory, ValidityLimit
from en4dvar.model.state import Array, StateLayout


class Batch(Sequence[Trajectory | Failure]):
    """N trajectories or failures: ``states`` (N, K, n_state) at ``times`` (N, K).

    ``batch[i]`` is member i, ``batch["x"]`` a field along all paths, (N, K) or (N, K, size).
    A member is a :class:`Failure` from the first instant on at which its state is not finite. Where members are many
    and steps are short, as in sequential assimilation, a batch spares the making of N objects.
    """

    def __init__(self, times: Array, states: Array, layout: StateLayout):
        self.times, self.states, self.layout = times, states, layout
        self.whole = bool(np.isfinite(states).all())  # no member failed

    def __len__(self) -> int:
        return len(self.states)

    @overload
    def __getitem__(self, index: int) -> Trajectory | Failure: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory | Failure]: ...
    @overload
    def __getitem__(self, index: str) -> Array: ...
    def __getitem__(self, index: int | slice | str) -> Trajectory | Failure | list[Trajectory | Failure] | Array:
        if isinstance(index, str):
            return self.layout.part(self.states, index)
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        times, states = self.times[index], self.states[index]
        if not self.whole and not (finite := np.isfinite(states).all(axis=-1)).all():
            return Failure("non-finite state", float(times[np.argmin(finite)]))
        return Trajectory(times, states, self.layout)

    @property
    def last(self) -> Array:
        """States (N, n_state) at the last instant."""
        return self.states[:, -1]

    def largest(self, name: str) -> Array:
        """(N,) how far a quantity of ``validity`` went: :meth:`~en4dvar.model.forward.Trajectory.largest`."""
        return np.array([path.largest(name) if isinstance(path, Trajectory) else np.nan for path in self])

    def beyond(self, limit: ValidityLimit) -> Array:
        """(N,) when the paths first exceed a limit, see :meth:`~en4dvar.model.forward.Trajectory.beyond`."""
        return np.array([path.beyond(limit) if isinstance(path, Trajectory) else np.nan for path in self])
