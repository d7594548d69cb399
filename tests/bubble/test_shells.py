"""Coated bubbles: another program, scipy at other pulses, and closed forms of what a coating does at small strain."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import simulate
from en4dvar_bubble.driving import Driving, silence
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.loading import check_law
from en4dvar_bubble.laws.parameters import MU, G
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.solver.driver import preset

REFERENCE = Path("/work/shared/reference/apecss/marmottant_KM.csv")
R0, SIGMA_W, MU_LIQUID = 0.975e-6, 0.073, 1e-3
MEDIUM = Medium(rho=1000.0, c=1480.0, p_inf=1e5, S=0.04, kappa=1.095)
LIPID = {"chi": 0.6, "kappa_s": 9e-9, "sigma_0": 0.012, "sigma_w": SIGMA_W, "mu": MU_LIQUID}
SHELLS = {
    "marmottant-shell": LIPID,
    "gompertz-shell": LIPID,
    "sarkar-shell": {k: v for k, v in LIPID.items() if k != "sigma_w"},
    "church-shell": {"G_s": 3e7, "mu_s": 0.7, "thickness": 15e-9, "mu": MU_LIQUID},
}


def sine(amplitude, frequency, cycles):
    return Driving(
        amplitude, 0.0, cycles / frequency, lambda t: np.sin(2 * np.pi * frequency * t), cells=256 * cycles
    )  # fmt: skip


def ours(law, values, times, **options):
    options = {"gas": "polytropic", "medium": MEDIUM, "accuracy": preset("reference", "acoustic"), **options}
    return simulate(law, {**values, "R0": R0}, times, **options)


def tension(name, v, x):
    """σ in N/m and its slope with respect to λ, written anew."""
    if name == "church-shell":
        return MEDIUM.S, 0.0
    if name == "sarkar-shell":
        return v["sigma_0"] + v["chi"] * (x * x - 1), 2 * v["chi"] * x
    buckling = 1 / np.sqrt(1 + v["sigma_0"] / v["chi"])
    if name == "gompertz-shell":
        c = 2 * v["chi"] * np.e / SIGMA_W * np.sqrt(1 + SIGMA_W / (2 * v["chi"]))
        b = -np.log(v["sigma_0"] / SIGMA_W) / np.exp(c * (1 - 1 / buckling))
        inner = b * np.exp(c * (1 - x / buckling))
        return SIGMA_W * np.exp(-inner), SIGMA_W * np.exp(-inner) * inner * c / buckling
    raw = v["chi"] * ((x / buckling) ** 2 - 1)
    return min(max(raw, 0.0), SIGMA_W), 2 * v["chi"] * x / buckling**2 if 0 < raw < SIGMA_W else 0.0


def scipys(name, v, times, amplitude, frequency):
    """Keller–Miksis with a shell, in R and Ṙ."""
    p0, rho, c, kappa = MEDIUM.p_inf, MEDIUM.rho, MEDIUM.c, MEDIUM.kappa
    omega, at_rest = 2 * np.pi * frequency, tension(name, v, 1.0)[0]
    outer = (R0 + v.get("thickness", 0.0)) ** 3 - R0**3  # R2³ − R1³

    def rates(t, y):
        R, U = y
        sigma, slope = tension(name, v, R / R0)
        gas = (p0 + 2 * at_rest / R0) * (R0 / R) ** (3 * kappa)
        if outer:
            R2 = R**3 + outer
            elastic, rise = -4 * v["G_s"] * outer * (1 - R0 / R) / R2, 0.0
            rise = -4 * v["G_s"] * outer * (R0 / R**2 / R2 - (1 - R0 / R) * 3 * R**2 / R2**2) * U
            damping = 4 * (v["mu_s"] * outer + MU_LIQUID * R**3) / (R2 * R)  # of U
            turn = 12 * MU_LIQUID * R / R2 - damping * (1 / R + 3 * R**2 / R2)
        else:
            elastic = rise = 0.0
            damping = 4 * MU_LIQUID / R + 4 * v["kappa_s"] / R**2
            turn = -4 * MU_LIQUID / R**2 - 8 * v["kappa_s"] / R**3
        P = gas - 2 * sigma / R + elastic - damping * U - p0 - amplitude * np.sin(omega * t)
        change = -3 * kappa * gas * U / R + 2 * sigma * U / R**2 - 2 * slope / R0 * U / R + rise - turn * U**2
        change -= amplitude * omega * np.cos(omega * t)
        right = (1 + U / c) * P / rho + R / (rho * c) * change - 1.5 * (1 - U / c / 3) * U**2
        return U, right / ((1 - U / c) * R + R * damping / (rho * c))

    solved = solve_ivp(rates, (0, times[-1]), (R0, 0.0), "Radau", t_eval=times, rtol=1e-10, atol=1e-16, max_step=2e-9)
    return solved.y[0]


@pytest.mark.skipif(not REFERENCE.exists(), reason=f"{REFERENCE} is not here")
def test_the_shell_of_another_program():
    t, R = np.loadtxt(REFERENCE, delimiter=",", skiprows=1).T
    values = {"chi": 1.0, "kappa_s": 15e-9, "sigma_0": 0.0, "sigma_w": SIGMA_W, "mu": MU_LIQUID}
    found = ours("marmottant-shell", values, t[1:] * 1e-6, driving=sine(-130e3, 2.9e6, 6))
    assert np.abs(found.R.values - R[1:] * 1e-6).max() <= 1e-7 * R0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "amplitude"), list(zip(SHELLS, (80e3, 80e3, 200e3, 400e3), strict=True)))
def test_another_pulse_by_scipy(name, amplitude):
    times = np.linspace(0, 2.4e-6, 121)
    found = ours(name, SHELLS[name], times[1:], driving=sine(amplitude, 2e6, 5)).R.values
    exact = scipys(name, SHELLS[name], times, amplitude, 2e6)[1:]
    assert np.ptp(exact) > 0.1 * R0
    assert np.abs(found - exact).max() <= 1e-6 * R0


def test_the_default_accuracy_holds_a_shell_too():
    times = np.linspace(0, 2.4e-6, 121)
    fine, usual = (
        ours("marmottant-shell", LIPID, times, driving=sine(80e3, 2e6, 5), accuracy=preset(name, "acoustic")).R.values
        for name in ("reference", "standard")
    )
    assert 0 < np.abs(fine - usual).max() <= 1e-5 * R0


def test_it_buckles_and_breaks_at_the_radii_of_the_paper():
    law, values = get_law("marmottant-shell"), {name: np.array([v]) for name, v in LIPID.items()} | {"R0": np.ones(1)}
    buckles = 1 / np.sqrt(1 + LIPID["sigma_0"] / LIPID["chi"])
    breaks = buckles * np.sqrt(1 + SIGMA_W / LIPID["chi"])
    near = np.array([buckles - 1e-6, buckles + 1e-6, breaks - 1e-6, breaks + 1e-6])
    sigma = LIPID["sigma_0"] - law.elastic_stress(near[None], values)[0] * near / 2
    slope = 2 * LIPID["chi"] * near / buckles**2
    np.testing.assert_allclose(sigma[[0, 3]], [0, SIGMA_W], atol=1e-9)
    np.testing.assert_allclose(sigma[[1, 2]], [1e-6 * slope[1], SIGMA_W - 1e-6 * slope[2]], atol=1e-9)


@pytest.mark.parametrize("name", SHELLS)
def test_small_oscillations_have_the_resonance_and_damping_of_the_closed_form(name):
    """ẍ + (4μ/ρR0² + …) ẋ + ω0² x = 0, ρ R0² ω0² = 3κ(p0 + 2σ0/R0) + 2σ′/R0 − 2σ0/R0 + the shell's modulus."""
    v, small, kappa = SHELLS[name], 1e-5, MEDIUM.kappa
    sigma, slope = tension(name, v, 1.0)
    if name in ("marmottant-shell", "sarkar-shell"):  # 4χ/R0, and of Marmottant's, whose R_b is not R0, 4σ0/R0
        assert slope == pytest.approx(2 * (v["chi"] + (sigma if name == "marmottant-shell" else 0.0)))
    stiffness = 3 * kappa * (MEDIUM.p_inf + 2 * sigma / R0) + 2 * (slope - sigma) / R0
    damping = 4 * MU_LIQUID + 4 * v.get("kappa_s", 0.0) / R0
    if name == "church-shell":
        share = 1 - (1 + v["thickness"] / R0) ** -3
        stiffness += 4 * v["G_s"] * share
        damping = 4 * (v["mu_s"] * share + MU_LIQUID * (1 - share))
    beta, omega2 = damping / (2 * MEDIUM.rho * R0**2), stiffness / (MEDIUM.rho * R0**2)
    omega = np.sqrt(omega2 - beta**2)
    times = np.linspace(0, 4 * np.pi / omega, 101)[1:]
    values = {**v, "Rdot_start": small * R0 * omega}
    found = ours(name, values, times, driving=silence(), radial="rayleigh-plesset").R.values / R0 - 1
    exact = small * np.exp(-beta * times) * np.sin(omega * times)
    assert np.abs(found - exact).max() < 1e-3 * small


