"""Liquids without memory: Newtonian, and thinned by shear."""

from typing import ClassVar

from en4dvar.model.state import Array, Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.parameters import MU, MU_0, MU_INF, SHEAR_TIME, Values


class Newtonian(Liquid):
    r"""$J = -4\mu\dot R/R$ (Poritsky 1952)."""

    name = "newtonian"
    title = "Newtonian liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU,)


N = Parameter("n", "1", "logit", (0.0, 1.0), "exponent of shear thinning", "$n$", source="Carreau (1972)")


class Carreau(Liquid):
    r"""$\mu(\dot\gamma) = \mu_\infty + (\mu_0-\mu_\infty)\left[1+(\lambda_c\dot\gamma)^2\right]^{(n-1)/2}$ (Carreau
    1972); $J = -4\dot R/R\int_0^1\mu(2\sqrt3\,|\dot R/R|\,s)\,ds$.
    """

    name = "carreau"
    title = "Carreau liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_0, MU_INF, SHEAR_TIME, N)
    example: ClassVar = {"mu_0": 0.1, "mu_inf": 1e-3}
    limits: ClassVar[Limits] = ((Newtonian, {"n": 1.0, "mu_0": 0.1, "mu": 0.1}),)

    def viscosity(self, shear_rate: Array, p: Values) -> Array:
        return p.mu_inf + (p.mu_0 - p.mu_inf) * (1 + (p.shear_time * shear_rate) ** 2) ** ((p.n - 1) / 2)


M = Parameter("m", "1", "logit", (0.0, 2.0), "exponent of shear thinning", "$m$", source="Cross (1965)")


class Cross(Liquid):
    r"""$\mu(\dot\gamma) = \mu_\infty + (\mu_0-\mu_\infty)/\left[1+(\lambda_c\dot\gamma)^m\right]$ (Cross 1965);
    $J = -4\dot R/R\int_0^1\mu(2\sqrt3\,|\dot R/R|\,s)\,ds$.
    """

    name = "cross"
    title = "Cross liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_0, MU_INF, SHEAR_TIME, M)
    example: ClassVar = {"mu_0": 0.1, "mu_inf": 1e-3}
    limits: ClassVar[Limits] = ((Newtonian, {"mu_0": 0.1, "mu_inf": 0.1, "mu": 0.1}),)

    def viscosity(self, shear_rate: Array, p: Values) -> Array:
        return p.mu_inf + (p.mu_0 - p.mu_inf) / (1 + (p.shear_time * shear_rate) ** p.m)
