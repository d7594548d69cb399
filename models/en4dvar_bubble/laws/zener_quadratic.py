"""Standard linear solid with a quadratic spring."""

from __future__ import annotations

from typing import Any, ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.memory import MemoryVariable, linear_maxwell
from en4dvar_bubble.laws.parameters import ALPHA, MU_P, RELAXATION_TIME, G
from en4dvar_bubble.laws.quadratic import QuadraticKelvinVoigt
from en4dvar_bubble.laws.zener_neo_hookean import ZenerNeoHookean


class ZenerQuadratic(QuadraticKelvinVoigt):
    r"""$J = J_e(\lambda; G, \alpha) + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$: the spring of the quadratic
    law beside a Maxwell branch (Warnez & Johnsen 2015; Yang et al. 2020).
    """

    name: ClassVar[str] = "zener-quadratic"
    title: ClassVar[str] = "standard linear solid (Zener), quadratic spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((ZenerNeoHookean, {"alpha": 0.0}), (QuadraticKelvinVoigt, {"mu_p": 0.0, "mu": 0.0}))

    def memory(self, p: Any) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)
