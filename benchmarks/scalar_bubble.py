"""The bubble of the solver benchmark one member at a time, for general-purpose integrators.

The same equations, unknowns and collocation nodes as the lanes kernel (``en4dvar_bubble.solver.equations``: Kirchhoff
temperatures, V = Ṙ/R, u = ln R; pressure from the mass of gas, d ln p/dt from the wall flux), written as one scalar
function compiled by numba, so that only the integrators are compared. Units: µm, µs, pressures over the density.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba as nb
import numpy as np

from en4dvar_bubble.medium import WATER_25C, Medium
from en4dvar_bubble.solver.collocation import ball

Array = np.ndarray
PULSE = (4.5, 5.5)  # µs: the histotripsy pulse of the paper
_AMPLITUDE, _FREQUENCY, _EXPONENT, _DELAY = -24e6, 1.0, 3.7, 5.0
_SLOWEST_RATE = 0.01  # 1/µs: absolute tolerance of V per rtol, as in the lanes kernel


@nb.njit(cache=True)
def rhs(t, y, out, c, derivative, laplacian, radii, weights):
    """dy/dt to ``out``. c: ln gas, p_∞, 2S, ν, 1/c, E factor, κ, slope, R0, G, α (see :func:`constants`)."""
    m = len(y) - 2
    kappa, a = c[6], c[7]
    V, u = y[m], y[m + 1]
    R = math.exp(u)
    inverse_mean = weights[m]
    for i in range(m):
        k = math.sqrt(max(2 * a * y[i] + 1, 1e-12))
        inverse_mean += weights[i] / (2 * y[i] / (k + 1) + 1)
    p = math.exp(c[0] - 3 * u) / inverse_mean
    E = c[5] / (p * R * R)
    wall = 0.0
    for j in range(m):
        wall += derivative[m, j] * y[j]
    rate = 3 * (kappa - 1) * E * wall - 3 * kappa * V
    k1 = (kappa - 1) / kappa
    for i in range(m):
        first = 0.0
        second = 0.0
        for j in range(m):
            first += derivative[i, j] * y[j]
            second += laplacian[i, j] * y[j]
        k = math.sqrt(max(2 * a * y[i] + 1, 1e-12))
        conduct = k1 * k * (2 * y[i] / (k + 1) + 1)
        drift = first * radii[i]
        out[i] = drift * V + E * (conduct * second - k1 * first * first) + (conduct + drift / (3 * kappa)) * rate
    f = g = 0.0
    phase = 2 * math.pi * _FREQUENCY * (t - _DELAY)
    if abs(phase) < math.pi:
        base = 0.5 * (1 + math.cos(phase))
        if base > 0.0:
            f = c[11] * base**_EXPONENT
            g = -f / base * _EXPONENT * 0.5 * math.sin(phase) * 2 * math.pi * _FREQUENCY
    s = c[8] / R
    s2 = s * s
    s4 = s2 * s2
    soft, stiff = c[9] * (3 * c[10] - 1) / 2, 2 * c[9] * c[10]
    J = soft * (5 - 4 * s - s4) + stiff * (0.675 + s4 * s4 / 8 + s4 * s / 5 + s2 - 2 / s)
    Jx = soft * 4 * (s + s4) - stiff * (s4 * s4 + s4 * s + 2 * s2 + 2 / s)
    surface = c[2] / R
    mach = R * V * c[4]
    P = p - c[1] - f - surface + J - 4 * c[3] * V
    slope = p * rate + (surface + Jx) * V - g
    Ric = R * c[4]
    top = R * R * V * V * (1.5 * mach - 2.5) + (1 + mach) * P + Ric * slope
    out[m] = top / (R * R * (1 - mach) + 4 * c[3] * Ric)
    out[m + 1] = V


@nb.njit(cache=True)
def jacobian(t, y, f, jac, c, derivative, laplacian, radii, weights):
    """∂f/∂y to ``jac`` by forward differences, compiled: cheaper than the integrators' own through Python."""
    n = len(y)
    rhs(t, y, f, c, derivative, laplacian, radii, weights)
    moved = y.copy()
    g = np.empty(n)
    for j in range(n):
        h = 1.5e-8 * max(abs(y[j]), 1e-3)
        moved[j] = y[j] + h
        rhs(t, moved, g, c, derivative, laplacian, radii, weights)
        moved[j] = y[j]
        for i in range(n):
            jac[i, j] = (g[i] - f[i]) / h


