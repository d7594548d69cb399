"""Neo-Hookean Kelvin–Voigt."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw
from en4dvar_bubble.laws.parameters import MU, G


class NeoHookeanKelvinVoigt(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R - \tfrac G2\left[5 - 4\lambda^{-1} - \lambda^{-4}\right]$ (Gaudron et al. 2015)."""

    name: ClassVar[str] = "neo-hookean-kelvin-voigt"
    title: ClassVar[str] = "neo-Hookean Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU)

    def stress(self, stretch: Array, p: Any) -> Array:
        inverse = 1 / stretch
        return (-0.5 * p.G) * (5 - 4 * inverse - inverse**2 * inverse**2)
