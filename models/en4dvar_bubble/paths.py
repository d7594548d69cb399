"""From state vectors to the arrays of the compiled solver, and back: integrated members as trajectories, whose fields
of the state vector are computed from the raw solution when they are asked for.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, cast

import numpy as np

from en4dvar.model.forward import Batch, Failure, Trajectory, ValidityLimit
from en4dvar.model.state import Array, StateLayout
from en4dvar_bubble.dynamics import Dynamics
from en4dvar_bubble.laws.tabulate import GRID
from en4dvar_bubble.medium import GAS_CONSTANT, SATURATION, SATURATION_TEMPERATURE, Medium, saturated_vapour_pressure
from en4dvar_bubble.numbers import ACCOMMODATION, P_A
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.arrays import Members
from en4dvar_bubble.solver.driver import Solution, System
from en4dvar_bubble.solver.integrate import BEYOND, END_TIME, MAX_MACH, SMEAR

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
    def raw(self) -> Array:
        """(N, K, n) of the solver."""
        return self.solution.states

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
            if not self.solution.status[name]:
                return BubbleTrajectory(self, name)
            return Failure(self.solution.reason(name), float(self.solution.record[name, END_TIME]) * 1e-6)
        if name not in self._fields:
            estimated = name in {p.name for p in self.model.parameters}
            compute = None if estimated else OF_WHOLE.get(name)
            self._fields[name] = compute(self) if compute else self._constant(name)
        return self._fields[name]

    def largest(self, name: str) -> Array:
        """(N,) wall Mach numbers over all steps of the solver; with Rayleigh–Plesset over the stored instants. What
        a whole path is smeared by.
        """
        if name == "smeared":
            return self.solution.record[:, SMEAR]
        if name != "wall_mach":
            return np.asarray(np.abs(self[name]).max(axis=1))
        if self.model.radial == "rayleigh-plesset":  # its equations know no speed of sound
            return np.asarray(np.abs(self["Rdot"] / self.medium(1).c).max(axis=1))
        return self.solution.record[:, MAX_MACH]

    def beyond(self, limit: ValidityLimit) -> Array:
        """(N,) since when (s) the wall is faster than the radial equation bears, +inf: never; see :meth:`largest`."""
        if limit.name == "smeared":
            return np.where(self.largest(limit.name) > limit.value, -np.inf, np.inf)
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
        return self.model.medium_of(self.model.parameter_values(self.initial), axes)

    def _constant(self, name: str) -> Array:
        return np.broadcast_to(self.initial[:, self.model.layout[name].start, None], self.times.shape)

    def _theta(self) -> Array:
        """Temperature of the gas over that far away."""
        system = self.model.system
        tau = self.raw[:, :, : system.gas]
        if system.wall:
            tau = np.concatenate([tau, self.raw[:, :, system.wall_row, None]], axis=2)
        return self.medium(2).from_kirchhoff(tau)

    def _chi(self) -> Array:
        system = self.model.system
        gas = self.raw[:, :, system.gas : system.first_medium]
        if system.kinetic:
            gas = np.concatenate([gas, self.raw[:, :, system.first_memory - 1, None]], axis=2)
        return 1 - gas

    def _p_b(self) -> Array:
        medium, system, log_R = self.medium(1), self.model.system, self.raw[:, :, -1]
        gas = self.par[:, None, rows.LOG_GAS]
        if not system.gas:
            return np.asarray(np.exp(gas - 3 * self.model.exponent(medium) * log_R) * medium.rho + medium.p_v)
        total, outside = _weighed(system, medium, self[THETA], 1 - self[MOLE_FRACTION] if system.vapour else None)
        return np.asarray((np.exp(gas - 3 * log_R) * medium.rho + outside) / total + medium.p_v)

    def _S(self) -> Array:
        system, rho, V = self.model.system, self.medium(1).rho, self.raw[:, :, -2]
        law, stretch = self.model.law, OF_WHOLE["stretch"](self)  # a law may have a parameter of that name
        values = self.model.law_values(self.model.parameter_values(self.initial))
        stress = law.elastic_stress(stretch, values) / rho
        if system.memory:
            stress = stress + self.raw[:, :, system.first_memory : -2].sum(axis=2)
        nu = law.mean_viscosity(np.abs(V) * 1e6, values, stretch) / rho * 1e6
        return np.asarray((stress - 4 * nu * V) * rho)


OF_WHOLE: dict[str, Callable[[Paths], Any]] = {
    "R": lambda p: np.exp(p.raw[:, :, -1]) * 1e-6,
    "Rdot": lambda p: p["R"] * p.raw[:, :, -2] * 1e6,
    "strain_rate": lambda p: np.abs(p.raw[:, :, -2]) * 1e6,
    "stretch": lambda p: np.exp(p.raw[:, :, -1] - p.par[:, None, rows.LOG_R0]),
    THETA: Paths._theta,
    MOLE_FRACTION: Paths._chi,
    "T": lambda p: p[THETA] * p.medium(2).T_inf,
    "C": lambda p: p.medium(2).mass_fraction(p[MOLE_FRACTION]),
    "T_m": lambda p: (1 + p.raw[:, :, p.model.system.first_medium : p.model.system.wall_row]) * p.medium(2).T_inf,
    "Z": lambda p: p.raw[:, :, p.model.system.first_memory : -2] * p.medium(2).rho,
    "p_b": Paths._p_b,
    "S": Paths._S,
}
"""What is computed once from the paths as a whole: fields of the state, and by words, which no parameter has for its
name, what else is read.
"""


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

    def __init__(self, paths: Paths, member: int):  # the dataclass is frozen
        self.__dict__.update(paths=paths, member=member, times=paths.times[member], layout=paths.layout)

    def __getitem__(self, name: str) -> Array:
        return cast(Array, self.paths[name][self.member])

    def largest(self, name: str) -> float:
        return float(self.paths.largest(name)[self.member])

    def beyond(self, limit: ValidityLimit) -> float:
        return float(self.paths.beyond(limit)[self.member])

    @property
    def states(self) -> Array:
        return np.asarray(self.paths.states[self.member])


_NO_TABLE = np.zeros((0, GRID.cells, 8))
_NO_SAMPLES = np.zeros((0, len(GRID.nodes)))


def pack(
    model: Dynamics, x: Array, start: Array | float, times: Array, halved: bool = False
) -> tuple[Members, Array, Array, Array]:
    """States (N, n_state) at ``start`` (µs, one or (N,)), to be integrated to ``times`` (N, K) in µs, in the kernel's
    units; tables of memory, viscosity and pulse. ``halved``: with halved cells in the elastic ones, whatever the law.
    """
    law, system, own = model.law, model.system, model.parameter_values(x)
    values = model.law_values(own)
    rho = model.medium_of(own).rho
    initial, par = _states(model, x, own)
    n_members = len(x)
    clocks = model.driving.of_members(own)
    par[:, rows.PULSE_SHIFT], par[:, rows.PULSE_RATE], par[:, rows.PULSE_TABLE] = clocks[:3]
    memory = viscous = _NO_TABLE
    if system.memory:
        memory = _memory(model, values, initial, par, x, model.medium_of(own, 1).rho)
    if system.shear or system.strain:
        viscous = law.viscous_table(values) / model.medium_of(own, 2).rho * 1e6
        par[:, rows.VISCOUS_TABLE] = np.arange(n_members, dtype=float) * (viscous.shape[1] * 8)
    elif "mu" in values:
        par[:, rows.VISCOSITY] = values["mu"] / rho * 1e6

    samples, elastic, own_density = None if halved else law.samples(values), _NO_TABLE, np.ndim(rho) > 0
    if samples is None:
        samples, elastic = _NO_SAMPLES, law.table(values, halved)
        elastic[..., :6] /= model.medium_of(own, 2).rho  # not what tells of halved cells
    elif own_density:  # the kernel divides by one density
        samples *= (1 / np.asarray(rho))[:, None]

    members = Members(
        counter=np.zeros(1, dtype=np.int64),
        # Least damped, hence longest ringing, first, so that the lanes run dry together.
        order=np.argsort(par[:, rows.VISCOSITY], kind="stable"),
        initial=initial,
        parameters=par,
        start=np.full(n_members, start, dtype=float),
        times=np.ascontiguousarray(times),
        samples=samples,
        factor=1.0 if own_density else 1 / rho,
        tables=elastic,
    )
    return members, memory, viscous, clocks.table


def _states(model: Dynamics, x: Array, own: Mapping[str, Array]) -> tuple[Array, Array]:
    """Initial values (N, n) and parameters (N, rows) of states (N, n_state), without what the law adds to both."""
    medium, layout, system = model.medium_of(own), model.layout, model.system
    column = {name: x[:, s.start] for name, s in layout.slices.items()}
    log_R = np.log(column["R"] * 1e6)
    initial = np.zeros((len(x), system.size))
    initial[:, -2] = column["Rdot"] / column["R"] * 1e-6
    initial[:, -1] = log_R
    par = _constants(model, medium, own, len(x))
    gas = (column["p_b"] - medium.p_v) / medium.rho
    if system.gas:
        m = system.gas
        around = model.medium_of(own, 1)
        theta = x[:, layout["T"]] / around.T_inf
        initial[:, :m] = around.kirchhoff(theta[:, :m])
        wall = theta[:, m] if system.wall else np.ones(len(x))
        fractions = None
        if system.vapour:
            fractions = 1 - around.mole_fraction(x[:, layout["C"]])
            initial[:, m : 2 * m] = fractions[:, :m]
            if system.kinetic:
                fractions[:, m] = _gas_at_wall(model, par, column, wall, fractions[:, :m])
                initial[:, system.first_memory - 1] = fractions[:, m]
        total, outside = _weighed(system, medium, theta, fractions)
        par[:, rows.LOG_GAS] = np.log(gas * total - outside / medium.rho) + 3 * log_R
        if system.wall:
            initial[:, system.first_medium : system.wall_row] = x[:, layout["T_m"]] / around.T_inf - 1
            initial[:, system.wall_row] = medium.kirchhoff(wall)
    else:
        par[:, rows.LOG_GAS] = np.log(gas) + 3 * model.exponent(medium) * log_R
    par[:, rows.LOG_R0] = np.log(column[model.stress_free_radius] * 1e6)
    return initial, par


def _weighed(system: System, medium: Medium, theta: Array, gas: Array | None) -> tuple[Array, Array]:
    """⟨Y/θ⟩ of temperatures θ and fractions Y of gas (…, nodes), and what the vapour at the wall adds to it, in Pa."""
    m, weights = system.gas, system.ball.weights
    wall = theta[..., m] if system.wall else np.ones(theta.shape[:-1])
    shares, at_wall, outside = weights[:m] / theta[..., :m], weights[m] / wall, np.zeros_like(wall)
    if gas is not None:
        shares = shares * gas[..., :m]
        if system.kinetic:
            at_wall = at_wall * gas[..., m]
        else:
            outside = saturated_vapour_pressure(wall * medium.T_inf) * at_wall
    return shares.sum(axis=-1) + at_wall, outside


def _gas_at_wall(model: Dynamics, par: Array, column: Mapping[str, Array], theta: Array, gas_fraction: Array) -> Array:
    """The positive Y_w (N,) of the finite rate in :mod:`solver.general`, which a changed state need not hold."""
    p, R, slope = column["p_b"], column["R"] * 1e6, model.system.ball.derivative[-1]
    power = par[:, rows.DIFFUSION_P], par[:, rows.DIFFUSION_T]
    rho = model.medium_of(column).rho
    diffusion = par[:, rows.DIFFUSION] * (par[:, rows.AMBIENT] * rho / p) ** power[0] * theta ** power[1]
    crossing = par[:, rows.CROSSING] * np.sqrt(theta) * R / diffusion
    saturation = par[:, rows.SATURATION] * rho * np.exp(-par[:, rows.SATURATION_T] / theta)
    half, inside = (crossing * (saturation / p - 1) + slope[-1]) / 2, (gas_fraction * slope[:-1]).sum(axis=1)
    root = np.sqrt(np.maximum(half**2 - crossing * inside, 0.0))
    return np.asarray(np.where(half > 0, -inside / (half + root), (root - half) / np.maximum(crossing, 1e-300)))


def with_gas(model: Dynamics, x: Array, factor: Array) -> Array:
    """States (N, n_state) with ``factor`` (N,) times the gas of ``x``, and its temperatures and pressure of vapour."""
    own, layout, changed = model.parameter_values(x), model.layout, np.array(x)
    medium, around = model.medium_of(own), model.medium_of(own, 1)
    before = x[:, layout["p_b"].start]
    vapour: float | Array = medium.p_v
    if model.system.kinetic:
        vapour = medium.mole_fraction(x[:, layout["C"].stop - 1]) * before
    elif model.system.vapour:
        vapour = saturated_vapour_pressure(x[:, layout["T"].stop - 1] if model.system.wall else medium.T_inf)
    after = vapour + factor * (before - vapour)
    changed[:, layout["p_b"].start] = after
    if model.system.vapour:
        gas = (1 - around.mole_fraction(x[:, layout["C"]])) * (factor * before / after)[:, None]
        changed[:, layout["C"]] = around.mass_fraction(np.maximum(1 - gas, 0.0))
    return changed


def _memory(
    model: Dynamics, values: Mapping[str, Array], initial: Array, par: Array, x: Array, rho: float | Array
) -> Array:
    """Tables of the memory variables; writes their initial values and parameters. ``rho`` is one density, or (N, 1)."""
    system = model.system
    initial[:, system.first_memory : -2] = x[:, model.layout["Z"]] / rho
    memory = model.law.memory_tables(values)
    member = np.arange(len(x), dtype=float)
    for j in range(system.memory):
        at = rows.MEMORY + rows.PER_MEMORY * j
        par[:, at], par[:, at + 1] = memory.relaxation_time[:, j] * 1e6, memory.convection[j]
        par[:, at + 2] = (member * system.memory + j) * (2 * GRID.cells * 8)
    tables = np.stack([memory.stiffness, memory.equilibrium], axis=2)
    return np.asarray((tables / np.reshape(rho, (-1, 1, 1, 1, 1))).reshape(-1, 1, 8))


def _constants(model: Dynamics, medium: Medium, own: Mapping[str, Array], n_members: int) -> Array:
    """The parameters (N, rows) of the solver that come from the medium and the driving; zeros elsewhere."""
    system = model.system
    par = np.zeros((n_members, rows.PARAMETERS + rows.PER_MEMORY * system.memory))
    par[:, rows.VAPOUR] = medium.p_v / medium.rho
    par[:, rows.AMBIENT] = medium.p_inf / medium.rho
    par[:, rows.SURFACE] = 2 * medium.S / medium.rho * 1e6
    par[:, rows.INVERSE_C] = 0.0 if system.radial == "rayleigh-plesset" else 1 / medium.c
    par[:, rows.CONDUCTION] = medium.K_inf * medium.T_inf / medium.rho * 1e6
    par[:, rows.KAPPA] = medium.kappa if system.gas else model.exponent(medium)
    par[:, rows.SLOPE] = medium.conduction_slope
    par[:, rows.AMPLITUDE] = own.get(P_A.name, model.driving.amplitude) / medium.rho
    par[:, rows.TAIT_B] = medium.tait_B / medium.rho
    par[:, rows.TAIT_N] = medium.tait_n
    par[:, rows.DIFFUSION] = medium.D_v * 1e6
    par[:, rows.DIFFUSION_P] = medium.D_p
    par[:, rows.DIFFUSION_T] = medium.D_T
    par[:, rows.SATURATION] = SATURATION / medium.rho
    par[:, rows.SATURATION_T] = SATURATION_TEMPERATURE / medium.T_inf
    par[:, rows.IMAGE] = model.image(own) * 1e-6
    R_v = GAS_CONSTANT / medium.M_v
    par[:, rows.CROSSING] = own.get(ACCOMMODATION.name, 0.0) * np.sqrt(R_v * medium.T_inf / (2 * np.pi))
    par[:, rows.LATENT] = medium.L_v / (R_v * medium.T_inf) * medium.D_v * medium.rho / (medium.K_inf * medium.T_inf)
    par[:, rows.MEDIUM_K] = medium.K_m / medium.K_inf
    par[:, rows.MEDIUM_D] = medium.K_m / (medium.rho * medium.c_m) * 1e6
    par[:, rows.HEATING] = 12 / (medium.c_m * medium.T_inf)
    return par
