"""Mooney–Rivlin Kelvin–Voigt."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU, G

MIXING = Parameter("mixing", "1", "logit", (0.0, 1.0), "share of the second invariant", "$m$", source="Mooney (1940)")


class MooneyRivlinKelvinVoigt(ConstitutiveLaw):
    r"""$W = \tfrac G2\left[(1-m)(I_1-3) + m(I_2-3)\right]$ (Mooney 1940; Rivlin 1948), with a dashpot:
    $J_e = -(1-m)\tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] - mG\left[2\lambda-1-\lambda^{-2}\right]$.
    """

    name: ClassVar[str] = "mooney-rivlin-kelvin-voigt"
    title: ClassVar[str] = "Mooney–Rivlin Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MIXING, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"mixing": 0.0}),)

    def stress(self, stretch: Array, p: Any) -> Array:
        first = 0.5 * (5 - 4 / stretch - stretch**-4.0)
        second = 2 * stretch - 1 - stretch**-2.0
        return -p.G * ((1 - p.mixing) * first + p.mixing * second)
