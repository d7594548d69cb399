"""The bubble as a forward model: state vector {R, Ṙ, p_b, S, T, parameters}, observed through its radius."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from en4dvar.forward import Failure, ForwardModel, Observable, StateField, Trajectory
from en4dvar.state import Array, Field, Parameter, StateLayout
from en4dvar_bubble.driving import Driving, Reading, histotripsy, silence
from en4dvar_bubble.laws import ConstitutiveLaw, QuadraticKelvinVoigt, get_law
from en4dvar_bubble.laws.base import GRID
from en4dvar_bubble.laws.parameters import R0, R_EQ, R_MAX
from en4dvar_bubble.medium import WATER_25C, Medium
from en4dvar_bubble.settings import BubbleSettings
from en4dvar_bubble.solver import equations as rows
from en4dvar_bubble.solver.collocation import ball
from en4dvar_bubble.solver.driver import ACCURACIES, Accuracy, Solution, solve
from en4dvar_bubble.tables import evaluate

Gas = Literal["heat", "polytropic"]
Start = Literal["acoustic", "laser"]


@dataclass(frozen=True, eq=False)
class BubbleModel(ForwardModel):
    """One spherical gas bubble in a viscoelastic medium (Keller–Miksis in pressure; see ``equations`` and the docs).

    ``start="acoustic"``: at rest at R0 until the driving arrives, parameters of the law and ``R0``.
    ``start="laser"``: released from ``R_max`` at the ambient temperature with the amount of gas that is in equilibrium at
    ``R_eq``, the stress-free radius: p_g(R_max) = p_g(R_eq) (R_eq/R_max)³, whatever the gas does afterwards.
    Before time zero the released bubble is taken to be symmetric in time, R(−t) = R(t).
    """

    law: ConstitutiveLaw = field(default_factory=QuadraticKelvinVoigt)
    gas: Gas = "heat"
    start: Start = "acoustic"
    driving: Driving = field(default_factory=histotripsy)
    reading: Reading = "instantaneous"
    medium: Medium = WATER_25C
    accuracy: Accuracy = ACCURACIES["standard"]

    Settings: ClassVar[type[BubbleSettings]] = BubbleSettings
    time_display_unit: ClassVar[str] = "us"
    batch: ClassVar[int] = 8
    compiled: ClassVar[bool] = True
    observables = (
        Observable(
            "radius", "m", StateField("R", rate_of="Rdot"), symbol="R", display_unit="um", label="bubble radius"
        ),
    )

    @classmethod
    def from_settings(cls, settings: BubbleSettings) -> BubbleModel:
        return cls(
            law=get_law(settings.law),
            gas=settings.gas,
            start=settings.start,
            driving=settings.driving.build() if settings.start == "acoustic" else silence(),
            reading=settings.driving_read,
            medium=settings.medium,
            accuracy=settings.solver_accuracy,
        )

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:  # type: ignore[override]
        return (*self.law.parameters, *((R0,) if self.start == "acoustic" else (R_EQ, R_MAX)))

    @property
    def nodes(self) -> int:
        """Temperature nodes in the gas (0 for a polytropic gas)."""
        return self.accuracy.nodes if self.gas == "heat" else 0

    @cached_property
    def layout(self) -> StateLayout:  # type: ignore[override]
        state = [Field("R", unit="m"), Field("Rdot", unit="m/s"), Field("p_b", unit="Pa"), Field("S", unit="Pa")]
        if self.nodes:
            state.append(Field("T", self.nodes, "K"))
        return StateLayout((*state, *(Field(p.name, unit=p.unit) for p in self.parameters)))

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        return np.asarray(self.initial_states({p.name: np.array([theta[p.name]]) for p in self.parameters})[0])

    def initial_states(self, theta: Mapping[str, Array]) -> Array:
        """States (N, n_state) at time zero for parameters name → (N,), SI. Raises ValueError outside a parameter's
        bounds.
        """
        for p in self.parameters:
            value = np.asarray(theta[p.name], dtype=float)
            if not np.all((value >= p.bounds[0]) & (value <= p.bounds[1]) & np.isfinite(value)):
                raise ValueError(f"{p.name} must lie in {p.bounds} {p.unit}")
        rest = np.asarray(theta["R0" if self.start == "acoustic" else "R_eq"], dtype=float)
        R = rest if self.start == "acoustic" else np.asarray(theta["R_max"], dtype=float)
        if np.any(rest <= 0) or np.any(R <= 0):
            raise ValueError("radii must be positive")
        medium = self.medium
        gas = medium.p_inf + 2 * medium.S / rest - medium.p_v
        x = np.empty((len(rest), self.layout.size))
        x[:, self.layout["R"].start] = R
        x[:, self.layout["Rdot"].start] = 0.0
        x[:, self.layout["p_b"].start] = gas * (rest / R) ** 3 + medium.p_v
        if self.nodes:
            x[:, self.layout["T"]] = medium.T_inf
        for p in self.parameters:
            x[:, self.layout[p.name].start] = theta[p.name]
        stretch = (R / rest)[:, None]
        x[:, self.layout["S"].start] = self.law.elastic_stress(stretch, self._law_values(x))[:, 0]
        return x

    def step(self, x: Array, t0: float, t1: float) -> Array:
        """Restart from any state: F_{t1←t0}. Raises RuntimeError with the solver's reason where it fails."""
        path = self._integrate(x[None, :], np.array([[t1]]), t0)
        if path.solution.status[0]:
            raise RuntimeError(path.solution.reason(0))
        return np.asarray(path.states[0, 0])

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        path = self._integrate(np.asarray(x, dtype=float), np.broadcast_to(times, (len(x), np.shape(times)[-1])), 0.0)
        solution = path.solution
        return [
            BubbleTrajectory(path, i)
            if solution.status[i] == 0
            else Failure(solution.reason(i), float(solution.record[i, 5]) * 1e-6)
            for i in range(len(x))
        ]

    def _law_values(self, x: Array) -> dict[str, Array]:
        return {p.name: x[:, self.layout[p.name].start] for p in self.law.parameters}

    def _integrate(self, x: Array, times: Array, t0: float) -> Paths:
        """All members from their states ``x`` at t0 (s) to ``times`` (N, K) (s)."""
        medium, layout, m = self.medium, self.layout, self.nodes
        column = {name: x[:, s.start] for name, s in layout.slices.items()}
        n = len(x)
        log_R = np.log(column["R"] * 1e6)
        initial = np.zeros((n, m + 2))
        initial[:, m] = column["Rdot"] / column["R"] * 1e-6
        initial[:, m + 1] = log_R
        gas = (column["p_b"] - medium.p_v) / medium.rho
        slope = medium.A * medium.T_inf / medium.K_inf
        par = np.zeros((n, rows.PARAMETERS))
        if m:
            theta = x[:, layout["T"]] / medium.T_inf
            initial[:, :m] = 0.5 * slope * (theta**2 - 1) + (1 - slope) * (theta - 1)
            weights = ball(m).weights
            inverse_mean = weights[m] + (weights[:m] / theta).sum(axis=1)
            par[:, rows.LOG_GAS] = np.log(gas * inverse_mean) + 3 * log_R
        else:
            par[:, rows.LOG_GAS] = np.log(gas) + 3 * medium.kappa * log_R
        par[:, rows.VAPOUR] = medium.p_v / medium.rho
        par[:, rows.AMBIENT] = medium.p_inf / medium.rho
        par[:, rows.SURFACE] = 2 * medium.S / medium.rho * 1e6
        par[:, rows.VISCOSITY] = column["mu"] / medium.rho * 1e6 if "mu" in column else 0.0
        par[:, rows.INVERSE_C] = 1 / medium.c
        par[:, rows.CONDUCTION] = medium.K_inf * medium.T_inf / medium.rho * 1e6
        par[:, rows.KAPPA] = medium.kappa
        par[:, rows.SLOPE] = slope
        par[:, rows.LOG_R0] = np.log(column["R0" if self.start == "acoustic" else "R_eq"] * 1e6)
        par[:, rows.AMPLITUDE] = self.driving.amplitude / medium.rho
        elastic = self.law.table(self._law_values(x))
        mirrored = times * 1e6
        order = None
        if self.start == "laser" and np.any(times < 0) and t0 == 0.0:
            order = np.argsort(np.abs(mirrored), axis=1, kind="stable")
            mirrored = np.take_along_axis(np.abs(mirrored), order, axis=1)
        solution = solve(
            initial,
            par,
            elastic / medium.rho,
            np.full(n, t0 * 1e6),
            mirrored,
            self.driving,
            self.reading,
            self.accuracy,
        )
        if order is not None:
            back = np.argsort(order, axis=1)
            states = np.take_along_axis(solution.states, back[:, :, None], axis=1)
            states[:, :, m] *= np.where(times < 0, -1.0, 1.0)
            solution = Solution(states, solution.status, solution.record)
        return Paths(self, x, times, solution, par, elastic)


