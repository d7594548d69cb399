"""Jeffreys branch beside a quadratic spring."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.jeffreys_neo_hookean import JeffreysNeoHookean
from en4dvar_bubble.laws.parameters import ALPHA, MU, MU_P, RELAXATION_TIME, G
from en4dvar_bubble.laws.quadratic import QuadraticKelvinVoigt
from en4dvar_bubble.laws.zener_quadratic import ZenerQuadratic


class JeffreysQuadratic(ZenerQuadratic):
    r"""$J = -4\mu\dot R/R + J_e(\lambda; G, \alpha) + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Warnez &
    Johnsen 2015; Yang et al. 2020): the quadratic law beside a Maxwell branch.
    """

    name: ClassVar[str] = "jeffreys-quadratic"
    title: ClassVar[str] = "Jeffreys with quadratic spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = (
        (ZenerQuadratic, {"mu": 0.0}),
        (QuadraticKelvinVoigt, {"mu_p": 0.0}),
        (JeffreysNeoHookean, {"alpha": 0.0}),
    )
