"""What the models share: a state of dynamic variables with the parameters appended, integrated in batches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from en4dvar import Field, ForwardModel, Observable, Parameter, StateField, StateLayout, Trajectory

Integrate = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


class Autonomous(ForwardModel):
    """dx/dt = f(x, θ). A subclass gives ``integrate`` (states (N, n), times (N, K), longest step) → (N, K, n)."""

    time_unit = "1"
    time_display_unit = "1"
    compiled = True
    autonomous = True
    defaults: ClassVar[Mapping[str, float]] = {}
    integrate: Integrate

    def __init__(self, fields: Sequence[Field], initial: Sequence[float], step: float):
        self.initial = np.asarray(initial, dtype=float)
        self.longest_step = step
        self.layout = StateLayout((*fields, *(Field(p.name, unit=p.unit) for p in self.parameters)))
        self.observables = tuple(Observable(f.name, f.unit, StateField(f.name)) for f in fields)

    def initial_state(self, theta: Mapping[str, float]) -> np.ndarray:
        return np.concatenate([self.initial, [theta[p.name] for p in self.parameters]])

    def step(self, x: np.ndarray, t0: float, t1: float) -> np.ndarray:
        return np.asarray(self.integrate(x[None], np.array([[t1 - t0]]), self.longest_step)[0, 0])

    def trajectories(self, x: np.ndarray, times: np.ndarray) -> list[Any]:
        own = np.ascontiguousarray(np.broadcast_to(times, (len(x), np.shape(times)[-1])))
        paths = self.integrate(np.ascontiguousarray(x), own, self.longest_step)
        if np.isfinite(paths).all():
            return [Trajectory(t, states, self.layout) for t, states in zip(own, paths, strict=True)]
        return [self._outcome(t, states) for t, states in zip(own, paths, strict=True)]

    def _outcome(self, times: np.ndarray, states: np.ndarray) -> Any:
        from en4dvar import Failure

        bad = np.flatnonzero(~np.isfinite(states).all(axis=1))
        return Failure("non-finite state", float(times[bad[0]])) if len(bad) else Trajectory(times, states, self.layout)


def dimensionless(name: str, label: str, symbol: str, source: str) -> Parameter:
    """A parameter without unit and without bounds."""
    return Parameter(name, "1", label=label, symbol=symbol, source=source)
