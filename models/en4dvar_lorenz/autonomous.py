"""Common parts of the models: a state of dynamic variables with the parameters appended, integrated in batches."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from en4dvar import Batch, Field, ForwardModel, Observable, Parameter, StateField, StateLayout, Trajectory

Integrate = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


class Settings(BaseModel):
    """Of a model: unknown keys are errors, the texts under its keys are their descriptions."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Autonomous(ForwardModel):
    """dx/dt = f(x, θ). A subclass gives ``integrate`` (states (N, n), times (N, K), longest step) → (N, K, n)."""

    time_unit = "1"
    compiled = True
    autonomous = True
    defaults: Mapping[str, float] = {}
    integrate: Integrate

    def __init__(self, fields: Sequence[Field], initial: Sequence[float], step: float):
        self.initial = np.asarray(initial, dtype=float)
        self.longest_step = step
        self.layout = StateLayout((*fields, *(Field(p.name, unit=p.unit) for p in self.parameters)))
        self.observables = tuple(Observable(f.name, f.unit, StateField(f.name)) for f in fields)

    def initial_state(self, theta: Mapping[str, float]) -> np.ndarray:
        return np.concatenate([self.initial, [theta[p.name] for p in self.parameters]])

    def step(self, x: np.ndarray, t0: float, t1: float) -> np.ndarray:
        return np.asarray(self.integrate(np.array([x], dtype=float), np.array([[t1 - t0]]), self.longest_step)[0, 0])

    def trajectories(self, x: np.ndarray, times: np.ndarray) -> Batch:
        own = np.empty((len(x), np.shape(times)[-1]))
        own[:] = times
        return Batch(own, self.integrate(np.ascontiguousarray(x, dtype=float), own, self.longest_step), self.layout)


class Analytic(Autonomous):
    """One whose ``integrate`` takes complex states: its arithmetic differentiates itself, to the last digit."""

    def tangent(self, x: np.ndarray, directions: np.ndarray, times: np.ndarray) -> tuple[Trajectory, np.ndarray]:
        """By the complex step: Im x(x0 + iεd)/ε, which subtracts nothing.

        Source: Squire & Trapp (1998), SIAM Rev. 40, 110.
        """
        start = x + 1e-30j * np.vstack([np.zeros_like(x), directions])
        paths = self.integrate(start, np.tile(times, (len(start), 1)), self.longest_step)
        return Trajectory(times, paths[0].real, self.layout), paths[1:].imag / 1e-30


def dimensionless(name: str, label: str, symbol: str, source: str) -> Parameter:
    """A parameter without unit and without bounds."""
    return Parameter(name, "1", label=label, symbol=symbol, source=source)


@dataclass(frozen=True)
class Logarithm:
    """H that reads the natural logarithm of a positive field: errors that are a share of it have one std there."""

    name: str
    batched: ClassVar[bool] = True

    def __call__(self, trajectory: Any) -> np.ndarray:
        with np.errstate(divide="ignore"):  # what has died out to 0 has -inf, which no reading is
            return np.asarray(np.log(trajectory[self.name]))