@dataclass(frozen=True, eq=False)
class Paths:
    """A batch of integrated members; fields (N, K, …) are computed from the raw solution when asked for."""

    model: BubbleModel
    initial: Array
    times: Array
    solution: Solution
    par: Array
    elastic: Array
    _fields: dict[str, Array] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Array:
        if name not in self._fields:
            compute: Any = getattr(self, f"_{name}", None)
            self._fields[name] = self._constant(name) if compute is None else compute()
        return self._fields[name]

    @property
    def states(self) -> Array:
        """Full state vectors (N, K, n_state) in the model's layout."""
        blocks = [self[f.name].reshape(*self.times.shape, -1) for f in self.model.layout]
        return np.concatenate(blocks, axis=2)

    def _constant(self, name: str) -> Array:
        return np.broadcast_to(self.initial[:, self.model.layout[name].start, None], self.times.shape)

    def _R(self) -> Array:
        return np.exp(self.solution.states[:, :, -1]) * 1e-6

    def _Rdot(self) -> Array:
        return self["R"] * self.solution.states[:, :, -2] * 1e6

    def _theta(self) -> Array:
        tau = self.solution.states[:, :, : self.model.nodes]
        k = np.sqrt(1 + 2 * self.par[:, None, None, rows.SLOPE] * tau)
        return np.asarray(1 + 2 * tau / (k + 1))

    def _T(self) -> Array:
        return self["theta"] * self.model.medium.T_inf

    def _p_b(self) -> Array:
        medium, m = self.model.medium, self.model.nodes
        log_R = self.solution.states[:, :, -1]
        gas = self.par[:, None, rows.LOG_GAS]
        if m:
            weights = ball(m).weights
            inverse_mean = weights[m] + (weights[:m] / self["theta"]).sum(axis=2)
            p = np.exp(gas - 3 * log_R) / inverse_mean
        else:
            p = np.exp(gas - 3 * medium.kappa * log_R)
        return np.asarray(p * medium.rho + medium.p_v)

    def _S(self) -> Array:
        x = self.solution.states[:, :, -1] - self.par[:, None, rows.LOG_R0]
        viscous = 4 * self.par[:, None, rows.VISCOSITY] * self.model.medium.rho * self.solution.states[:, :, -2]
        return np.asarray(evaluate(self.elastic, GRID.span, x) - viscous)


class BubbleTrajectory(Trajectory):
    """One member of a batch; fields are shared with the batch and computed on demand."""

    _paths: Paths
    _member: int

    def __init__(self, paths: Paths, member: int):
        object.__setattr__(self, "_paths", paths)
        object.__setattr__(self, "_member", member)
        object.__setattr__(self, "times", paths.times[member])
        object.__setattr__(self, "layout", paths.model.layout)

    def __getitem__(self, name: str) -> Array:
        return np.asarray(self._paths[name][self._member])

    @property
    def states(self) -> Array:
        return np.asarray(self._paths.states[self._member])
