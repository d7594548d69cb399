"""The NumPy side of the solver: accuracy, packing of parameters, failure reasons."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.driving import Driving, Reading
from en4dvar_bubble.laws.base import GRID
from en4dvar_bubble.solver import equations, integrate
from en4dvar_bubble.solver.caching import stamp_with_sources
from en4dvar_bubble.solver.collocation import ball

stamp_with_sources(integrate.integrate, Path(__file__).parent)

AccuracyName = Literal["fast", "standard", "reference"]

READINGS: dict[Reading, int] = {
    "instantaneous": equations.INSTANTANEOUS,
    "retarded": equations.RETARDED,
    "as-printed": equations.AS_PRINTED,
}

_FIRST_STEP = 1e-3  # µs
_STEPS_IN_DRIVING = 32
_SLOWEST_RATE = (
    0.01  # 1/µs: errors of V = Ṙ/R below rtol times this are not seen (they accumulate in ln R over about 100 µs)
)


@dataclass(frozen=True)
class Accuracy:
    """Temperature nodes in the gas and relative tolerance of the time steps, with the limits of an integration.

    ``step_limit`` bounds the work per member; ``mach_limit`` ends a member whose wall Mach number exceeds it.
    """

    nodes: int = 8
    rtol: float = 1e-5
    step_limit: int = 20_000
    mach_limit: float = np.inf


ACCURACIES: dict[AccuracyName, Accuracy] = {
    "fast": Accuracy(nodes=4, rtol=1e-4),
    "standard": Accuracy(nodes=8, rtol=1e-5),
    "reference": Accuracy(nodes=24, rtol=1e-8),
}


@dataclass(frozen=True)
class Solution:
    """Raw solver output. ``states`` (N, K, m+2): τ nodes, V (1/µs), ln(R/µm); NaN where a member did not get.

    ``status`` (N,) integers, ``record`` (N, 6): steps, rejected steps, largest wall Mach number, largest τ at the
    innermost node, smallest ln R, end time (µs).
    """

    states: Array
    status: np.ndarray
    record: Array

    def reason(self, member: int) -> str:
        """Why a member failed, "" where it did not."""
        return reason(int(self.status[member]), self.record[member])


def reason(status: int, record: Array) -> str:
    """The failure in words."""
    when = f"at t = {record[integrate.END_TIME]:.4g} µs"
    match status:
        case integrate.OK:
            return ""
        case integrate.STEP_LIMIT:
            return f"step limit reached {when}"
        case integrate.NON_FINITE:
            return f"non-finite state {when}"
        case integrate.STEP_UNDERFLOW:
            return f"step size underflow {when}"
        case integrate.MACH_LIMIT:
            return f"model validity: wall Mach {record[integrate.MAX_MACH]:.3g} {when}"
    raise ValueError(f"unknown status {status}")


@cache
def _operators(m: int) -> Array:
    """Collocation operators as one array in the kernel's layout (see ``equations.rhs``)."""
    ops = np.zeros((2 * m + 3, m + 1))
    if m:
        b = ball(m)
        ops[: m + 1], ops[m + 1 : 2 * m + 1] = b.derivative, b.laplacian[:m]
        ops[2 * m + 1], ops[2 * m + 2] = b.y, b.weights
    return ops


def solve(
    initial: Array,
    parameters: Array,
    elastic: Array,
    start: Array,
    times: Array,
    driving: Driving,
    reading: Reading,
    accuracy: Accuracy,
) -> Solution:
    """Integrate N members.

    initial (N, m+2) and parameters (N, 12) in the kernel's units; elastic (N, cells, 8) tables of J_e/ρ; start (N,)
    and times (N, K) in µs, times increasing. Members never influence each other: the bits do not depend on how they
    are batched.
    """
    n_members, n = initial.shape
    m = n - 2
    out = np.empty((n_members, times.shape[1], n))
    status = np.zeros(n_members, dtype=np.int64)
    record = np.zeros((n_members, integrate.RECORD))
    tol = np.full((2, n), accuracy.rtol)
    tol[0, m] = accuracy.rtol * _SLOWEST_RATE
    tol[1, n - 1] = 0.0  # ln R has an absolute tolerance: a relative one of R
    span = driving.grid.span
    silent = driving.amplitude == 0.0
    breaks = np.empty(0) if silent else span[:2].copy()
    inside = (span[1] - span[0]) / _STEPS_IN_DRIVING
    limits = np.array([_FIRST_STEP, inside, float(accuracy.step_limit), accuracy.mach_limit])
    parameters = parameters.copy()
    parameters[:, equations.TABLE] = np.arange(n_members) * (GRID.cells * 8.0)
    integrate.integrate(
        np.ascontiguousarray(initial),
        parameters,
        np.ascontiguousarray(start),
        np.ascontiguousarray(times),
        m,
        _operators(m),
        np.ascontiguousarray(elastic),
        GRID.span,
        driving.table,
        span,
        breaks,
        READINGS[reading],
        tol,
        limits,
        out,
        status,
        record,
    )
    return Solution(out, status, record)
