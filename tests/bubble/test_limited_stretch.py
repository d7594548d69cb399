"""Laws that end at a stretch: followed up to it, against an integration by scipy that has no tables."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from en4dvar_bubble import ConstitutiveLaw, simulate
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.laws.kelvin_voigt import J_M, GentKelvinVoigt, NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU, G
from en4dvar_bubble.medium import Medium
from en4dvar_bubble.model import BubbleModel

MEDIUM = Medium(rho=998.0, c=1484.0, p_inf=101325.0, S=0.072, kappa=1.4)
R_EQ, R_MAX, MODULUS, VISCOSITY = 35e-6, 250e-6, 5e3, 0.1


def limits(J_m):
    room = lambda stretch: stretch**-4 + 2 * stretch**2 - 3 - J_m  # noqa: E731
    return brentq(room, 1e-2, 1, xtol=1e-15), brentq(room, 1, 1e4, xtol=1e-13)


def slope(stretch, J_m):
    """dJ/dλ of Gent, (λ − λ⁻⁵)/(λ³ − 1) divided out."""
    return -2 * MODULUS * (stretch**3 + 1) / stretch**5 / (1 - (stretch**-4 + 2 * stretch**2 - 3) / J_m)


def scipys(J_m, end):
    """Stretches of a released bubble (Keller–Miksis) until ``end`` (s), and when it comes to the end of its law (s)."""
    m, lowest = MEDIUM, limits(J_m)[0] * (1 + 1e-6)
    gas = (m.p_inf + 2 * m.S / R_EQ) * (R_EQ / R_MAX) ** 3

    def rhs(_, y):
        R, v, J = np.exp(y[0]), y[1], y[2]
        V, dJ = v * R, slope(R / R_EQ, J_m) * v * R / R_EQ
        p = gas * (R_MAX / R) ** (3 * m.kappa)
        pressure = p - m.p_inf - 2 * m.S / R + J - 4 * VISCOSITY * v
        rate = -3 * m.kappa * p * v + 2 * m.S * v / R + dJ + 4 * VISCOSITY * v**2
        force = ((1 + V / m.c) * pressure + R / m.c * rate) / m.rho - 1.5 * (1 - V / (3 * m.c)) * V**2
        return v, force / ((1 - V / m.c) * R + 4 * VISCOSITY / (m.rho * m.c)) / R - v**2, dJ

    there = lambda _, y: np.exp(y[0]) / R_EQ - lowest  # noqa: E731
    there.terminal = True
    begin = quad(slope, 1, R_MAX / R_EQ, (J_m,), limit=2000, epsabs=1e-9, epsrel=1e-12)[0]
    path = solve_ivp(
        rhs, (0, end), [np.log(R_MAX), 0, begin], "Radau", rtol=1e-8, atol=[1e-10, 1e-3, 1e-2], events=there
    )
    return np.exp(path.y[0]) / R_EQ, path.t_events[0]


def ours(J_m, times):
    values = {"G": MODULUS, "J_m": J_m, "mu": VISCOSITY, "R_max": R_MAX, "R_eq": R_EQ}
    return simulate("gent-kelvin-voigt", values, times, start="laser", gas="polytropic", medium=MEDIUM)


@pytest.mark.parametrize("J_m", [210.0, 230.0, 260.0, 300.0])
def test_a_collapse_that_turns_short_of_the_end(J_m):
    path, ended = scipys(J_m, 30e-6)
    assert not len(ended)
    assert 1 < path.min() / limits(J_m)[0] < 1.1
    found = ours(J_m, np.append(0, np.linspace(22.5e-6, 22.6e-6, 4001)))
    assert not found.status.any(), found.reason.values
    assert float(found.R.min()) / R_EQ == pytest.approx(path.min(), rel=1e-3)


@pytest.mark.parametrize("J_m", [99.2, 105.0, 110.0, 150.0, 200.0])
def test_a_collapse_that_comes_to_the_end(J_m):
    _, (ended,) = scipys(J_m, 30e-6)
    times = np.linspace(0, ended * 0.999, 3)
    assert np.isfinite(ours(J_m, times).R).all()
    found = ours(J_m, np.linspace(0, 30e-6, 3))
    (reason,) = found.reason.values
    low, high = limits(J_m)
    assert reason.startswith(f"non-finite state at t = {ended * 1e6:.4g} µs: the law has values at stretches between ")
    told = [float(word) for word in reason.split() if word[0] in "0123456789"][-2:]
    np.testing.assert_allclose(told, [low, high], rtol=7e-3)


@pytest.mark.parametrize("J_m", [50.0, 99.2, 1e3])
@pytest.mark.parametrize("apart", [1e-1, 1e-2, 1e-3, 2e-5])
def test_the_table_follows_the_law_to_its_ends(J_m, apart):
    law, values = GentKelvinVoigt(), {"G": np.array([MODULUS]), "J_m": np.array([J_m]), "mu": np.array([VISCOSITY])}
    low, high = limits(J_m)
    for end, stretch in ((low, low * (1 + apart)), (high, high * (1 - apart))):
        near = np.sign(end - 1)  # ln of the distance from the end, in which the pole is a number
        x = np.log([abs(np.log(end)), abs(np.log(stretch / end))])

        def part(y, near=near, end=end):
            return slope(end * np.exp(-near * np.exp(y)), J_m) * end * np.exp(y - near * np.exp(y))

        exact = -near * quad(part, *x, epsabs=0, epsrel=1e-10, limit=500)[0]
        assert law.elastic_stress(np.array([[stretch]]), values)[0, 0] == pytest.approx(exact, rel=1e-5)
        assert law.refined(values).x.size == 0


class Breaking(NeoHookeanKelvinVoigt):
    r"""$J$ up to λ = 5, where nothing is left that holds."""

    title = "breaks"

    def stress(self, stretch, p):
        return np.where(stretch < 5, super().stress(stretch, p), np.nan)


class OwnGent(ConstitutiveLaw):
    r"""$W'$ of Gent, with an example near its end."""

    title, parameters, example = "own Gent", (G, J_M, MU), {"J_m": 50.0}
    strain_energy_rate = GentKelvinVoigt.strain_energy_rate