def test_the_tension_at_rest_is_the_surface_tension():
    """Gas and hydrophone know of σ_0, and no other surface tension may be named."""
    found = ours("marmottant-shell", {**LIPID, "sigma_0": np.array([0.0, 0.03])}, [0.0, 1e-7], driving=silence())
    np.testing.assert_allclose(found.p_b.values[:, 0], 1e5 + 2 * np.array([0.0, 0.03]) / R0, rtol=1e-12)
    np.testing.assert_allclose(found.R.values[:, 1], R0, rtol=1e-9)
    model = BubbleModel(get_law("marmottant-shell"), "polytropic", medium=MEDIUM)
    assert "surface_tension" not in [p.name for p in model.optional_parameters]
    assert "surface_tension" not in [a.name for a in model.alternatives]
    other = BubbleModel(get_law("church-shell"), "polytropic", medium=MEDIUM)
    assert "surface_tension" in [a.name for a in other.alternatives]


def test_a_tension_above_that_of_a_broken_shell_fails():
    found = ours("marmottant-shell", {**LIPID, "sigma_0": np.array([0.01, 0.08])}, [1e-8, 2e-7], driving=silence())
    assert list(found.status.values != 0) == [False, True]
    assert "non-finite" in found.reason.values[1]


class Thickening(NeoHookeanKelvinVoigt):
    title, parameters = "viscosity that does not depend on the stretch after all", (G, MU)

    def strained_viscosity(self, stretch, p):
        return p.mu + 0 * stretch


