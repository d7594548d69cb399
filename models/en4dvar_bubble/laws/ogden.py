"""One-term Ogden Kelvin–Voigt."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU, G

EXPONENT = Parameter("a", "1", "lognormal", (1e-3, 20.0), "Ogden exponent", "$a$", source="Ogden (1972)")


class OgdenKelvinVoigt(ConstitutiveLaw):
    r"""$W = \tfrac{2G}{a^2}\left[\lambda_1^a+\lambda_2^a+\lambda_3^a - 3\right]
    = \tfrac{2G}{a^2}\left[\lambda^{-2a}+2\lambda^a-3\right]$ (Ogden 1972; G is the shear modulus), with a dashpot.
    """

    name: ClassVar[str] = "ogden-kelvin-voigt"
    title: ClassVar[str] = "Ogden (one term) Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, EXPONENT, MU)
    example: ClassVar[dict[str, float]] = {"a": 2.5}
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"a": 2.0}),)

    def strain_energy_rate(self, stretch: Array, p: Any) -> Array:
        return 4 * p.G / p.a * (stretch ** (p.a - 1) - stretch ** (-2 * p.a - 1))
