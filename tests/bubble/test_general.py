"""Vapour, conducting medium, memory, shear thinning, enthalpy and Gilmore: limits, conservation laws, convergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from en4dvar_bubble import WATER_25C, Accuracy, BubbleModel, Medium, get_law, simulate
from en4dvar_bubble.medium import saturated_vapour_pressure
from en4dvar_bubble.solver.collocation import exterior
from en4dvar_bubble.solver.driver import System

NEO_HOOKEAN = "neo-hookean-kelvin-voigt"
LASER = {"G": 2770.0, "mu": 0.186, "R_max": 230e-6, "R_eq": 230e-6 / 7}
TIMES = np.linspace(0, 100e-6, 1001)


ACCURACY = Accuracy(nodes=12, rtol=1e-6)


def laser(accuracy=ACCURACY, **options):
    return simulate(NEO_HOOKEAN, LASER, TIMES, start="laser", accuracy=accuracy, **options)


def rebound(data):
    R = data.R[0].values
    return R[R[:400].argmin() :].max()


class TestAgreementWithThePaperEquations:
    """The general equations against the fast ones, each with a Jacobian of its own."""

    @pytest.mark.parametrize(
        ("gas", "nodes"),
        # fast equations with another number of nodes are compiled by themselves; with 8, for slow tests alone
        [("polytropic", 4), ("heat", 4), pytest.param("heat", 8, marks=pytest.mark.slow)],
    )
    @pytest.mark.parametrize("reading", ["instantaneous", "retarded", "as-printed"])
    def test_same_path(self, gas, nodes, reading, monkeypatch):
        gel = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}
        t = np.linspace(5e-6, 30e-6, 26)
        options = {"gas": gas, "driving_read": reading, "accuracy": Accuracy(nodes=nodes, rtol=1e-8)}
        fast = simulate(parameters=gel, times=t, **options)
        monkeypatch.setattr(System, "general", True)
        general = simulate(parameters=gel, times=t, **options)
        np.testing.assert_allclose(general.R, fast.R, rtol=0, atol=1e-8 * float(fast.R.max()))
        assert abs(int(general.steps[0]) - int(fast.steps[0])) <= 10  # a wrong Jacobian would need more

    def test_medium_of_infinite_conductivity_is_cold(self):
        conducting = laser(medium_heat="conducting", medium=replace(WATER_25C, K_m=1e6, c_m=1e9))
        assert float(np.abs(conducting.R - laser().R).max()) < 1e-4 * 230e-6

    @pytest.mark.parametrize(
        ("law", "viscous"),
        [
            ("carreau", {"mu_0": 0.2, "mu_inf": 0.2, "shear_time": 1e-7, "n": 1.0}),
            ("church-shell", {"mu": 0.2, "mu_s": 0.2, "G_s": 0.0, "thickness": 1e-7}),
        ],
    )
    def test_viscosity_that_depends_on_nothing_heats_like_a_dashpot(self, law, viscous):
        """The path differs by 4e-3 of R_max without the heat."""
        radii = {"R_max": 300e-6, "R_eq": 40e-6}
        options = {"start": "laser", "medium_heat": "conducting", "vapour": "transport"}
        R, dashpot = (
            simulate(name, {**radii, **own}, TIMES[:600], **options).R
            for name, own in ((law, viscous), ("newtonian", {"mu": 0.2}))
        )
        assert float(np.abs(R - dashpot).max()) < 1e-6 * 300e-6

    def test_vapour_of_vanishing_pressure_is_none(self, monkeypatch):
        monkeypatch.setattr("en4dvar_bubble.paths.SATURATION", 1.0)
        monkeypatch.setattr("en4dvar_bubble.dynamics.saturated_vapour_pressure", lambda T: 1e-6)
        monkeypatch.setattr("en4dvar_bubble.paths.saturated_vapour_pressure", lambda T: 0 * T + 1e-6)
        tight = Accuracy(nodes=12, rtol=1e-8)
        assert float(np.abs(laser(tight, vapour="transport").R - laser(tight).R).max()) < 1e-6 * 230e-6

    def test_rayleigh_plesset_is_the_limit_of_every_compressible_equation(self):
        stiff = replace(WATER_25C, c=1e9, tait_B=1e14)
        exact = laser(radial="rayleigh-plesset").R
        for radial in ("keller-miksis", "keller-miksis-enthalpy", "gilmore"):
            difference = np.abs(laser(radial=radial, medium=stiff).R - exact)
            assert float(difference.max()) < 1e-4 * 230e-6, radial

    def test_compressible_equations_agree_to_first_order_in_the_mach_number(self):
        """Mild collapse: differences among the three are of second order (Prosperetti & Lezzi 1986)."""

        def spread(R_max):
            parameters = {"G": 0.0, "mu": 0.02, "R_max": R_max, "R_eq": 50e-6}
            t = np.linspace(0, 60e-6, 601)
            options = {"start": "laser", "gas": "polytropic", "accuracy": "reference", "medium": Medium(tait_B=308.0e6)}
            R = [
                simulate(NEO_HOOKEAN, parameters, t, radial=r, **options).R[0].values
                for r in ("rayleigh-plesset", "keller-miksis", "keller-miksis-enthalpy", "gilmore")
            ]
            return np.abs(R[0] - R[1]).max(), np.abs(R[2] - R[1]).max(), np.abs(R[3] - R[1]).max()

        first_order, enthalpy, gilmore = spread(60e-6)
        assert enthalpy < 0.05 * first_order
        assert gilmore < 0.05 * first_order


class TestConservation:
    def test_non_condensible_gas(self):
        law = get_law(NEO_HOOKEAN)
        model = BubbleModel(law=law, start="laser", vapour="transport", medium_heat="conducting")
        path = model.trajectories(model.initial_state(LASER)[None], TIMES)[0]
        weights, m = model.system.ball.weights, model.system.gas
        T, chi = path["T"], model.medium.mole_fraction(path["C"])
        wall = weights[m] / T[:, m] * (path["p_b"] - saturated_vapour_pressure(T[:, m]))
        content = path["R"] ** 3 * (path["p_b"] * ((weights[:m] / T[:, :m]) * (1 - chi)).sum(axis=1) + wall)
        np.testing.assert_allclose(content, content[0], rtol=1e-10)
        assert T[:, m].max() > model.medium.T_inf + 0.5  # the wall does heat
        assert path["C"].max() > 0.8

    def test_wall_condition_holds_along_the_path(self):
        """The algebraic unknown: heat leaving the gas, and the latent heat, enter the medium."""
        model = BubbleModel(
            law=get_law(NEO_HOOKEAN), start="laser", medium_heat="conducting", accuracy=Accuracy(rtol=1e-7)
        )
        path = model.trajectories(model.initial_state(LASER)[None], TIMES)[0]
        system, medium = model.system, model.medium
        gas, outside = system.ball, exterior(system.medium, system.medium_length)
        T_w = path["T"][:, -1:]
        K = medium.A * T_w[:, 0] + medium.B
        from_gas = K * (path["T"] @ gas.derivative[-1])
        into_medium = medium.K_m * (np.hstack([path["T_m"], T_w]) - medium.T_inf) @ outside.derivative[-1]
        # K T' and (K T)' of the Kirchhoff variable differ by the truncation of the profile; compare where it is smooth
        smooth = path["R"] > 60e-6
        np.testing.assert_allclose(into_medium[smooth], from_gas[smooth], atol=2e-2 * np.abs(from_gas).max())

    def test_restart_from_the_full_state(self):
        model = BubbleModel(
            law=get_law(NEO_HOOKEAN),
            start="laser",
            vapour="transport",
            medium_heat="conducting",
            accuracy=Accuracy(nodes=8, rtol=1e-7),
        )
        x = model.initial_state(LASER)
        times = np.array([5e-6, 15e-6, 24e-6, 30e-6])
        path = model.trajectories(x[None], times)[0]
        t = 0.0
        for k, t_next in enumerate(times):
            x = model.step(x, t, t_next)
            np.testing.assert_allclose(x, path.states[k], rtol=2e-4, atol=1e-3)
            t = t_next


class TestConvergence:
    """Full laser case: the rebound changes by less than 0.5 % when either grid is doubled."""

    @staticmethod
    def rebound(nodes, medium_nodes):
        accuracy = Accuracy(nodes=nodes, medium_nodes=medium_nodes, rtol=1e-6)
        return rebound(laser(accuracy, vapour="transport", medium_heat="conducting"))

    def test_gas_grid(self):
        assert self.rebound(16, 24) == pytest.approx(self.rebound(8, 24), rel=5e-3)

    def test_medium_grid(self):
        assert self.rebound(8, 48) == pytest.approx(self.rebound(8, 24), rel=5e-3)


def test_exterior_grid_solves_laplace_and_diffusion_scales():
    e = exterior(24, 0.5)
    np.testing.assert_allclose(e.derivative @ (1 / e.x), -1 / e.x**2, atol=1e-7)
    np.testing.assert_allclose((e.laplacian @ (1 / e.x))[:-1], 0, atol=1e-4)
    layer = np.exp(-(e.x - 1) / 0.05)
    np.testing.assert_allclose((e.derivative @ layer)[-1], -20, rtol=1e-3)


def test_incompatible_options_are_refused():
    with pytest.raises(ValueError, match="need gas: heat"):
        BubbleModel(gas="polytropic", medium_heat="conducting")
    with pytest.raises(ValueError, match="exclude each other"):
        BubbleModel(vapour="transport", medium=replace(WATER_25C, p_v=3e3))