def constants(G: float, alpha: float, mu: float, R0: float, medium: Medium = WATER_25C) -> Array:
    """The kernel's constants of one member from SI values."""
    rho, radius = medium.rho, R0 * 1e6
    gas = (medium.p_inf + 2 * medium.S / R0) / rho
    return np.array(
        [
            math.log(gas) + 3 * math.log(radius),
            medium.p_inf / rho,
            2 * medium.S / rho * 1e6,
            mu / rho * 1e6,
            1 / medium.c,
            medium.K_inf * medium.T_inf / rho * 1e6,
            medium.kappa,
            medium.A * medium.T_inf / medium.K_inf,
            radius,
            G / rho,
            alpha / 1.0,
            _AMPLITUDE / rho,
        ]
    )


@dataclass(frozen=True)
class Problem:
    """Members (rows of constants), observation times in µs, and the collocation operators."""

    members: Array
    times: Array
    nodes: int

    @property
    def operators(self) -> tuple[Array, ...]:
        b = ball(self.nodes)
        return b.derivative, np.ascontiguousarray(b.laplacian[: self.nodes]), b.x, b.weights

    def start(self, member: Array) -> Array:
        """At rest at R0."""
        y = np.zeros(self.nodes + 2)
        y[-1] = math.log(member[8])
        return y


Integrator = Callable[[Problem, Array, float], Array]


def lsoda(problem: Problem, member: Array, rtol: float) -> Array:
    """R (µm) at the observation times by scipy's LSODA (odeint: the whole loop is compiled)."""
    from scipy.integrate import odeint

    arguments = (member, *problem.operators)
    out = np.empty(problem.nodes + 2)

    def f(t: float, y: Array) -> Array:
        rhs(t, y, out, *arguments)
        return out

    return _two_pieces(
        problem,
        member,
        lambda y, times, longest: odeint(
            f,
            y,
            times,
            tfirst=True,
            rtol=rtol,
            atol=_atol(problem, rtol),
            hmax=longest,
            mxstep=100_000,
            tcrit=times[-1:],
        ),
    )


def cvode(problem: Problem, member: Array, rtol: float) -> Array:
    """The same by SUNDIALS CVODE (scikit-sundae), BDF, dense Jacobian from :func:`jacobian`."""
    from sksundae.cvode import CVODE

    arguments = (member, *problem.operators)

    def f(t: float, y: Array, yp: Array) -> None:
        rhs(t, y, yp, *arguments)

    work = np.empty(problem.nodes + 2)

    def jac(t: float, y: Array, yp: Array, out: Array) -> None:
        jacobian(t, y, work, out, *arguments)

    def piece(y: Array, times: Array, longest: float) -> Array:
        solver = CVODE(
            f,
            jacfn=jac,
            rtol=rtol,
            atol=_atol(problem, rtol),
            max_step=longest,
            max_num_steps=100_000,
            linsolver="dense",
        )
        grid = times if len(times) > 2 else np.array([times[0], times.mean(), times[-1]])  # two would ask for all steps
        solution = solver.solve(grid, y)
        if not solution.success:
            raise RuntimeError(solution.message)
        return np.asarray(solution.y)[[0, -1] if len(times) == 2 else slice(None)]

    return _two_pieces(problem, member, piece)


def _atol(problem: Problem, rtol: float) -> Array:
    atol = np.full(problem.nodes + 2, rtol)
    atol[-2] = rtol * _SLOWEST_RATE
    return atol


def _two_pieces(problem: Problem, member: Array, integrate: Callable[[Array, Array, float], Array]) -> Array:
    """Through the pulse with short steps, then to the last observation; at rest before the pulse."""
    begin, end = PULSE
    y = problem.start(member)
    during = problem.times[(problem.times > begin) & (problem.times < end)]
    after = problem.times[problem.times >= end]
    first = integrate(y, np.array([begin, *during, end]), (end - begin) / 32)
    later = integrate(first[-1], np.unique([end, *after]), 0.0)
    before = np.full(int(np.sum(problem.times <= begin)), y[-1])
    skip = 0 if len(after) and after[0] == end else 1
    return np.exp(np.concatenate([before, first[1:-1, -1], later[skip:, -1]]))


def run(integrator: Integrator, problem: Problem, rtol: float) -> Array:
    """R (N, K) in µm of all members."""
    return np.array([integrator(problem, member, rtol) for member in problem.members])
