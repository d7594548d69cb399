"""Paths of many members in one array: what a vectorised model may return instead of a list."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import numpy as np

from en4dvar.forward import Failure, Trajectory
from en4dvar.state import Array, StateLayout


class Batch(Sequence[Trajectory | Failure]):
    """N trajectories or failures: ``states`` (N, K, n_state) at ``times`` (N, K).

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
    def __getitem__(self, index: int | slice) -> Trajectory | Failure | list[Trajectory | Failure]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        times, states = self.times[index], self.states[index]
        if not self.whole and not (finite := np.isfinite(states).all(axis=-1)).all():
            return Failure("non-finite state", float(times[np.argmin(finite)]))
        return Trajectory(times, states, self.layout)
