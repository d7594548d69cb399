"""The battery every constitutive law passes by being registered, and the table that carries a law into the kernel."""

from __future__ import annotations

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from en4dvar.errors import ConfigError
from en4dvar_bubble import REGISTRY, get_law
from en4dvar_bubble.laws.base import GRID, ConstitutiveLaw
from en4dvar_bubble.laws.parameters import ALPHA, MU, G
from en4dvar_bubble.tables import evaluate

VALUES = {"G": 5e3, "alpha": 0.03, "mu": 0.1}
STRETCH = np.exp(np.linspace(-1.5, 6.0, 301))


def values(law, n=1):
    return {p.name: np.full(n, VALUES[p.name]) for p in law.parameters}


@pytest.fixture(params=sorted(REGISTRY))
def law(request):
    return get_law(request.param)


class TestBattery:
    def test_no_stress_without_strain(self, law):
        assert abs(law.elastic_stress(np.array([[1.0]]), values(law))[0, 0]) < 1e-10 * VALUES["G"]

    def test_stress_opposes_strain(self, law):
        J = law.elastic_stress(STRETCH[None], values(law))[0]
        assert np.all(J[STRETCH > 1.01] < 0)
        assert np.all(J[STRETCH < 0.99] > 0)

    def test_stress_falls_with_stretch(self, law):
        assert np.all(np.diff(law.elastic_stress(STRETCH[None], values(law))[0]) < 0)

    def test_table_reproduces_the_closed_form(self, law):
        p = SimpleNamespace(**{k: v[:, None] for k, v in values(law).items()})
        x = np.random.default_rng(0).uniform(-2.0, 8.0, 1000)
        exact = law.stress(np.exp(x), p)[0]
        table = evaluate(law.table(values(law)), GRID.span, x[None])[0]
        np.testing.assert_allclose(table, exact, rtol=1e-8, atol=1e-9 * VALUES["G"])

    def test_documented(self, law):
        assert law.title
        assert "$" in (type(law).__doc__ or "")
        assert all(p.source and p.unit for p in law.parameters)


def test_strain_energy_gives_the_same_law_as_the_closed_form():
    """dJ/dλ = −W′/(λ³−1) with the Fung-quadratic energy W = G[(1−α)(I−3)/2 + α(I−3)²/4 + α(I−3)/2 ...] (Yang 2020)."""

    class ByEnergy(ConstitutiveLaw):
        parameters: ClassVar = (G, ALPHA, MU)

        def strain_energy_rate(self, stretch, p):
            invariant = stretch**-4.0 + 2 * stretch**2.0 - 3
            d_invariant = 4 * (stretch - stretch**-5.0)
            return 0.5 * p.G * (1 + p.alpha * invariant) * d_invariant

    closed = get_law("quadratic-kelvin-voigt").elastic_stress(STRETCH[None], values(ByEnergy))
    energy = ByEnergy().elastic_stress(STRETCH[None], values(ByEnergy))
    np.testing.assert_allclose(energy, closed, rtol=1e-8, atol=1e-8 * VALUES["G"])


def test_unknown_law_is_refused_with_a_suggestion():
    with pytest.raises(ConfigError, match="did you mean 'neo-hookean-kelvin-voigt'"):
        get_law("neo-hookean-kelvin-voight")
