"""Laws that write into what they are handed, as ``stretch[stretch > 3] = 3`` does: other laws are as before."""

import numpy as np
import pytest

from en4dvar_bubble import ConstitutiveLaw, get_law
from en4dvar_bubble.laws.exactness import refuse_unfit
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.loading import check_law
from en4dvar_bubble.laws.memory import MemoryVariable
from en4dvar_bubble.laws.parameters import MU, G

GUARDED = 3.0


def limited(stretch, p, writes):
    if not writes:
        return np.minimum(stretch, GUARDED), 2 * p.G
    stretch[stretch > GUARDED] = GUARDED
    p.G *= 2
    return stretch, p.G


class Energy(ConstitutiveLaw):
    title, parameters, writes = "limited", (G, MU), True

    def strain_energy_rate(self, stretch, p):
        stretch, modulus = limited(stretch, p, self.writes)
        return modulus * (stretch - stretch**-5.0)


class Closed(ConstitutiveLaw):
    title, parameters, writes = "limited, closed form", (G, MU), True

    def stress(self, stretch, p):
        stretch, modulus = limited(stretch, p, self.writes)
        return -modulus / 4 * (5 - 4 / stretch - stretch**-4.0) - 1e-3 * modulus * (stretch - 1)


class Mixed:
    def stress(self, stretch, p):
        return Closed.stress(self, stretch, p)


class OfAMixin(Mixed, ConstitutiveLaw):
    title, parameters, writes = "limited, of another class", (G, MU), True


class Thinned(NeoHookeanKelvinVoigt):
    title, parameters, writes = "least rate", (G, MU), True

    def viscosity(self, shear_rate, p):
        if self.writes:
            shear_rate[shear_rate < 3e5] = 3e5
        return p.mu * (np.maximum(shear_rate, 3e5) / 3e5) ** -0.1


class Strained(NeoHookeanKelvinVoigt):
    title, parameters, writes = "strained", (G, MU), True

    def strained_viscosity(self, stretch, p):
        if not self.writes:
            return p.mu * (1 + stretch)
        stretch += 1
        return p.mu * stretch


class Relaxing(NeoHookeanKelvinVoigt):
    title, parameters, writes = "relaxing", (G, MU), True

    def memory(self, p):
        if self.writes:
            p.mu *= 2

        def stiffness(stretch):
            if not self.writes:
                return -2 * p.mu / 1e-6 / (1 + stretch)
            stretch += 1
            return -p.mu / 1e-6 / stretch

        return (MemoryVariable(1e-6, stiffness=stiffness),)


def numbers(law):
    values = law.example_values(2)
    memory = law.memory_tables(values)
    viscous = law.viscous_table(values) if law.shear_dependent or law.strain_dependent else 0.0
    halved = law.refined(law.example_values()).table
    return [law.table(values), halved, viscous, memory.stiffness, *values.values()]


@pytest.mark.parametrize("kind", [Energy, Closed, OfAMixin, Thinned, Strained, Relaxing])
def test_a_law_may_write_into_its_arguments(kind):
    """It has the numbers of the same law that copies, and laws after it have those of before."""
    others = [get_law(name) for name in ("quadratic-kelvin-voigt", "fung-kelvin-voigt", "carreau", "sarkar-shell")]
    before = [numbers(law) for law in others]
    law = check_law(kind, "mine")
    own = numbers(law)
    refuse_unfit(kind)
    copying = numbers(type("Copying", (kind,), {"writes": False})())
    for after, as_before in zip([own, *map(numbers, others)], [copying, *before], strict=True):
        for array, expected in zip(after, as_before, strict=True):
            np.testing.assert_array_equal(array, expected)
