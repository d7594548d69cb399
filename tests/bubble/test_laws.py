"""Every law that is registered, built in or by entry point, passes the battery; and the laws one by one."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble.battery import CHECKS, Cycle, finite, respond, run_battery
from en4dvar_bubble.laws import REGISTRY, ConstitutiveLaw, Liquid, get_law
from en4dvar_bubble.laws.loading import available
from en4dvar_bubble.laws.memory import MemoryVariable
from en4dvar_bubble.laws.parameters import ALPHA, MU, G
from en4dvar_bubble.laws.tabulate import GRID
from en4dvar_bubble.tables import evaluate

STRETCH = np.exp(np.linspace(-1.5, 6.0, 301))
CYCLE = Cycle(4.0, 3e-6)


@pytest.mark.parametrize("check", CHECKS.values(), ids=lambda c: c.__name__)
@pytest.mark.parametrize("name", available())
def test_battery(name, check):
    check(get_law(name))


def test_the_laws_of_the_field_are_there():
    assert len(REGISTRY) >= 18
    assert {"fung-kelvin-voigt", "oldroyd-b", "carreau", "zener-quadratic"} <= set(REGISTRY)


class TestBatteryFinds:
    """Each check fails on a law that is wrong in one way."""

    @staticmethod
    def failing(kind):
        return {check for check, reason in run_battery(kind()).items() if reason}

    def expect(self, kind, *functions):
        names = {c.__name__: words for words, c in CHECKS.items()}
        assert self.failing(kind) == {names[f] for f in functions}

    def test_nothing_wrong(self):
        class Good(Base):
            r"""$J$"""

        self.expect(Good)

    def test_a_parameter_that_does_nothing(self):
        class Idle(Base):
            r"""$J$ without $\alpha$."""

            parameters: ClassVar = (G, ALPHA, MU)

        self.expect(Idle, "parameters_act")
        assert "alpha changes neither stress nor viscosity nor memory" in run_battery(Idle()).values()

    def test_missing_documentation(self):
        class Undocumented(Base):
            """No formula."""

            title: ClassVar = ""
            parameters: ClassVar = (Parameter("G", "Pa"), MU)

        self.expect(Undocumented, "documented")
        (reason,) = filter(None, run_battery(Undocumented()).values())
        for what in ("a title", "LaTeX", "bounds of G"):
            assert what in reason
        assert "source" not in reason

    def test_stress_at_rest(self):
        class Shifted(Base):
            r"""$J$"""

            def stress(self, stretch, p):
                return super().stress(stretch, p) + 1.0

        self.expect(Shifted, "no_stress_without_strain")

    def test_wrong_sign(self):
        class Pushes(Base):
            r"""$J$"""

            def stress(self, stretch, p):
                return -super().stress(stretch, p)

        self.expect(Pushes, "stress_falls_with_stretch")

    def test_not_finite(self):
        class Stops(Base):
            r"""$J$"""

            def stress(self, stretch, p):
                return np.where(stretch < 350, super().stress(stretch, p), np.nan)

        assert next(words for words, c in CHECKS.items() if c is finite) in self.failing(Stops)

    def test_negative_viscosity(self):
        class Drives(Base):
            r"""$J$"""

            def viscosity(self, shear_rate, p):
                return -p.mu * np.ones_like(shear_rate)

        self.expect(Drives, "finite", "dissipates")

    def test_jump(self):
        class Jumps(Base):
            r"""$J$"""

            def stress(self, stretch, p):
                return super().stress(stretch, p) - 1e-3 * p.G * (stretch > 2)

        self.expect(Jumps, "table_has_the_slope_of_the_law")

    def test_a_kink_is_none(self):
        class Kinked(Base):
            r"""$J$"""

            def stress(self, stretch, p):
                return super().stress(stretch, p) - p.G * np.maximum(stretch - 2, 0)

        self.expect(Kinked)

    @pytest.mark.parametrize("said", [False, True])
    def test_a_kink_in_a_law_of_the_package_is_to_be_said(self, said, monkeypatch):
        class Kinked(Base):
            r"""$J$"""

            kinked = said

            def stress(self, stretch, p):
                return super().stress(stretch, p) - p.G * np.maximum(stretch - 2, 0)

        monkeypatch.setattr(Kinked, "__module__", "en4dvar_bubble.laws.kelvin_voigt")
        reasons = [*filter(None, run_battery(Kinked()).values())]
        words = "kinked = True in the class halves the cells of its table"
        assert [reason.endswith(words) for reason in reasons] == [True] * (not said)

    def test_wrong_limit(self):
        class NotItsParent(Base):
            r"""$J$"""

            limits: ClassVar = ((REGISTRY["linear-kelvin-voigt"], {}),)

        self.expect(NotItsParent, "limits_hold")

    def test_memory_that_drives(self):
        class Engine(Base):
            r"""$J$"""

            def memory(self, p):
                return (MemoryVariable(1e-6, stiffness=4e6),)

        self.expect(Engine, "dissipates")

    def test_an_error_in_the_law_is_a_finding(self):
        class Raises(Base):
            r"""$J$"""

            def stress(self, stretch, p):
                return p.stiffness * stretch

        assert any("stiffness" in reason and "test_laws.py" in reason for reason in run_battery(Raises()).values())


class Base(ConstitutiveLaw):
    title: ClassVar = "neo-Hookean"
    parameters: ClassVar = (G, MU)

    def stress(self, stretch, p):
        return -0.5 * p.G * (5 - 4 / stretch - stretch**-4.0)


class TestElastic:
    def test_energy_and_closed_form_are_one_law(self):
        """The Fung energy to first order, W = G/2 [I + α I²/2] with I = I₁ − 3, is the quadratic law (Yang 2020)."""

        class ByEnergy(ConstitutiveLaw):
            parameters: ClassVar = (G, ALPHA, MU)

            def strain_energy_rate(self, stretch, p):
                invariant = stretch**-4.0 + 2 * stretch**2.0 - 3
                return 2 * p.G * (1 + p.alpha * invariant) * (stretch - stretch**-5.0)

        law = get_law("quadratic-kelvin-voigt")
        closed = law.elastic_stress(STRETCH[None], law.example_values())
        energy = ByEnergy().elastic_stress(STRETCH[None], law.example_values())
        np.testing.assert_allclose(energy, closed, rtol=1e-8, atol=1e-8 * 5e3)

    @pytest.mark.parametrize(
        ("name", "energy"),
        [
            ("neo-hookean-kelvin-voigt", lambda a, b, p: p["G"] / 2 * (a**2 + 2 * b**2 - 3)),
            (
                "mooney-rivlin-kelvin-voigt",
                lambda a, b, p: p["G"] / 2 * (
                    (1 - p["mixing"]) * (a**2 + 2 * b**2 - 3) + p["mixing"] * (a**-2 + 2 * b**-2 - 3)
                ),
            ),
            ("ogden-kelvin-voigt", lambda a, b, p: 2 * p["G"] / p["a"] ** 2 * (a ** p["a"] + 2 * b ** p["a"] - 3)),
            ("gent-kelvin-voigt", lambda a, b, p: -p["G"] * p["J_m"] / 2 * np.log1p(-(a**2 + 2 * b**2 - 3) / p["J_m"])),
            (
                "fung-kelvin-voigt",
                lambda a, b, p: p["G"] / 2 / p["alpha"] * np.expm1(p["alpha"] * (a**2 + 2 * b**2 - 3)),
            ),
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("wall", [0.6, 1.5, 6.0])
    def test_virtual_work(self, name, energy, wall):
        """J from the energy stored in the medium, U(R) = ∫ W(λ(r)) 4πr0² dr0: dU/dR = −4πR² J, independent of the
        formula dJ/dλ = −W′/(λ³ − 1)."""
        law = get_law(name)
        p = {n: v[0] for n, v in law.example_values().items()}

        cut = 0.02 / wall

        def stored(R):
            # r³ = r0³ + R³ − 1; with r0 = 1/x the medium is 0 < x < 1, its far part, x < cut, at small strain ε:
            # W = 6Gε², ε = (R³ − 1)x³/3
            def shell(x):
                b = np.cbrt(1 + (R**3 - 1) * x**3)
                return energy(b**-2.0, b, p) / x**4

            far = 2 * p["G"] * ((R**3 - 1) / 3) ** 2 * cut**3
            return far + quad(shell, cut, 1, epsabs=0, epsrel=1e-10, limit=200)[0]

        h = 1e-2 * wall
        slope = (8 * (stored(wall + h) - stored(wall - h)) - stored(wall + 2 * h) + stored(wall - 2 * h)) / (12 * h)
        J = law.elastic_stress(np.array([[wall]]), law.example_values())[0, 0]
        assert pytest.approx(-slope / wall**2, rel=1e-6) == J

    def test_small_strain_modulus(self):
        """J = −4 G ε for small strain in every solid whose parameter is the shear modulus G of a medium as made."""
        for name in REGISTRY:
            law = get_law(name)
            if "G" in law.example_values() and not law.memory(_columns(law)) and not law.released:
                J = law.elastic_stress(np.array([[1 - 1e-5, 1 + 1e-5]]), law.example_values())[0]
                expected = 4 * law.example_values()["G"][0]
                assert (J[0] - J[1]) / 2e-5 == pytest.approx(expected, rel=1e-6), name


def _columns(law):
    return SimpleNamespace(**{n: v[:, None] for n, v in law.example_values().items()})


class TestViscosity:
    @pytest.mark.parametrize("name", ["carreau", "cross"])
    def test_against_the_integral_over_the_medium(self, name):
        """J = −12 ∫_R^∞ μ(γ̇) R²Ṙ/r⁴ dr with γ̇ = 2√3 |Ṙ| R²/r³, by scipy."""
        law = get_law(name)
        p = _columns(law)
        for V in (-1e-1, 1e4, 1e6, -1e9):

            def dJ(r, V=V):
                rate = 2 * np.sqrt(3) * abs(V) / r**3
                return -12 * float(np.ravel(law.viscosity(np.array([rate]), p))[0]) * V / r**4

            edges = [1.0, 2.0, 10.0, 100.0, 1e3, np.inf]
            exact = sum(quad(dJ, a, b, epsabs=0, epsrel=1e-11)[0] for a, b in pairwise(edges))
            J = -4 * V * law.mean_viscosity(np.array([[abs(V)]]), law.example_values())[0, 0]
            assert pytest.approx(exact, rel=1e-8) == J

    def test_power_law(self):
        """μ = K γ̇^(n−1) has the mean K (2√3 |V|)^(n−1)/n; and the table is constant below 1e-3 1/s."""

        class PowerLaw(Liquid):
            parameters: ClassVar = (Parameter("K", "Pa s"), Parameter("n", "1"))

            def viscosity(self, shear_rate, p):
                return p.K * shear_rate ** (p.n - 1)

        V = np.logspace(-2.9, 12.9, 100)
        values = {"K": np.array([0.3, 2.0]), "n": np.array([0.4, 1.3])}
        exact = values["K"][:, None] * (2 * np.sqrt(3) * V) ** (values["n"][:, None] - 1) / values["n"][:, None]
        np.testing.assert_allclose(PowerLaw().mean_viscosity(np.tile(V, (2, 1)), values), exact, rtol=1e-8)
        low = PowerLaw().mean_viscosity(np.array([[0.0, 1e-9, 1e-3]]), {n: v[:1] for n, v in values.items()})[0]
        assert low[0] == low[1] == low[2]


class TestMemory:
    def test_upper_convected_maxwell_is_exact_at_finite_strain(self):
        """Two variables against τ_rr and τ_θθ integrated on 1200 material shells of the medium."""
        law = get_law("upper-convected-maxwell")
        values = {"mu_p": np.array([0.1]), "relaxation_time": np.array([8e-7])}
        viscosity, theta = 0.1, 8e-7
        # y = r³ − R³ labels a shell; with y = u/(1−u) the medium is 0 < u < 1
        nodes, weights = np.polynomial.legendre.leggauss(24)
        edges = 1 - np.linspace(1, 0, 51) ** 3
        u = (edges[:-1, None] + np.diff(edges)[:, None] * (nodes + 1) / 2).ravel()
        w = (np.diff(edges)[:, None] * weights / 2).ravel()
        y = u / (1 - u)
        response = respond(law, values, CYCLE)

        def rates(t, tau):
            R3 = CYCLE.stretch(t) ** 3
            e = R3 * CYCLE.rate(t) / (y + R3)  # R²Ṙ/r³
            rr, tt = tau.reshape(2, -1)
            return np.concatenate([
                -4 * e * rr - rr / theta - 4 * viscosity / theta * e,
                2 * e * tt - tt / theta + 2 * viscosity / theta * e,
            ])  # fmt: skip

        shells = solve_ivp(
            rates, (0, CYCLE.period), np.zeros(2 * len(y)), "DOP853", t_eval=response.times, rtol=1e-9, atol=1e-6
        )
        rr, tt = shells.y.reshape(2, len(y), -1)
        R3 = CYCLE.stretch(response.times) ** 3
        J = 2 / 3 * np.einsum("i,ik->k", w / (1 - u) ** 2, (rr - tt) / (y[:, None] + R3))
        assert np.max(np.abs(response.J - J)) < 1e-6 * np.max(np.abs(J))

    def test_slow_relaxation_of_the_upper_convected_liquid_is_the_neo_hookean_solid(self):
        """θ → ∞ with μ_p/θ = G: Lodge's rubber-like liquid."""
        liquid, solid = get_law("upper-convected-maxwell"), get_law("neo-hookean-kelvin-voigt")
        slow = respond(liquid, {"mu_p": np.array([5e7]), "relaxation_time": np.array([1e4])}, CYCLE)
        elastic = respond(solid, {"G": np.array([5e3]), "mu": np.array([0.0])}, CYCLE)
        np.testing.assert_allclose(slow.J, elastic.J, rtol=0, atol=1e-7 * np.max(np.abs(elastic.J)))

    @pytest.mark.parametrize("name", ["maxwell", "upper-convected-maxwell"])
    def test_fast_relaxation_is_newtonian(self, name):
        errors = []
        for theta in (1e-9, 1e-10):
            fast = respond(get_law(name), {"mu_p": np.array([0.1]), "relaxation_time": np.array([theta])}, CYCLE)
            exact = -0.4 * CYCLE.rate(fast.times)
            errors.append(np.max(np.abs(fast.J - exact)) / np.max(np.abs(exact)))
        assert errors[0] < 1e-2
        assert errors[1] == pytest.approx(errors[0] / 10, rel=0.1)

    def test_linear_maxwell_is_its_convolution(self):
        """s = −4(μ_p/θ) ∫ e^{−(t−t′)/θ} V(t′) dt′."""
        theta = 8e-7
        response = respond(get_law("maxwell"), {"mu_p": np.array([0.1]), "relaxation_time": np.array([theta])}, CYCLE)
        for i in (50, 200, 333):
            t = response.times[i]
            s = quad(lambda x, t=t: np.exp((x - t) / theta) * CYCLE.rate(x), 0, t, epsabs=0, epsrel=1e-11)[0]
            assert response.J[i] == pytest.approx(-0.4 / theta * s, rel=1e-8)

    @pytest.mark.parametrize("name", ["zener-neo-hookean", "zener-quadratic", "jeffreys-quadratic"])
    def test_zener_in_the_variable_of_the_rheometry_codes(self, name):
        """Z = R³ (J_e + s): Ż = −(Z − Z_e)/θ + dZ_e/dt + 3V(Z − Z_e) − 4(μ_p/θ) R²Ṙ (Warnez & Johnsen 2015)."""
        law = get_law(name)
        values = law.example_values()
        own = respond(law, values, CYCLE)
        p, column = {n: v[0] for n, v in values.items()}, _columns(law)
        spring = lambda x: float(np.ravel(law.stress(np.array([x]), column))[0])  # noqa: E731

        def rate(t, Z):
            x, V, h = float(CYCLE.stretch(t)), float(CYCLE.rate(t)), 1e-4
            slope = (8 * (spring(x + h) - spring(x - h)) - spring(x + 2 * h) + spring(x - 2 * h)) / (12 * h)
            Ze = x**3 * spring(x)
            dZe = 3 * V * Ze + x**4 * V * slope
            return (-(Z - Ze) / p["relaxation_time"] + dZe + 3 * V * (Z - Ze)
                    - 4 * p["mu_p"] / p["relaxation_time"] * x**3 * V)  # fmt: skip

        Z = solve_ivp(rate, (0, CYCLE.period), [0.0], "LSODA", t_eval=own.times, rtol=1e-10, atol=1e-4).y[0]
        J = Z / CYCLE.stretch(own.times) ** 3 - 4 * p.get("mu", 0.0) * CYCLE.rate(own.times)
        np.testing.assert_allclose(own.J, J, atol=1e-6 * np.max(np.abs(J)))

    def test_tables_hold_what_the_law_declares(self):
        class Two(Liquid):
            def memory(self, p):
                return (
                    MemoryVariable(p.mu * 1e-5, 0.5, lambda x: p.mu * x, -3.0),
                    MemoryVariable(2e-6, stiffness=p.mu, equilibrium=lambda x: np.log(x)),
                )

        values = {"mu": np.array([0.1, 0.2, 0.3])}
        tables = Two().memory_tables(values)
        np.testing.assert_array_equal(tables.relaxation_time, np.stack([values["mu"] * 1e-5, np.full(3, 2e-6)], 1))
        np.testing.assert_array_equal(tables.convection, [0.5, 0.0])
        x = np.tile([-0.7, 0.3, 4.0], (3, 1))
        at = lambda table: evaluate(np.ascontiguousarray(table), GRID.span, x)  # noqa: E731
        np.testing.assert_allclose(at(tables.stiffness[:, 0]), values["mu"][:, None] * np.exp(x), rtol=1e-9)
        np.testing.assert_allclose(at(tables.equilibrium[:, 0]), -3.0, rtol=1e-12)
        np.testing.assert_allclose(at(tables.stiffness[:, 1]), values["mu"][:, None] * np.ones(3), rtol=1e-12)
        np.testing.assert_allclose(at(tables.equilibrium[:, 1]), x, atol=1e-9)
        np.testing.assert_allclose(
            Two().relaxed(np.array([0.5, 1.0, 2.0]), values), [[-3, np.log(0.5)], [-3, 0], [-3, np.log(2)]], atol=1e-9
        )

    def test_a_law_without_memory_has_empty_tables(self):
        law = get_law("newtonian")
        assert law.memory_tables(law.example_values(4)).stiffness.shape == (4, 0, GRID.cells, 8)
        assert law.relaxed(np.ones(4), law.example_values(4)).shape == (4, 0)


def test_unknown_law_is_refused_with_a_suggestion():
    with pytest.raises(ConfigError, match="did you mean 'neo-hookean-kelvin-voigt'"):
        get_law("neo-hookean-kelvin-voight")
    with pytest.raises(ConfigError, match="did you mean 'neo-hookean-kelvin-voigt'"):
        get_law("neohookean")


def test_every_law_of_the_package_has_a_name():
    """A class without one is not registered, so that no configuration could use it and no battery would test it."""

    def shipped(base):
        for law in base.__subclasses__():
            yield from [law] * law.__module__.startswith("en4dvar_bubble.laws.")
            yield from shipped(law)

    assert {law for law in shipped(ConstitutiveLaw) if law.name not in REGISTRY} == {Liquid}


def test_two_laws_of_one_name_are_refused():
    with pytest.raises(ConfigError, match="two laws are called 'newtonian'"):
        type("Other", (Liquid,), {"name": "newtonian"})