@pytest.mark.parametrize(("kind", "largest"), [(Breaking, 4.99), (OwnGent, 4.99)])
def test_laws_of_users_are_followed_as_far(kind, largest):
    values = {name: v[0] for name, v in kind().example_values().items()} | {"R_eq": R_EQ, "R_max": largest * R_EQ}
    found = simulate(kind(), values, np.linspace(0, 1e-6, 3), start="laser", gas="polytropic", medium=MEDIUM)
    assert not found.status.any(), found.reason.values


def test_members_that_are_run_again_do_not_depend_on_those_beside_them():
    model = BubbleModel(law=GentKelvinVoigt(), start="laser", gas="polytropic", medium=MEDIUM)
    J_m = np.array([150.0, 230.0, 300.0, 1e3, 215.0])
    numbers = {"G": MODULUS, "mu": VISCOSITY, "R_max": R_MAX, "R_eq": R_EQ}
    x = model.initial_states({"J_m": J_m} | {name: np.full(5, value) for name, value in numbers.items()})
    times = np.tile(np.linspace(-25e-6, 30e-6, 56), (5, 1))  # before R_max, too
    together = model.integrate(x, times)
    assert [status == 0 for status in together.solution.status] == [False, True, True, True, True]
    for i in range(5):
        alone = model.integrate(x[i : i + 1], times[:1])
        assert alone.solution.reason(0) == together.solution.reason(i)
        for name in ("R", "Rdot", "S") if i else ():
            np.testing.assert_array_equal(alone[name][0], together[name][i], name)
            assert np.isfinite(together[name][i]).all()


def test_nobody_else_is_run_again(monkeypatch):
    def never(*_, **__):
        raise AssertionError("a table with halved cells")

    monkeypatch.setattr(ConstitutiveLaw, "refined", never)
    assert not ours(np.array([1e3, 1e4]), np.linspace(0, 30e-6, 3)).status.any()
    assert get_law("gent-kelvin-voigt").sharp is False