def test_a_constant_viscosity_of_the_stretch_is_the_dashpot():
    times, values = np.linspace(0, 40e-6, 81), {"G": 800.0, "mu": 0.05}
    laws = Thickening(), NeoHookeanKelvinVoigt()
    models = (BubbleModel(law, accuracy=preset("reference", "acoustic")) for law in laws)
    start = {name: np.array([value]) for name, value in {**values, "R0": 0.8e-6}.items()}
    one, two = (model.trajectories(model.initial_states(start), times)[0] for model in models)
    assert np.abs(one["R"] - two["R"]).max() < 1e-6 * two["R"].max()
    assert np.abs(one["S"] - two["S"]).max() < 1e-4 * np.abs(two["S"]).max()


def test_a_viscosity_of_shear_rate_and_stretch_is_refused():
    class Both(Thickening):
        def viscosity(self, shear_rate, p):
            return p.mu + 0 * shear_rate

    with pytest.raises(ConfigError, match="defines both viscosity and strained_viscosity"):
        check_law(Both, "Both")


def test_the_elasticity_is_in_the_state_also_where_its_name_is_that_of_something_else():
    """χ is the mole fraction of vapour in the gas as well."""
    model = BubbleModel(get_law("sarkar-shell"), gas="polytropic")
    values = {**model.law.example_values(), "R0": np.full(1, R0)}
    states = model.trajectories(model.initial_states(values), np.array([1e-7, 1e-6])).states
    assert states.shape == (1, 2, model.layout.size)
    np.testing.assert_array_equal(states[0, :, model.layout["chi"]], values["chi"][0])
