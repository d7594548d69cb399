"""Carreau liquid."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.newtonian import Newtonian
from en4dvar_bubble.laws.parameters import MU_0, MU_INF, SHEAR_TIME

N = Parameter("n", "1", "logit", (0.0, 1.0), "exponent of shear thinning", "$n$", source="Carreau (1972)")


class Carreau(Liquid):
    r"""$\mu(\dot\gamma) = \mu_\infty + (\mu_0-\mu_\infty)\left[1+(\lambda_c\dot\gamma)^2\right]^{(n-1)/2}$ (Carreau
    1972); $J = -4\dot R/R\int_0^1\mu(2\sqrt3\,|\dot R/R|\,s)\,ds$.
    """

    name: ClassVar[str] = "carreau"
    title: ClassVar[str] = "Carreau liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_0, MU_INF, SHEAR_TIME, N)
    example: ClassVar[dict[str, float]] = {"mu_0": 0.1, "mu_inf": 1e-3}
    limits: ClassVar[Limits] = ((Newtonian, {"n": 1.0, "mu_0": 0.1, "mu": 0.1}),)

    def viscosity(self, shear_rate: Array, p: Any) -> Array:
        return p.mu_inf + (p.mu_0 - p.mu_inf) * (1 + (p.shear_time * shear_rate) ** 2) ** ((p.n - 1) / 2)
