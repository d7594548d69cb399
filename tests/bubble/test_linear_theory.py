"""Small oscillations against linear theory: frequency and damping, thermal, viscous and radiative, with elasticity.

Linearising Keller–Miksis about equilibrium, R = R_0 (1 + Re x e^{st}), gives

    ρ R_0² s² + (1 + s R_0/c) [p_g Φ(s) − 2S/R_0 + 4G + 4μ s] = 0,

4G from the neo-Hookean dJ/dλ at λ = 1, Φ from the energy equation of the gas with a wall that stays cold
(Prosperetti 1991; Devin 1959): with z² = s R_0²/D and D = (κ−1)/κ K_∞T_∞/p_g,

    Φ = 3κ / [1 + 3(κ−1)(z coth z − 1)/z²],    Φ → 3 (slow, isothermal), 3κ (fast, adiabatic).

The bubble starts on the eigenmode, its temperature profile included, so nothing else is excited.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from en4dvar_bubble import Accuracy, BubbleModel, Medium, get_law

AMPLITUDE = 2e-5
FINE = Accuracy(nodes=16, rtol=1e-11)


def phi(s, R0, p_g, medium):
    """Gas response −(Δp/p_g)/(ΔR/R_0) and z."""
    kappa = medium.kappa
    diffusivity = (kappa - 1) / kappa * medium.K_inf * medium.T_inf / p_g
    z = np.sqrt(s * R0**2 / diffusivity)
    return 3 * kappa / (1 + 3 * (kappa - 1) * (z / np.tanh(z) - 1) / z**2), z


def eigenvalue(R0, G, mu, medium, heat):
    """The complex rate s of the oscillation, by Newton's method from the undamped adiabatic one."""
    p_g = medium.p_inf + 2 * medium.S / R0

    def residual(s):
        gas = phi(s, R0, p_g, medium)[0] if heat else 3 * medium.kappa
        stiffness = p_g * gas - 2 * medium.S / R0 + 4 * G + 4 * mu * s
        return medium.rho * R0**2 * s**2 + (1 + s * R0 / medium.c) * stiffness

    s = 1j * np.sqrt((3 * medium.kappa * p_g - 2 * medium.S / R0 + 4 * G) / medium.rho) / R0
    for _ in range(50):
        d = s * 1e-7
        s -= residual(s) * 2 * d / (residual(s + d) - residual(s - d))
    assert abs(residual(s)) < 1e-8 * p_g
    return s


def simulated_rate(R0, G, mu, medium, heat, expected):
    """The complex rate fitted to four periods of the simulated radius (fewer when they die out)."""
    model = BubbleModel(
        law=get_law("neo-hookean-kelvin-voigt"), start="laser", gas="heat" if heat else "polytropic",
        medium=medium, accuracy=FINE,
    )  # fmt: skip
    x = model.initial_state({"G": G, "mu": mu, "R_eq": R0, "R_max": R0})
    p_g = medium.p_inf + 2 * medium.S / R0
    gas, z = phi(expected, R0, p_g, medium) if heat else (3 * medium.kappa, 0.0)
    x[model.layout["R"]] = R0 * (1 + AMPLITUDE)
    x[model.layout["Rdot"]] = R0 * AMPLITUDE * expected.real
    x[model.layout["p_b"]] = p_g * (1 - AMPLITUDE * np.real(gas))
    if heat:
        y = model.system.ball.x[: model.system.gas]
        profile = (medium.kappa - 1) / medium.kappa * -gas * (1 - np.sinh(z * y) / (y * np.sinh(z)))
        x[model.layout["T"]] = medium.T_inf * (1 + AMPLITUDE * np.real(profile))
    period = 2 * np.pi / expected.imag
    t = np.linspace(0, min(4 * period, 3 / -expected.real), 400)[1:]
    wave = (model.trajectories(x[None], t)[0]["R"] / R0 - 1) / AMPLITUDE

    def misfit(p):
        return np.real((p[2] + 1j * p[3]) * np.exp((p[0] + 1j * p[1]) * t * expected.imag)) - wave

    fit = least_squares(misfit, [-0.1, 1.1, 1.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return complex(fit.x[0], fit.x[1]) * expected.imag


CASES = {
    "thermal, 50 µm": {"R0": 50e-6, "G": 0.0, "mu": 0.0, "heat": True},
    "thermal, 10 µm": {"R0": 10e-6, "G": 0.0, "mu": 0.0, "heat": True},
    "thermal and viscous, 10 µm": {"R0": 10e-6, "G": 0.0, "mu": 3e-3, "heat": True},
    "gel, 2 µm": {"R0": 2e-6, "G": 2e5, "mu": 5e-3, "heat": True},
    "gel, 0.5 µm": {"R0": 0.5e-6, "G": 1e6, "mu": 5e-3, "heat": True},
    "viscous and radiative, polytropic": {"R0": 5e-6, "G": 1e5, "mu": 5e-3, "heat": False},
    "radiative only, polytropic": {"R0": 5e-6, "G": 0.0, "mu": 0.0, "heat": False},
}


@pytest.mark.parametrize("name", CASES)
def test_frequency_and_damping(name):
    case, medium = CASES[name], Medium()
    expected = eigenvalue(medium=medium, **case)
    found = simulated_rate(medium=medium, expected=expected, **case)
    assert found.imag == pytest.approx(expected.imag, rel=1e-4)
    assert found.real == pytest.approx(expected.real, rel=1e-4)


def test_every_mechanism_matters_here():
    """The agreement above would break if the solver lacked any of them."""
    medium, case = Medium(), CASES["thermal and viscous, 10 µm"]
    full = eigenvalue(medium=medium, **case)
    for less in (
        eigenvalue(medium=medium, **{**case, "heat": False}),
        eigenvalue(medium=medium, **{**case, "mu": 0.0}),
        eigenvalue(medium=replace(medium, c=1e12), **case),
    ):
        assert abs(less.real / full.real - 1) > 5e-3
    gel = CASES["gel, 2 µm"]
    stiff, soft = (eigenvalue(medium=medium, **{**gel, "G": G}) for G in (gel["G"], 0.0))
    assert stiff.imag / soft.imag > 1.05


def test_response_of_the_gas_goes_from_isothermal_to_adiabatic():
    medium = Medium()
    slow, fast = (phi(1j * w, 10e-6, medium.p_inf, medium)[0] for w in (1e-2, 1e12))
    assert slow.real == pytest.approx(3.0, rel=1e-6)
    assert fast.real == pytest.approx(3 * medium.kappa, rel=1e-2)
