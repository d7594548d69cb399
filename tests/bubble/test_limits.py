"""Closed forms, limits and conservation laws of the bubble model."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar_bubble import Accuracy, BubbleModel, Medium, get_law, simulate

NEO_HOOKEAN = "neo-hookean-kelvin-voigt"


def test_rayleigh_collapse_time():
    """An empty cavity in an inviscid incompressible liquid collapses at 0.914681 R_max √(ρ/p_∞) (Rayleigh 1917)."""
    medium = Medium(S=0.0, c=1e12)
    rayleigh = 0.914681 * 1e-3 * np.sqrt(medium.rho / medium.p_inf)
    times = np.linspace(0.0, 1.02 * rayleigh, 8001)
    empty = {"G": 0.0, "mu": 0.0, "R_max": 1e-3, "R_eq": 4e-5}  # gas at R_max: 6 Pa, which delays it by 6e-5
    R = simulate(NEO_HOOKEAN, empty, times, start="laser", gas="polytropic", medium=medium).R[0].values
    assert times[np.argmin(R)] == pytest.approx(rayleigh, rel=3e-4)


def test_polytropic_oscillation_has_the_minnaert_frequency():
    medium = Medium(S=0.0, c=1e12)
    R_eq = 50e-6
    minnaert = np.sqrt(3 * medium.kappa * medium.p_inf / medium.rho) / (2 * np.pi * R_eq)
    times = np.linspace(0, 20 / minnaert, 4001)
    small = {"G": 0.0, "mu": 0.0, "R_max": R_eq * 1.0001, "R_eq": R_eq}
    options = {"start": "laser", "gas": "polytropic", "medium": medium, "accuracy": Accuracy(rtol=1e-9)}
    x = simulate(NEO_HOOKEAN, small, times, **options).R[0].values / R_eq - 1
    zero = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    crossings = times[zero] + (times[1] - times[0]) * x[zero] / (x[zero] - x[zero + 1])
    assert 1 / np.diff(crossings).mean() == pytest.approx(minnaert, rel=1e-4)


def test_elastic_bubble_at_rest_stays_at_rest():
    times = np.linspace(0, 50e-6, 11)
    still = simulate(NEO_HOOKEAN, {"G": 5e3, "mu": 0.1, "R_max": 30e-6, "R_eq": 30e-6}, times, start="laser")
    np.testing.assert_allclose(still.R[0], 30e-6, rtol=1e-12)


def test_gas_mass_is_conserved_through_a_violent_collapse():
    model = BubbleModel()
    x = model.initial_state({"G": 420.0, "alpha": 0.029, "mu": 0.086, "R0": 0.43e-6})
    path = model.trajectories(x[None], np.linspace(0, 80e-6, 400))[0]
    weights = model.system.ball.weights
    theta = path["T"] / model.medium.T_inf
    mass = path["p_b"] * path["R"] ** 3 * (weights[-1] + (weights[:-1] / theta).sum(axis=1))
    assert path["R"].max() > 100e-6
    np.testing.assert_allclose(mass, mass[0], rtol=1e-10)
    assert path["R"][-1] == pytest.approx(0.43e-6, rel=1e-6)


def test_quadratic_law_without_stiffening_is_neo_hookean():
    gel = {"G": 9e3, "mu": 0.092, "R0": 0.68e-6}
    times = np.linspace(5e-6, 40e-6, 50)
    quadratic = simulate("quadratic-kelvin-voigt", {**gel, "alpha": 0.0}, times).R
    np.testing.assert_array_equal(quadratic, simulate(NEO_HOOKEAN, gel, times).R)


def test_compressible_bubble_approaches_the_incompressible_one_as_c_grows():
    gel = {"G": 2e3, "mu": 0.1, "R_max": 200e-6, "R_eq": 25e-6}
    times = np.linspace(0, 15e-6, 60)
    paths = [
        simulate(NEO_HOOKEAN, gel, times, start="laser", gas="polytropic", medium=Medium(c=c), accuracy="reference").R[
            0
        ]
        for c in (1.484e4, 1.484e5, 1e12)
    ]
    far, near = (float(np.abs(path - paths[2]).max()) for path in paths[:2])
    assert near == pytest.approx(far / 10, rel=0.15)  # first order in 1/c


def test_released_bubble_is_symmetric_about_its_maximum():
    model = BubbleModel(law=get_law(NEO_HOOKEAN), start="laser")
    x = model.initial_state({"G": 2e3, "mu": 0.1, "R_max": 200e-6, "R_eq": 25e-6})
    times = np.array([-3e-6, -1e-6, 0.0, 1e-6, 3e-6])
    path = model.trajectories(x[None], times)[0]
    np.testing.assert_array_equal(path["R"], path["R"][::-1])
    np.testing.assert_array_equal(path["Rdot"], -path["Rdot"][::-1])
    assert path["R"][1] < 200e-6
