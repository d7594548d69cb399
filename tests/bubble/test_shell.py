"""A law of the user's with kinks: the coating of Marmottant et al. (2005), whose tension ends at two radii."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import ConstitutiveLaw, simulate
from en4dvar_bubble.driving import Driving
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.memory import MemoryVariable
from en4dvar_bubble.laws.parameters import MU
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.solver.driver import preset

REFERENCE = Path("/work/shared/reference/apecss/marmottant_KM.csv")
R0, KAPPA_S, WATER = 0.975e-6, 15e-9, 0.073
MEDIUM = Medium(rho=1000.0, c=1480.0, p_inf=1e5, S=0.0, kappa=1.095)
CHI = Parameter(
    "chi", "N/m", "lognormal", label="elasticity of the shell", symbol=r"$\chi$", source="Marmottant (2005)"
)
BUCKLING = Parameter("buckling", "1", "lognormal", label="buckling radius over R0", symbol=r"$R_b/R_0$", source="same")


class Marmottant(ConstitutiveLaw):
    """J = −2σ/R − 4κ_s Ṙ/R², σ = χ(R²/R_b² − 1) between 0 and that of water; the surface viscosity a dashpot whose
    spring relaxes in 10 fs.
    """

    title, parameters = "lipid shell", (CHI, BUCKLING, MU)
    example = {"chi": 1.0, "mu": 1e-3}  # noqa: RUF012

    def stress(self, stretch, p):
        return -2 * np.clip(p.chi * ((stretch / p.buckling) ** 2 - 1), 0, WATER) / (R0 * stretch)

    def memory(self, p):
        return (MemoryVariable(1e-14, stiffness=lambda stretch: -4 * KAPPA_S / (R0 * stretch) / 1e-14),)


def sine(amplitude, frequency, cycles):
    return Driving(
        amplitude, 0.0, cycles / frequency, lambda t: np.sin(2 * np.pi * frequency * t), cells=256 * cycles
    )  # fmt: skip


def ours(times, chi, buckling, drive):
    values = {"chi": chi, "buckling": buckling, "mu": 1e-3, "R0": R0}
    found = simulate(
        Marmottant(),
        values,
        times,
        gas="polytropic",
        medium=MEDIUM,
        driving=drive,
        accuracy=preset("reference", "acoustic"),
    )
    assert not found.status.any(), found.reason.values
    return found.R.values


def scipys(times, chi, buckling, amplitude, frequency):
    """Keller–Miksis by another code. The gas at rest carries what is left of the tension at R0, as the law has it."""
    p0, rho, c, kappa = MEDIUM.p_inf, MEDIUM.rho, MEDIUM.c, MEDIUM.kappa
    omega = 2 * np.pi * frequency

    def rates(t, y):
        R, v = y
        raw = chi * ((R / (buckling * R0)) ** 2 - 1)
        tension = min(max(raw, 0.0), WATER)
        slope = 2 * chi * R / (buckling * R0) ** 2 if 0 < raw < WATER else 0.0
        gas = p0 * (R0 / R) ** (3 * kappa)
        P = gas - 2 * tension / R - 4 * 1e-3 * v / R - 4 * KAPPA_S * v / R**2 - p0 - amplitude * np.sin(omega * t)
        change = -3 * kappa * gas * v / R + 2 * tension * v / R**2 - 2 * slope * v / R
        change += 4 * 1e-3 * v**2 / R**2 + 8 * KAPPA_S * v**2 / R**3 - amplitude * omega * np.cos(omega * t)
        mach = v / c
        right = (1 + mach) * P / rho + R / (rho * c) * change - 1.5 * (1 - mach / 3) * v**2
        left = (1 - mach) * R + (4 * 1e-3 + 4 * KAPPA_S / R) / (rho * c)
        return v, right / left

    solved = solve_ivp(rates, (0, times[-1]), (R0, 0.0), "Radau", t_eval=times, rtol=1e-10, atol=1e-16, max_step=2e-9)
    return solved.y[0]


@pytest.mark.skipif(not REFERENCE.exists(), reason=f"{REFERENCE} is not here")
def test_the_shell_of_another_program():
    t, R = np.loadtxt(REFERENCE, delimiter=",", skiprows=1).T
    found = ours(t[1:] * 1e-6, 1.0, 1.0, sine(-130e3, 2.9e6, 6))
    assert np.abs(found - R[1:] * 1e-6).max() <= 1e-6 * R0


@pytest.mark.slow
def test_another_pulse_by_scipy():
    """Members whose tables are halved at different places, side by side."""
    times, chi, buckling = np.linspace(0, 2.4e-6, 121), (1.0, 0.5, 2.0), (1.0, 0.987, 0.9915)
    found = ours(times[1:], chi, buckling, sine(60e3, 2e6, 5))
    for R, *shell in zip(found, chi, buckling, strict=True):
        assert np.abs(R - scipys(times, *shell, 60e3, 2e6)[1:]).max() <= 1e-6 * R0


def test_the_tension_begins_at_the_buckling_radius():
    values = {"chi": np.array([1.0, 2.0]), "buckling": np.array([0.95, 1.013]), "mu": np.full(2, 1e-3)}
    law, radius, off = Marmottant(), values["buckling"][:, None], np.array([-1e-3, -1e-6, 1e-6, 1e-3])
    stress = law.elastic_stress(radius * (1 + off), values)
    tension = values["chi"][:, None] * np.maximum((1 + off) ** 2 - 1, 0)
    np.testing.assert_allclose(stress, -2 * tension / (R0 * radius * (1 + off)), atol=1e-7 * 2 * WATER / R0)


class Jump(NeoHookeanKelvinVoigt):
    title = "breaks"

    def stress(self, stretch, p):
        return super().stress(stretch, p) * np.where(stretch > 1.7, 0.999, 1.0)


class KinkOfEnergy(NeoHookeanKelvinVoigt):
    title = "stiffens from a strain on"
    stress = ConstitutiveLaw.stress

    def strain_energy_rate(self, stretch, p):
        return 2 * p.G * (stretch - stretch**-5.0) * (1 + np.maximum(np.log(stretch) - 0.3, 0))


def test_a_jump_of_the_stress_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"Jump: its stress changes too sharply .* at λ = 1\.7 it jumps"):
        simulate(Jump(), {"G": 1e3, "mu": 1e-3, "R0": 1e-6}, np.linspace(0, 1e-6, 3))


class RoughMemory(NeoHookeanKelvinVoigt):
    title = "stiffens at once"

    def memory(self, p):
        return (MemoryVariable(1e-6, stiffness=lambda stretch: -p.G * np.maximum(stretch, 1.3)),)


class RoughViscosity(NeoHookeanKelvinVoigt):
    title = "thins at once"

    def strained_viscosity(self, stretch, p):
        return p.mu / (1 + np.exp((np.log(stretch) - 0.5) / 1e-3))


@pytest.mark.parametrize(
    ("law", "words"),
    [(RoughMemory, "the stiffness of its memory variable 1"), (RoughViscosity, "its strained_viscosity")],
)
def test_what_is_not_refined_is_refused_by_name_where_it_is_rough(law, words):
    with pytest.raises(ConfigError, match=rf"{law.name}: {words} changes too sharply near λ = 1\.[36]"):
        simulate(law(), {"G": 1e3, "mu": 1e-3, "R0": 1e-6}, np.linspace(0, 1e-6, 3))


@pytest.mark.parametrize("x", [-0.4, 0.2, 0.3, 0.301, 0.9])
def test_a_kink_of_the_strain_energy_rate_by_quadrature(x):
    from scipy.integrate import quad

    law, values = KinkOfEnergy(), {"G": np.array([1e3]), "mu": np.array([0.1])}
    slope = lambda at: -2e3 * np.exp(at) * (np.exp(at) - np.exp(-5 * at)) * (1 + max(at - 0.3, 0)) / np.expm1(3 * at)  # noqa: E731
    exact = quad(slope, 0, min(x, 0.3), epsabs=0, epsrel=1e-12)[0]
    exact += quad(slope, 0.3, x, epsabs=0, epsrel=1e-12)[0] if x > 0.3 else 0.0
    assert law.sharp
    assert law.elastic_stress(np.exp([[x]]), values)[0, 0] == pytest.approx(exact, rel=1e-7)
