"""Cross liquid."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Array, Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.newtonian import Newtonian
from en4dvar_bubble.laws.parameters import MU_0, MU_INF, SHEAR_TIME

M = Parameter("m", "1", "logit", (0.0, 2.0), "exponent of shear thinning", "$m$", source="Cross (1965)")


class Cross(Liquid):
    r"""$\mu(\dot\gamma) = \mu_\infty + (\mu_0-\mu_\infty)/\left[1+(\lambda_c\dot\gamma)^m\right]$ (Cross 1965);
    $J = -4\dot R/R\int_0^1\mu(2\sqrt3\,|\dot R/R|\,s)\,ds$.
    """

    name: ClassVar[str] = "cross"
    title: ClassVar[str] = "Cross liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_0, MU_INF, SHEAR_TIME, M)
    example: ClassVar[dict[str, float]] = {"mu_0": 0.1, "mu_inf": 1e-3}
    limits: ClassVar[Limits] = ((Newtonian, {"mu_0": 0.1, "mu_inf": 0.1, "mu": 0.1}),)

    def viscosity(self, shear_rate: Array, p: Any) -> Array:
        return p.mu_inf + (p.mu_0 - p.mu_inf) / (1 + (p.shear_time * shear_rate) ** p.m)
