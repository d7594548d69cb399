"""From state vectors to the arrays of the compiled solver."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.dynamics import Dynamics
from en4dvar_bubble.gas import (
    GAS_CONSTANT,
    SATURATION,
    SATURATION_TEMPERATURE,
    kirchhoff,
    mole_fraction,
    saturated_vapour_pressure,
)
from en4dvar_bubble.laws.tabulate import GRID, VISCOUS_GRID
from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.collocation import ball
from en4dvar_bubble.solver.driver import Queue, Tables
from en4dvar_bubble.solver.lanes import WIDTH


def law_tables(model: Dynamics, values: Mapping[str, Array], queue: Queue) -> tuple[Tables, Callable[[], None]]:
    """The laws of N members as tables in the kernel's units, and a call that completes them.

    The laws of the first members in the queue are sampled at once; they can be integrated while the call samples the
    others, which it then makes available.
    """
    law, rho = model.law, model.medium.rho
    n_members = len(queue.order)
    first, others = queue.order[:WIDTH], queue.order[WIDTH:]
    some = law.samples({name: value[first] for name, value in values.items()})
    if some is None:
        tables = Tables(elastic=law.table(values) / rho)
    else:
        samples = np.empty((n_members, some.shape[1]))
        samples[first] = some
        queue.available[0] = len(first)
        tables = Tables(samples=samples, factor=1 / rho)

    def complete() -> None:
        try:
            if queue.available[0] < n_members:
                rest = law.samples({name: value[others] for name, value in values.items()})
                tables.samples[others] = np.nan if rest is None else rest
        finally:  # threads may be waiting
            queue.available[0] = n_members

    if model.system.shear:
        tables = replace(tables, viscous=law.viscous_table(values) / rho * 1e6)
    if model.system.memory:
        memory = law.memory_tables(values)
        tables = replace(tables, memory=np.stack([memory.stiffness, memory.equilibrium], axis=2) / rho)
    return tables, complete


def pack(model: Dynamics, x: Array) -> tuple[Array, Array]:
    """States (N, n_state) as initial values (N, n) and parameters (N, rows) of the solver."""
    medium, layout, system = model.medium, model.layout, model.system
    column = {name: x[:, s.start] for name, s in layout.slices.items()}
    log_R = np.log(column["R"] * 1e6)
    initial = np.zeros((len(x), system.size))
    initial[:, -2] = column["Rdot"] / column["R"] * 1e-6
    initial[:, -1] = log_R
    par = np.tile(_constants(model), (len(x), 1))
    gas = (column["p_b"] - medium.p_v) / medium.rho
    if system.gas:
        m = system.gas
        theta = x[:, layout["T"]] / medium.T_inf
        initial[:, :m] = kirchhoff(theta[:, :m], medium)
        wall = theta[:, m] if system.wall else np.ones(len(x))
        share = ball(m).weights[:m] / theta[:, :m]
        at_wall = ball(m).weights[m] / wall
        outside = np.zeros(len(x))
        if system.vapour:
            gas_fraction = 1 - mole_fraction(x[:, layout["C"]], medium)
            initial[:, m : 2 * m] = gas_fraction
            share = share * gas_fraction
            outside = saturated_vapour_pressure(wall * medium.T_inf) / medium.rho * at_wall
        par[:, rows.LOG_GAS] = np.log(gas * (share.sum(axis=1) + at_wall) - outside) + 3 * log_R
        if system.wall:
            initial[:, system.first_medium : system.wall_row] = x[:, layout["T_m"]] / medium.T_inf - 1
            initial[:, system.wall_row] = kirchhoff(wall, medium)
    else:
        par[:, rows.LOG_GAS] = np.log(gas) + 3 * model.exponent * log_R
    if system.memory:
        initial[:, system.first_memory : -2] = x[:, layout["Z"]] / medium.rho
        memory = model.law.memory_tables(model.law_values(x))
        member = np.arange(len(x), dtype=float)
        for j in range(system.memory):
            at = rows.MEMORY + rows.PER_MEMORY * j
            par[:, at], par[:, at + 1] = memory.relaxation_time[:, j] * 1e6, memory.convection[j]
            par[:, at + 2] = (member * system.memory + j) * (2 * GRID.cells * 8)

    par[:, rows.LOG_R0] = np.log(column[model.stress_free_radius] * 1e6)
    if system.shear:
        par[:, rows.VISCOUS_TABLE] = np.arange(len(x), dtype=float) * (VISCOUS_GRID.cells * 8)
    elif "mu" in column:
        par[:, rows.VISCOSITY] = column["mu"] / medium.rho * 1e6
    return initial, par


def _constants(model: Dynamics) -> Array:
    """The parameter rows of the solver that are the same for every member, (rows,); zeros elsewhere."""
    medium, system = model.medium, model.system
    row = np.zeros(rows.PARAMETERS + rows.PER_MEMORY * system.memory)
    row[rows.VAPOUR] = medium.p_v / medium.rho
    row[rows.AMBIENT] = medium.p_inf / medium.rho
    row[rows.SURFACE] = 2 * medium.S / medium.rho * 1e6
    row[rows.INVERSE_C] = 0.0 if system.radial == "rayleigh-plesset" else 1 / medium.c
    row[rows.CONDUCTION] = medium.K_inf * medium.T_inf / medium.rho * 1e6
    row[rows.KAPPA] = medium.kappa if system.gas else model.exponent
    row[rows.SLOPE] = medium.conduction_slope
    row[rows.AMPLITUDE] = model.driving.amplitude / medium.rho
    row[rows.TAIT_B] = medium.tait_B / medium.rho
    row[rows.TAIT_N] = medium.tait_n
    row[rows.DIFFUSION] = medium.D_v * 1e6
    row[rows.DIFFUSION_P] = medium.D_p
    row[rows.DIFFUSION_T] = medium.D_T
    row[rows.SATURATION] = SATURATION / medium.rho
    row[rows.SATURATION_T] = SATURATION_TEMPERATURE / medium.T_inf
    R_v = GAS_CONSTANT / medium.M_v
    row[rows.LATENT] = medium.L_v / (R_v * medium.T_inf) * medium.D_v * medium.rho / (medium.K_inf * medium.T_inf)
    row[rows.MEDIUM_K] = medium.K_m / medium.K_inf
    row[rows.MEDIUM_D] = medium.K_m / (medium.rho * medium.c_m) * 1e6
    row[rows.HEATING] = 12 / (medium.c_m * medium.T_inf)
    return row
