"""Integrated members as trajectories: fields of the state vector, computed from the raw solution when asked for."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, cast

import numpy as np

from en4dvar.model.forward import Batch, Failure, Trajectory, ValidityLimit
from en4dvar.model.state import Array, StateLayout
from en4dvar_bubble.dynamics import Dynamics
from en4dvar_bubble.gas import from_kirchhoff, mass_fraction, saturated_vapour_pressure
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.driver import Solution
from en4dvar_bubble.solver.integrate import BEYOND, END_TIME, MAX_MACH

THETA, MOLE_FRACTION = "temperature of the gas over that far away", "mole fraction of vapour"


@dataclass(frozen=True, eq=False)
class Paths(Batch):
    """Integrated members: ``initial`` states (N, n_state) at ``start`` (s), ``times`` (N, K) in s, the raw solution."""

    model: Dynamics
    initial: Array
    times: Array
    solution: Solution
    par: Array
    start: Array | float = 0.0
    _fields: dict[str, Any] = field(default_factory=dict)

    @property
    def whole(self) -> bool:  # type: ignore[override]
        """True if no member failed."""
        return not self.solution.status.any()

    @property
    def layout(self) -> StateLayout:  # type: ignore[override]
        return self.model.layout

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, name: Any) -> Any:
        """A field of the state along the paths, (N, K) or (N, K, size), SI, or what is of :data:`OF_WHOLE`; a member by
        its number.
        """
        if isinstance(name, slice):
            return [self[i] for i in range(*name.indices(len(self)))]
        if not isinstance(name, str):
            return self.failure(name) if self.solution.status[name] else BubbleTrajectory(self, name)
        if name not in self._fields:
            estimated = name in {p.name for p in self.model.parameters}
            compute: Any = OF_WHOLE.get(name) or getattr(type(self), f"_{name}", None)
            self._fields[name] = self._constant(name) if estimated or compute is None else compute(self)
        return self._fields[name]

    def failure(self, member: int) -> Failure:
        """Why and when (s) a member's integration ended early."""
        return Failure(self.solution.reason(member), float(self.solution.record[member, END_TIME]) * 1e-6)

    def largest(self, name: str) -> Array:
        """(N,) wall Mach numbers over all steps of the solver; with Rayleigh–Plesset over the stored instants."""
        if name != "wall_mach":
            return np.asarray(np.abs(self[name]).max(axis=1))
        if self.model.radial == "rayleigh-plesset":  # its equations know no speed of sound
            return np.asarray(np.abs(self["Rdot"] / self.medium(1).c).max(axis=1))
        return self.solution.record[:, MAX_MACH]

    def beyond(self, limit: ValidityLimit) -> Array:
        """(N,) since when (s) the wall is faster than the radial equation bears, +inf: never; see :meth:`largest`."""
        if self.model.radial == "rayleigh-plesset":
            over = np.abs(self["Rdot"]) / self.medium(1).c > limit.value
            return np.asarray(np.where(over, self.times, np.inf).min(axis=1))
        return np.asarray(self.solution.record[:, BEYOND] * 1e-6)

    @property
    def states(self) -> Array:  # type: ignore[override]
        """Full state vectors (N, K, n_state) in the model's layout."""
        blocks = [self[f.name].reshape(*self.times.shape, -1) for f in self.model.layout]
        return np.concatenate(blocks, axis=2)

    @property
    def last(self) -> Array:
        """States (N, n_state) at the last instant."""
        solution = replace(self.solution, states=self.solution.states[:, -1:])
        return replace(self, times=self.times[:, -1:], solution=solution, _fields={}).states[:, 0]

    def medium(self, axes: int) -> Medium:
        """See :meth:`Dynamics.medium_of`."""
        return self.model.medium_of(self.model.parameter_values(self.initial), axes)

    def _constant(self, name: str) -> Array:
        return np.broadcast_to(self.initial[:, self.model.layout[name].start, None], self.times.shape)

    def _R(self) -> Array:
        return np.exp(self.solution.states[:, :, -1]) * 1e-6

    def _Rdot(self) -> Array:
        radius: Array = self["R"]
        return radius * self.solution.states[:, :, -2] * 1e6

    def _strain_rate(self) -> Array:
        return np.abs(self.solution.states[:, :, -2]) * 1e6

    def _stretch(self) -> Array:
        return np.exp(self.solution.states[:, :, -1] - self.par[:, None, rows.LOG_R0])

    def _theta(self) -> Array:
        """Temperature of the gas over that far away."""
        system = self.model.system
        tau = self.solution.states[:, :, : system.gas]
        if system.wall:
            tau = np.concatenate([tau, self.solution.states[:, :, system.wall_row, None]], axis=2)
        return from_kirchhoff(tau, self.medium(2))

    def _T(self) -> Array:
        theta: Array = self[THETA]
        return theta * self.medium(2).T_inf

    def _chi(self) -> Array:
        system = self.model.system
        gas = self.solution.states[:, :, system.gas : system.first_medium]
        if system.kinetic:
            gas = np.concatenate([gas, self.solution.states[:, :, system.first_memory - 1, None]], axis=2)
        return 1 - gas

    def _C(self) -> Array:
        return mass_fraction(self[MOLE_FRACTION], self.medium(2))

    def _T_m(self) -> Array:
        system = self.model.system
        return (1 + self.solution.states[:, :, system.first_medium : system.wall_row]) * self.medium(2).T_inf

    def _Z(self) -> Array:
        return self.solution.states[:, :, self.model.system.first_memory : -2] * self.medium(2).rho

    def _p_b(self) -> Array:
        medium, system = self.medium(1), self.model.system
        log_R = self.solution.states[:, :, -1]
        gas = self.par[:, None, rows.LOG_GAS]
        if not system.gas:
            return np.asarray(np.exp(gas - 3 * self.model.exponent(medium) * log_R) * medium.rho + medium.p_v)
        m, weights, theta = system.gas, system.ball.weights, self[THETA]
        share = 1 / theta[:, :, :m]
        wall = theta[:, :, m] if system.wall else np.ones(1)
        at_wall = weights[m] / wall
        content = np.exp(gas - 3 * log_R) * medium.rho
        if system.vapour:
            share = share * (1 - self[MOLE_FRACTION][:, :, :m])
        if system.kinetic:
            at_wall = at_wall * (1 - self[MOLE_FRACTION][:, :, m])
        elif system.vapour:
            content = content + saturated_vapour_pressure(wall * medium.T_inf) * at_wall
        return np.asarray(content / (share @ weights[:m] + at_wall) + medium.p_v)

    def _S(self) -> Array:
        system, rho = self.model.system, self.medium(1).rho
        V = self.solution.states[:, :, -2]
        log_stretch = self.solution.states[:, :, -1] - self.par[:, None, rows.LOG_R0]
        values = self.model.law_values(self.initial)
        stress = self.model.law.elastic_stress(np.exp(log_stretch), values) / rho
        if system.memory:
            stress = stress + self.solution.states[:, :, system.first_memory : -2].sum(axis=2)
        if system.shear or system.strain:
            nu = self.model.law.mean_viscosity(np.abs(V) * 1e6, values, np.exp(log_stretch)) / rho * 1e6
        else:
            nu = self.par[:, None, rows.VISCOSITY]
        return np.asarray((stress - 4 * nu * V) * rho)


