"""Linear Kelvin–Voigt."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw
from en4dvar_bubble.laws.parameters import MU, G


class LinearKelvinVoigt(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R - \tfrac{4G}3\left[1 - \lambda^{-3}\right]$ (Yang & Church 2005): small-strain elasticity,
    used at any strain; its stress levels off at $4G/3$.
    """

    name: ClassVar[str] = "linear-kelvin-voigt"
    title: ClassVar[str] = "linear Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU)

    def stress(self, stretch: Array, p: Any) -> Array:
        return -4 / 3 * p.G * (1 - stretch**-3.0)
