"""Standard linear solid with a neo-Hookean spring."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.maxwell import Maxwell
from en4dvar_bubble.laws.memory import MemoryVariable, linear_maxwell
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU_P, RELAXATION_TIME, G


class ZenerNeoHookean(NeoHookeanKelvinVoigt):
    r"""$J = -\tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$:
    a neo-Hookean spring beside a Maxwell branch (Hua & Johnsen 2013; Warnez & Johnsen 2015).
    """

    name: ClassVar[str] = "zener-neo-hookean"
    title: ClassVar[str] = "standard linear solid (Zener), neo-Hookean spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"mu_p": 0.0, "mu": 0.0}), (Maxwell, {"G": 0.0}))

    def memory(self, p: Any) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)