OF_WHOLE: dict[str, Callable[[Paths], Any]] = {THETA: Paths._theta, MOLE_FRACTION: Paths._chi}
"""What is computed once from the paths as a whole, by words, which no parameter has for its name."""


@dataclass(frozen=True)
class OfPath:
    """H that reads what :data:`OF_WHOLE` computes: (K,) of a path, (N, K) of many."""

    name: str
    batched: ClassVar[bool] = True

    def __call__(self, trajectory: Any) -> Array:
        values = np.asarray(trajectory[self.name])
        if np.isinf(values).any():
            raise ValueError("the path cannot be followed beyond the readings, to its events")
        return values


class BubbleTrajectory(Trajectory):
    """One member of a batch; fields are shared with the batch and computed on demand."""

    paths: Paths
    member: int

    def __init__(self, paths: Paths, member: int):
        self.__dict__.update(paths=paths, member=member)  # the dataclass is frozen

    @property
    def times(self) -> Array:
        return np.asarray(self.paths.times[self.member])

    @property
    def layout(self) -> StateLayout:
        return self.paths.model.layout

    def __getitem__(self, name: str) -> Array:
        return cast(Array, self.paths[name][self.member])

    def largest(self, name: str) -> float:
        """See :meth:`Paths.largest`."""
        return float(self.paths.largest(name)[self.member])

    def beyond(self, limit: ValidityLimit) -> float:
        """See :meth:`Paths.beyond`."""
        return float(self.paths.beyond(limit)[self.member])

    @property
    def states(self) -> Array:
        return np.asarray(self.paths.states[self.member])
