"""Solids with memory: a spring beside a Maxwell branch (Zener), or beside branch and dashpot (Jeffreys)."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.model.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt, QuadraticKelvinVoigt
from en4dvar_bubble.laws.maxwell import Jeffreys, Maxwell
from en4dvar_bubble.laws.memory import MemoryVariable, linear_maxwell
from en4dvar_bubble.laws.parameters import ALPHA, MU, MU_P, RELAXATION_TIME, G, Values


class ZenerNeoHookean(NeoHookeanKelvinVoigt):
    r"""$J = -\tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$:
    a neo-Hookean spring beside a Maxwell branch (Hua & Johnsen 2013; Warnez & Johnsen 2015).
    """

    name = "zener-neo-hookean"
    title = "standard linear solid (Zener), neo-Hookean spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"mu_p": 0.0, "mu": 0.0}), (Maxwell, {"G": 0.0}))

    def memory(self, p: Values) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)


class ZenerQuadratic(QuadraticKelvinVoigt):
    r"""$J = J_e(\lambda; G, \alpha) + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$: the spring of the quadratic
    law beside a Maxwell branch (Warnez & Johnsen 2015; Yang et al. 2020).
    """

    name = "zener-quadratic"
    title = "standard linear solid (Zener), quadratic spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((ZenerNeoHookean, {"alpha": 0.0}), (QuadraticKelvinVoigt, {"mu_p": 0.0, "mu": 0.0}))

    def memory(self, p: Values) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)


class JeffreysNeoHookean(ZenerNeoHookean):
    r"""$J = -4\mu\dot R/R - \tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] + s$,
    $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Warnez & Johnsen 2015): spring, dashpot and Maxwell branch.
    """

    name = "jeffreys-neo-hookean"
    title = "Jeffreys with neo-Hookean spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = (
        (ZenerNeoHookean, {"mu": 0.0}),
        (NeoHookeanKelvinVoigt, {"mu_p": 0.0}),
        (Jeffreys, {"G": 0.0}),
    )


class JeffreysQuadratic(ZenerQuadratic):
    r"""$J = -4\mu\dot R/R + J_e(\lambda; G, \alpha) + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Warnez &
    Johnsen 2015; Yang et al. 2020): the quadratic law beside a Maxwell branch.
    """

    name = "jeffreys-quadratic"
    title = "Jeffreys with quadratic spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = (
        (ZenerQuadratic, {"mu": 0.0}),
        (QuadraticKelvinVoigt, {"mu_p": 0.0}),
        (JeffreysNeoHookean, {"alpha": 0.0}),
    )
