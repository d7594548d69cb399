"""Quadratic-law Kelvin–Voigt (QLKV): the Fung model to first order in its stiffening."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import ALPHA, MU, G


class QuadraticKelvinVoigt(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R + \tfrac{G(3\alpha-1)}2[5 - 4\lambda^{-1} - \lambda^{-4}]
    + 2G\alpha[\tfrac{27}{40} + \tfrac18\lambda^{-8} + \tfrac15\lambda^{-5} + \lambda^{-2} - 2\lambda]$ (Mancia et al.
    2021, eq. 2).
    """

    name: ClassVar[str] = "quadratic-kelvin-voigt"
    title: ClassVar[str] = "quadratic-law Kelvin–Voigt (QLKV)"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"alpha": 0.0}),)

    def stress(self, stretch: Array, p: Any) -> Array:
        inverse = 1 / stretch
        fourth = inverse**2 * inverse**2
        neo_hookean = 5 - 4 * inverse - fourth
        stiffening = 27 / 40 + fourth * (fourth / 8 + inverse / 5) + inverse**2 - 2 * stretch
        return (p.G * (1.5 * p.alpha - 0.5)) * neo_hookean + (2 * p.G * p.alpha) * stiffening
