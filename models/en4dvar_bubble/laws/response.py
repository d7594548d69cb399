"""The stress integral of a law for a prescribed motion of the wall, straight from its rate equations.

Slow and independent of the compiled solver: for the battery and for looking at a law on its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.laws.base import ConstitutiveLaw
from en4dvar_bubble.laws.parameters import columns


@dataclass(frozen=True)
class Cycle:
    """λ(t) = extreme^{sin²(πt/period)}, one closed cycle from rest, ``period`` in s."""

    extreme: float
    period: float

    def stretch(self, t: Array) -> Array:
        return np.asarray(self.extreme ** np.sin(np.pi * t / self.period) ** 2)

    def rate(self, t: Array) -> Array:
        """V = Ṙ/R in 1/s."""
        return np.asarray(np.log(self.extreme) * np.pi / self.period * np.sin(2 * np.pi * t / self.period))


@dataclass(frozen=True)
class Response:
    """J (K,) in Pa at ``times`` (K,) in s, its elastic part, and the work per 4πR0³ (Pa) that the cycle costs:
    −∫ J λ² dλ. ``turnover`` is ∫ |J| λ² |dλ|, what the work is to be compared with.
    """

    times: Array
    J: Array
    work: float
    elastic_work: float
    turnover: float


def respond(law: ConstitutiveLaw, values: Mapping[str, Array], cycle: Cycle, points: int = 400) -> Response:
    """Integrate one member (``values``: name → (1,)) over a cycle, relaxed at its start."""
    from scipy.integrate import solve_ivp

    variables = law.memory(columns(values))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0, cycle.period, points // 8 + 1)
    half = np.diff(edges)[:, None] / 2
    times = (edges[:-1, None] + half * (nodes + 1)).ravel()
    weight = (half * weights).ravel()
    stretch, rate = cycle.stretch(times), cycle.rate(times)
    elastic = law.elastic_stress(stretch[None], values)[0]
    J = elastic - 4 * law.mean_viscosity(np.abs(rate)[None], values, stretch[None])[0] * rate
    if variables:
        theta = np.array([_scalar(v.relaxation_time) for v in variables])
        k = np.array([v.convection for v in variables])

        def rhs(t: float, s: Array) -> Array:
            x, V = cycle.stretch(np.array([t])), float(cycle.rate(np.array(t)))
            a = np.array([_scalar(v.stiffness_at(x)) for v in variables])
            b = np.array([_scalar(v.equilibrium_at(x)) for v in variables])
            return np.asarray((b - s) / theta + V * (k * s + a))

        start = np.array([_scalar(v.equilibrium_at(np.ones(1))) for v in variables])
        stiffest = max(abs(_scalar(v.stiffness_at(np.ones(1)))) for v in variables) or 1.0
        solution = solve_ivp(
            rhs, (0, cycle.period), start, "LSODA", t_eval=times, rtol=1e-10, atol=1e-11 * stiffest,
            max_step=cycle.period / 50,
        )  # fmt: skip
        J = J + solution.y.sum(axis=0)
    flux = weight * stretch**3 * rate
    turnover = float(np.sum((np.abs(J) + np.abs(elastic)) * np.abs(flux)))
    return Response(times, J, -float(J @ flux), -float(elastic @ flux), turnover)


def _scalar(value: float | Array) -> float:
    return float(np.ravel(value)[0])
