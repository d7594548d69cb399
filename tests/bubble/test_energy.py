"""The energy budget of a driven bubble in an incompressible liquid, every term computed from its own definition.

Kinetic energy 2πρR³Ṙ² = work of the gas − work against p_∞ and p_f − surface energy − elastic energy − viscous
dissipation; with the heat equation, work of the gas = loss of its internal energy pV/(κ−1) − heat lost to the wall.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from en4dvar_bubble import Accuracy, BubbleModel, Medium, get_law

GEL = {"G": 5e4, "mu": 0.08, "R0": 1.5e-6}
TIMES = np.concatenate([np.linspace(4.5e-6, 5.6e-6, 4001), np.linspace(5.6e-6, 14e-6, 8001)[1:]])


@pytest.fixture(scope="module", params=["polytropic", "heat"])
def run(request):
    model = BubbleModel(
        law=get_law("neo-hookean-kelvin-voigt"), gas=request.param, medium=Medium(), radial="rayleigh-plesset",
        accuracy=Accuracy(nodes=24, rtol=1e-11),
    )  # fmt: skip
    path = model.trajectories(model.initial_state(GEL)[None], TIMES)[0]
    return model, {name: path[name] for name in ("R", "Rdot", "p_b")} | (
        {"T": path["T"]} if request.param == "heat" else {}
    )


def integral(power):
    """∫ power dt from the first instant, at all instants."""
    return CubicSpline(TIMES, power).antiderivative()(TIMES)


def elastic_energy(R, R0, G):
    """∫ W dV over the deformed medium: shells at rest radius a stretch to r³ = a³ + R³ − R0³."""

    def density(a):
        stretch = np.cbrt(1 + (R**3 - R0**3) / a**3)
        return 4 * np.pi * a**2 * G / 2 * (stretch**-4 + 2 * stretch**2 - 3)

    edges = R0 * np.array([1.0, 2, 5, 20, 100, 1000])
    inner = sum(quad(density, a, b, epsrel=1e-11)[0] for a, b in pairwise(edges))
    return inner + quad(lambda s: density(1 / s) / s**2, 0, 1 / edges[-1], epsrel=1e-9)[0]


def test_budget_closes(run):
    model, x = run
    medium, R, V, p = model.medium, x["R"], x["Rdot"], x["p_b"]
    flow = 4 * np.pi * R**2 * V
    kinetic = 2 * np.pi * medium.rho * R**3 * V**2
    surface = 4 * np.pi * medium.S * (R**2 - R[0] ** 2)
    work = integral((p - medium.p_inf - model.driving.pressure(TIMES)) * flow)
    dissipated = integral(16 * np.pi * GEL["mu"] * R * V**2)
    peak = int(np.argmax(R))
    assert R[peak] > 10 * GEL["R0"]
    for i in (3000, 4500, peak, len(R) - 1):
        elastic = elastic_energy(R[i], GEL["R0"], GEL["G"])
        spent = kinetic[i] + surface[i] + elastic + dissipated[i]
        assert spent == pytest.approx(work[i], rel=1e-6)
        assert min(surface[i], elastic, dissipated[i]) > 1e-4 * work[i]  # a hundred tolerances: none could be missing


def test_gas_pays_for_its_work_and_its_heat(run):
    model, x = run
    medium, R, V, p = model.medium, x["R"], x["Rdot"], x["p_b"]
    internal = p * 4 / 3 * np.pi * R**3 / (medium.kappa - 1)
    work = integral(p * 4 * np.pi * R**2 * V)
    if "T" in x:
        b = model.system.ball
        theta = x["T"] / medium.T_inf - 1
        K = medium.A * x["T"] + medium.B
        heat = integral(4 * np.pi * R * (_wall_flux(b, theta, K, medium)))
        assert np.abs(heat).max() > 0.1 * internal[0]
    else:
        heat = np.zeros_like(work)
    np.testing.assert_allclose(internal - internal[0], heat - work, rtol=0, atol=2e-6 * internal[0])


def _wall_flux(b, theta, K, medium):
    """R K ∂T/∂r at the wall, through the Kirchhoff variable ∫K dT, which the nodes resolve as the solver does."""
    kirchhoff = 0.5 * (K + medium.K_inf) * theta * medium.T_inf
    return kirchhoff @ b.derivative[-1, :-1]
