"""Every registered law in the compiled solver against a direct scipy integration with the law's own rate equations."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from en4dvar_bubble import BubbleModel, Medium, get_law
from en4dvar_bubble.laws.loading import available
from en4dvar_bubble.laws.tabulate import GRID, differentiate
from en4dvar_bubble.solver.driver import ACCURACIES
from en4dvar_bubble.tables import evaluate

R_MAX, R_EQ = 100e-6, 30e-6
TIMES = np.linspace(0, 40e-6, 201)
MEDIUM = Medium()


def direct(law, values):
    """R(t) of Keller–Miksis in pressure with a polytropic gas, and J(t); dJ/dt with the R̈ of the viscous part,
    d(μ̄V)/dV = μ(2√3 |V|), solved for."""
    p = SimpleNamespace(**{n: v[:, None] for n, v in values.items()})
    variables = law.memory(p)
    scalar = lambda x: float(np.ravel(x)[0])  # noqa: E731
    at = lambda source, x: scalar(source(np.array([x])) if callable(source) else source)  # noqa: E731
    elastic = law.table(values)
    slope = differentiate(elastic)
    theta = [scalar(v.relaxation_time) for v in variables]
    tension = scalar(values[law.rest_tension]) if law.rest_tension else MEDIUM.S
    rho, c, kappa, surface = MEDIUM.rho, MEDIUM.c, MEDIUM.kappa, 2 * tension
    rest = (MEDIUM.p_inf + surface / R_EQ) * (R_EQ / R_MAX) ** 3

    def local_viscosity(V, x):
        if law.strain_dependent:
            return scalar(law.strained_viscosity(np.array([x]), p))
        if law.shear_dependent:
            return scalar(law.viscosity(np.array([2 * np.sqrt(3) * abs(V)]), p))
        return scalar(values.get("mu", 0.0))

    def stress(R, V, s):
        x = np.array([[np.log(R / R_EQ)]])
        mean = law.mean_viscosity(np.array([[abs(V)]]), values, R / R_EQ)[0, 0]
        return evaluate(elastic, GRID.span, x)[0, 0] + sum(s) - 4 * mean * V

    def rhs(t, y):
        R, U, s = y[0], y[1], y[2:]
        V, stretch, mach = U / R, R / R_EQ, U / c
        change = [
            (at(v.equilibrium, stretch) - q) / th + V * (v.convection * q + at(v.stiffness, stretch))
            for v, q, th in zip(variables, s, theta, strict=True)
        ]
        gas = rest * (R_MAX / R) ** (3 * kappa)
        mu = local_viscosity(V, stretch)
        rise = (local_viscosity(V, stretch * (1 + 1e-5)) - local_viscosity(V, stretch * (1 - 1e-5))) / 2e-5
        pressure = gas - MEDIUM.p_inf - surface / R + stress(R, V, s)
        known = (
            -3 * kappa * gas * V + surface / R * V + evaluate(slope, GRID.span, np.array([[np.log(stretch)]]))[0, 0] * V
        )
        known += sum(change) + 4 * (mu - rise) * V**2
        force = (1 + mach) / rho * pressure + R / (rho * c) * known - 1.5 * (1 - mach / 3) * U**2
        return [U, force / ((1 - mach) * R + 4 * mu / (rho * c)), *change]

    start = [R_MAX, 0.0, *(at(v.equilibrium, R_MAX / R_EQ) for v in variables)]
    atol = [1e-14, 1e-8, *([1e-4] * len(variables))]
    path = solve_ivp(rhs, (0, TIMES[-1]), start, "LSODA", t_eval=TIMES, rtol=1e-10, atol=atol)
    J = [stress(y[0], y[1] / y[0], y[2:]) for y in path.y.T]
    return path.y[0], np.array(J)


def some(names):
    """Slow are those whose viscosity depends on the shear rate: they are compiled by themselves."""
    return [pytest.param(n, marks=[pytest.mark.slow] * get_law(n).shear_dependent) for n in names]


@pytest.mark.parametrize("name", some(available()))
def test_the_solver_integrates_the_law(name):
    law = get_law(name)
    radii = {"R0": np.array([R_EQ]), "R_max": np.array([R_MAX])}
    values = law.example_values()
    values |= {name: radii[name] for name in radii if name in values}
    model = BubbleModel(law=law, gas="polytropic", start="laser", medium=MEDIUM, accuracy=ACCURACIES["reference"])
    x = model.initial_states({**values, "R_max": np.array([R_MAX]), "R_eq": np.array([R_EQ])})
    (path,) = model.trajectories(x, TIMES)
    R, J = direct(law, values)
    assert R.min() < 0.6 * R_MAX
    np.testing.assert_allclose(path["R"], R, rtol=0, atol=1e-6 * R_MAX)
    np.testing.assert_allclose(path["S"], J, rtol=0, atol=1e-5 * np.max(np.abs(J)))
