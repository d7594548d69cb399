"""A medium softened by the largest stretch: shell by shell in r, and what is left at small strain."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import get_law, simulate

LAW = get_law("softening-kelvin-voigt")


def values(damage, largest, n=1):
    one = {"G": 2e3, "damage": damage, "mu": 0.1, "R0": 1e-5, "R_max": largest * 1e-5}
    return {name: np.full(n, value) for name, value in one.items()}


def by_shells(stretch, damage, largest):
    """J = 2 ∫_R^∞ (τ_rr − τ_θθ) dr/r in Pa with R0 = 1; each shell knows its stretch at the largest radius."""

    def integrand(log_r):
        r = np.exp(log_r)
        at_rest = np.cbrt(r**3 - stretch**3 + 1)
        now, then = r / at_rest, np.cbrt(at_rest**3 + largest**3 - 1) / at_rest
        left = 1 - damage * (1 - np.exp(-0.5 * (then**-4 + 2 * then**2 - 3)))
        return 2 * left * 2e3 * (now**-4 - now**2)

    edges = np.log(stretch) + np.array([0, 1e-3, 1e-2, 0.1, 0.5, 1, 2, 3, 5, 10])
    return sum(quad(integrand, a, b, epsabs=1e-8, epsrel=1e-11)[0] for a, b in pairwise(edges))


@pytest.mark.parametrize("largest", [1.5, 4.0, 12.0])
@pytest.mark.parametrize("stretch", [0.2, 0.7, 0.99, 1.3, 3.0, 10.0])
def test_the_sum_over_the_shells(stretch, largest):
    found = LAW.elastic_stress(np.array([[stretch]]), values(0.6, largest))[0, 0]
    assert found == pytest.approx(by_shells(stretch, 0.6, largest), rel=1e-7)


def test_small_strain_has_the_modulus_that_is_left():
    """J = −4 (λ − 1) G ∫₀¹ (1 − D) du, u = (R/r)³; nearly (1 − d) G after a large stretch."""
    u = (np.arange(4000) + 0.5) / 4000
    for largest in (1.2, 2.0, 30.0):
        then = np.cbrt(1 + u * (largest**3 - 1))
        left = np.mean(1 - 0.6 * (1 - np.exp(-0.5 * (then**-4 + 2 * then**2 - 3))))
        found = LAW.elastic_stress(np.array([[1 - 1e-4, 1 + 1e-4]]), values(0.6, largest))[0]
        assert (found[0] - found[1]) / (8e-4 * 2e3) == pytest.approx(left, rel=1e-4)
    assert left == pytest.approx(0.4, rel=1e-3)


def test_a_softened_bubble_collapses_later_and_a_driven_one_is_refused():
    times, radii = np.linspace(0, 60e-6, 601), {"G": 8e3, "mu": 0.05, "R_eq": 60e-6, "R_max": 250e-6}
    soft, stiff = (simulate("softening-kelvin-voigt", {**radii, "damage": d}, times, start="laser", gas="polytropic")
                   for d in (0.8, 0.0))  # fmt: skip
    same = simulate("neo-hookean-kelvin-voigt", radii, times, start="laser", gas="polytropic")
    assert np.abs(stiff.R.values - same.R.values).max() < 1e-7 * 250e-6
    first = [times[np.argmin(found.R.values[0])] for found in (soft, stiff)]
    assert first[0] > first[1] + 0.5e-6
    with pytest.raises(ConfigError, match="needs start: laser: only a released bubble has an R_max"):
        simulate("softening-kelvin-voigt", {"G": 8e3, "mu": 0.05, "damage": 0.5, "R0": 1e-6}, times)


def test_a_member_does_not_depend_on_the_others():
    together = LAW.samples({**values(0.5, 6.0, 70), "damage": np.linspace(0.1, 0.9, 70)})
    for i in (0, 47, 48, 69):
        alone = LAW.samples({**values(0.5, 6.0), "damage": np.linspace(0.1, 0.9, 70)[i : i + 1]})
        np.testing.assert_array_equal(alone[0], together[i])
