"""Laws that are none: with stress at rest, of the wrong sign, or whose members depend on each other."""

import numpy as np
import pytest

from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import ConstitutiveLaw, simulate
from en4dvar_bubble.battery import run_battery
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.memory import MemoryVariable
from en4dvar_bubble.laws.parameters import MU, G
from en4dvar_bubble.laws.viscous import Newtonian


class Energy(ConstitutiveLaw):
    r"""$W$"""

    title, parameters = "neo-Hookean, as its energy", (G, MU)
    factor = 1.0

    def strain_energy_rate(self, stretch, p):
        return 2 * p.G * (stretch - self.factor * stretch**-5.0)


class Strained(Energy):
    r"""$W'(1)$ is a twentieth of $2G$: J is a logarithm at λ = 1."""

    factor = 0.95


class HardlyStrained(Energy):
    r"""$W'(1)$ is 1e-4 of $2G$."""

    factor, monotone = 0.9999, False


class Pushing(Energy):
    r"""$-W$"""

    monotone = False

    def strain_energy_rate(self, stretch, p):
        return -super().strain_energy_rate(stretch, p)


class PushingStress(NeoHookeanKelvinVoigt):
    r"""$-J$"""

    def stress(self, stretch, p):
        return -super().stress(stretch, p)


class Pole(Energy):
    r"""$W'$ of Gent without an end: J is infinite where it has its pole."""

    example = {"G": 5e3}  # noqa: RUF012

    def strain_energy_rate(self, stretch, p):
        return super().strain_energy_rate(stretch, p) / (1 - (stretch**-4.0 + 2 * stretch**2 - 3) / 50)


class OfTheFirst(Energy):
    r"""$W$ with the modulus of the first member."""

    def strain_energy_rate(self, stretch, p):
        return 2 * np.ravel(p.G)[0] * (stretch - stretch**-5.0)


class OfTheMean(NeoHookeanKelvinVoigt):
    r"""$J$ with the modulus of all members together."""

    def stress(self, stretch, p):
        return super().stress(stretch, p) / p.G * np.mean(p.G)


class ThinOfTheFirst(Newtonian):
    r"""$\mu(\lambda)$ of the first member."""

    def strained_viscosity(self, stretch, p):
        return np.ravel(p.mu)[0] / stretch


class RelaxingAsTheFirst(NeoHookeanKelvinVoigt):
    r"""$s$ of the first member."""

    def memory(self, p):
        return (MemoryVariable(1e-6, stiffness=lambda stretch: -np.ravel(p.G)[0] / stretch),)


CASES = {
    Strained: ("No stress without strain", r"a stress without strain: .*W′ is 500 Pa at λ = 1\."),
    HardlyStrained: ("No stress without strain", r"a stress without strain: .*W′ is 1 Pa at λ = 1\."),
    Pushing: ("The elastic stress opposes", r".* drives the wall away .* W′ being 7\.\d+e\+03 Pa at λ = 0\.9 and -"),
    PushingStress: ("The elastic stress opposes", r".* drives the wall away .* J being -.* Pa at λ = 0\.9"),
    Pole: ("dJ/dλ of the table agrees", r"its stress changes too sharply .* at λ = 0\.371105 it .* return NaN"),
    OfTheFirst: ("Two members beside each other", "the elastic stress of a member depends on the members beside it"),
    OfTheMean: ("Two members beside each other", "the elastic stress of a member depends on"),
    ThinOfTheFirst: ("Two members beside each other", "the viscosity of a member depends on"),
    RelaxingAsTheFirst: ("Two members beside each other", "the memory of a member depends on"),
}


@pytest.mark.parametrize("kind", CASES, ids=lambda kind: kind.__name__)
def test_it_is_told_by_the_checks_and_refused_by_name(kind):
    check, words = CASES[kind]
    (reason,) = [reason for name, reason in run_battery(kind()).items() if name.startswith(check)]
    assert kind.__name__ in reason
    values = {name: v[0] for name, v in kind().example_values().items()} | {"R0": 1e-6}
    with pytest.raises(ConfigError, match=rf"{kind.__name__}: {words}"):
        simulate(kind(), values, np.linspace(0, 1e-6, 3))


class Coated(NeoHookeanKelvinVoigt):
    r"""$J - \tfrac{G}{10}$, as of a tension at rest."""

    def stress(self, stretch, p):
        return super().stress(stretch, p) - 0.1 * p.G / stretch


@pytest.mark.parametrize("kind", [Energy, Coated])
def test_a_law_runs_also_with_a_tension_at_rest(kind):
    assert not simulate(kind(), {"G": 1e3, "mu": 0.1, "R0": 1e-6}, np.linspace(0, 1e-6, 3)).status.any()


class OfOneMember(Energy):
    r"""$W$ of a class whose method takes one member alone."""

    def strain_energy_rate(self, stretch, p):
        if len(p.G) > 1:
            raise ValueError("one member at a time")
        return super().strain_energy_rate(stretch, p) + 0 / (stretch != 1)


def test_what_a_method_raises_is_told_by_who_calls_it():
    parameters = {"mu": 0.1, "R0": 1e-6}
    assert not simulate(OfOneMember(), parameters | {"G": 1e3}, np.linspace(0, 1e-6, 3)).status.any()
    with pytest.raises(ValueError, match="one member at a time"):
        simulate(OfOneMember(), parameters | {"G": [1e3, 2e3]}, np.linspace(0, 1e-6, 3))
