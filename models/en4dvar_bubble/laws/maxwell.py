"""Liquids with memory: a branch that relaxes (Maxwell), alone or beside a solvent (Jeffreys, Oldroyd-B)."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.model.state import Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.memory import MemoryVariable, linear_maxwell, upper_convected_maxwell
from en4dvar_bubble.laws.parameters import MU, MU_P, RELAXATION_TIME, Values
from en4dvar_bubble.laws.viscous import Newtonian


class Maxwell(Liquid):
    r"""$J = s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Allen & Roy 2000; Warnez & Johnsen 2015)."""

    name = "maxwell"
    title = "linear Maxwell liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0, "mu": 0.0}),)

    def memory(self, p: Values) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)


class Jeffreys(Maxwell):
    r"""$J = -4\mu\dot R/R + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$: a Maxwell branch beside a solvent
    (Allen & Roy 2000); retardation time $\theta\mu/(\mu+\mu_p)$.
    """

    name = "jeffreys"
    title = "linear Jeffreys liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0}), (Maxwell, {"mu": 0.0}))


class UpperConvectedMaxwell(Liquid):
    r"""$J = s_1 + s_2$, $\dot s_1 = -s_1/\theta - Vs_1 - 2(\mu_p/\theta)V$,
    $\dot s_2 = -s_2/\theta - 4Vs_2 - 2(\mu_p/\theta)V$, $V = \dot R/R$ (Warnez & Johnsen 2015): exact at any strain.
    """

    name = "upper-convected-maxwell"
    title = "upper-convected Maxwell liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0, "mu": 0.0}),)

    def memory(self, p: Values) -> tuple[MemoryVariable, ...]:
        return upper_convected_maxwell(p.mu_p, p.relaxation_time)


class OldroydB(UpperConvectedMaxwell):
    r"""$J = -4\mu\dot R/R + s_1 + s_2$, $\dot s_1 = -s_1/\theta - Vs_1 - 2(\mu_p/\theta)V$,
    $\dot s_2 = -s_2/\theta - 4Vs_2 - 2(\mu_p/\theta)V$ (Oldroyd 1950; Warnez & Johnsen 2015): polymer in a solvent.
    """

    name = "oldroyd-b"
    title = "Oldroyd-B liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((UpperConvectedMaxwell, {"mu": 0.0}), (Newtonian, {"mu_p": 0.0}))
