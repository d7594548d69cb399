"""Fung exponential Kelvin–Voigt."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import ALPHA, MU, G


class FungKelvinVoigt(ConstitutiveLaw):
    r"""$W = \tfrac G{2\alpha}\left[e^{\alpha(I_1-3)} - 1\right]$, $I_1 = \lambda^{-4}+2\lambda^2$ (Fung 1993; Yang et
    al. 2020), with a dashpot. To first order in $\alpha(I_1-3)$ it is the quadratic law.
    """

    name: ClassVar[str] = "fung-kelvin-voigt"
    title: ClassVar[str] = "Fung exponential Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"alpha": 0.0}),)
    stretch_range: ClassVar[tuple[float, float]] = (0.5, 9.0)  # beyond, the slope of the table loses its sixth digit

    def strain_energy_rate(self, stretch: Array, p: Any) -> Array:
        I1 = stretch**-4.0 + 2 * stretch**2
        return 2 * p.G * np.exp(p.alpha * (I1 - 3)) * (stretch - stretch**-5.0)
