"""Gent Kelvin–Voigt: finite extensibility."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU, G

J_M = Parameter("J_m", "1", "lognormal", (0.0, np.inf), "limit of I₁ − 3", "$J_m$", source="Gent (1996)")


class GentKelvinVoigt(ConstitutiveLaw):
    r"""$W = -\tfrac{GJ_m}2\ln\left[1-(I_1-3)/J_m\right]$ (Gent 1996), with a dashpot. A member whose wall comes within
    10 % of the locking stretch, about $\sqrt{J_m/2}$, fails as non-finite.
    """

    name: ClassVar[str] = "gent-kelvin-voigt"
    title: ClassVar[str] = "Gent Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, J_M, MU)
    example: ClassVar[dict[str, float]] = {"J_m": 1e6}
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"J_m": np.inf}),)

    def strain_energy_rate(self, stretch: Array, p: Any) -> Array:
        room = 1 - (stretch**-4.0 + 2 * stretch**2 - 3) / p.J_m
        return 2 * p.G * (stretch - stretch**-5.0) / np.where(room > 0, room, np.nan)
