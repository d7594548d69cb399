"""Linear Maxwell liquid."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.memory import MemoryVariable, linear_maxwell
from en4dvar_bubble.laws.newtonian import Newtonian
from en4dvar_bubble.laws.parameters import MU_P, RELAXATION_TIME


class Maxwell(Liquid):
    r"""$J = s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Allen & Roy 2000; Warnez & Johnsen 2015)."""

    name: ClassVar[str] = "maxwell"
    title: ClassVar[str] = "linear Maxwell liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0, "mu": 0.0}),)

    def memory(self, p: Any) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)
