"""From state vectors to the arrays of the compiled solver."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array
from en4dvar_bubble.dynamics import Dynamics
from en4dvar_bubble.gas import (
    GAS_CONSTANT,
    SATURATION,
    SATURATION_TEMPERATURE,
    kirchhoff,
    mass_fraction,
    mole_fraction,
    saturated_vapour_pressure,
)
from en4dvar_bubble.laws.tabulate import GRID
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.numbers import ACCOMMODATION, P_A
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.arrays import Members
from en4dvar_bubble.solver.lanes import WIDTH

_NO_TABLE = np.zeros((0, GRID.cells, 8))
_NO_SAMPLES = np.zeros((0, len(GRID.nodes)))


class Packed(NamedTuple):
    """N members in the kernel's units and what their laws add to the equations; a call that completes them.

    The elastic parts of the first members in the queue are sampled at once; they can be integrated while the call
    samples the others, which it then makes available.
    """

    members: Members
    memory: Array
    viscous: Array
    pulse: Array
    complete: Callable[[], None]


def pack(model: Dynamics, x: Array, start: Array | float, times: Array, halved: bool = False) -> Packed:
    """States (N, n_state) at ``start`` (µs, one or (N,)), to be integrated to ``times`` (N, K) in µs. ``halved``: with
    halved cells in the elastic tables, whatever the law.
    """
    law, system, values = model.law, model.system, model.law_values(x)
    own = model.parameter_values(x)
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

    # Least damped, hence longest ringing, first, so that the lanes run dry together.
    order = np.argsort(par[:, rows.VISCOSITY], kind="stable")
    first, others = order[:WIDTH], order[WIDTH:]
    available = np.full(1, n_members, dtype=np.int64)
    samples, elastic = _NO_SAMPLES, _NO_TABLE
    own_density = np.ndim(rho) > 0

    def sampled(which: npt.NDArray[np.intp]) -> Array | None:
        """Of some members; the kernel divides by one density, those of their own are divided by here."""
        tabulated = law.samples({name: value[which] for name, value in values.items()})
        return tabulated * (1 / np.asarray(rho)[which])[:, None] if tabulated is not None and own_density else tabulated

    some = None if halved else sampled(first)
    if some is None:
        elastic = law.table(values, halved)
        elastic[..., :6] /= model.medium_of(own, 2).rho  # not what tells of halved cells
    else:
        samples = np.empty((n_members, some.shape[1]))
        samples[first] = some
        available[0] = len(first)

    def complete() -> None:
        try:
            if available[0] < n_members:
                rest = sampled(others)
                samples[others] = np.nan if rest is None else rest
        finally:  # threads may be waiting
            available[0] = n_members

    members = Members(
        counter=np.zeros(1, dtype=np.int64),
        available=available,
        order=order,
        initial=initial,
        parameters=par,
        start=np.full(n_members, start, dtype=float),
        times=np.ascontiguousarray(times),
        samples=samples,
        factor=1.0 if own_density else 1 / rho,
        tables=elastic,
    )
    return Packed(members, memory, viscous, clocks.table, complete)


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
        initial[:, :m] = kirchhoff(theta[:, :m], around)
        wall = theta[:, m] if system.wall else np.ones(len(x))
        weights = system.ball.weights
        share = weights[:m] / theta[:, :m]
        at_wall = weights[m] / wall
        outside = np.zeros(len(x))
        if system.vapour:
            gas_fraction = 1 - mole_fraction(x[:, layout["C"]], around)
            initial[:, m : 2 * m] = gas_fraction[:, :m]
            share = share * gas_fraction[:, :m]
        if system.kinetic:
            gas_wall = initial[:, system.first_memory - 1] = _gas_at_wall(model, par, column, wall, gas_fraction[:, :m])
            at_wall = at_wall * gas_wall
        elif system.vapour:
            outside = saturated_vapour_pressure(wall * medium.T_inf) / medium.rho * at_wall
        par[:, rows.LOG_GAS] = np.log(gas * (share.sum(axis=1) + at_wall) - outside) + 3 * log_R
        if system.wall:
            initial[:, system.first_medium : system.wall_row] = x[:, layout["T_m"]] / around.T_inf - 1
            initial[:, system.wall_row] = kirchhoff(wall, medium)
    else:
        par[:, rows.LOG_GAS] = np.log(gas) + 3 * model.exponent(medium) * log_R
    par[:, rows.LOG_R0] = np.log(column[model.stress_free_radius] * 1e6)
    return initial, par


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
        vapour = mole_fraction(x[:, layout["C"].stop - 1], medium) * before
    elif model.system.vapour:
        vapour = saturated_vapour_pressure(x[:, layout["T"].stop - 1] if model.system.wall else medium.T_inf)
    after = vapour + factor * (before - vapour)
    changed[:, layout["p_b"].start] = after
    if model.system.vapour:
        gas = (1 - mole_fraction(x[:, layout["C"]], around)) * (factor * before / after)[:, None]
        changed[:, layout["C"]] = mass_fraction(np.maximum(1 - gas, 0.0), around)
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
