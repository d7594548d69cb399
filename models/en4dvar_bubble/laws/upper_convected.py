"""Upper-convected Maxwell liquid."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.memory import MemoryVariable, upper_convected_maxwell
from en4dvar_bubble.laws.newtonian import Newtonian
from en4dvar_bubble.laws.parameters import MU_P, RELAXATION_TIME


class UpperConvectedMaxwell(Liquid):
    r"""$J = s_1 + s_2$, $\dot s_1 = -s_1/\theta - Vs_1 - 2(\mu_p/\theta)V$,
    $\dot s_2 = -s_2/\theta - 4Vs_2 - 2(\mu_p/\theta)V$, $V = \dot R/R$ (Warnez & Johnsen 2015): exact at any strain.
    """

    name: ClassVar[str] = "upper-convected-maxwell"
    title: ClassVar[str] = "upper-convected Maxwell liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0, "mu": 0.0}),)

    def memory(self, p: Any) -> tuple[MemoryVariable, ...]:
        return upper_convected_maxwell(p.mu_p, p.relaxation_time)
