"""Jeffreys branch beside a neo-Hookean spring."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.jeffreys import Jeffreys
from en4dvar_bubble.laws.neo_hookean import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU, MU_P, RELAXATION_TIME, G
from en4dvar_bubble.laws.zener_neo_hookean import ZenerNeoHookean


class JeffreysNeoHookean(ZenerNeoHookean):
    r"""$J = -4\mu\dot R/R - \tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] + s$,
    $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Warnez & Johnsen 2015): spring, dashpot and Maxwell branch.
    """

    name: ClassVar[str] = "jeffreys-neo-hookean"
    title: ClassVar[str] = "Jeffreys with neo-Hookean spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = (
        (ZenerNeoHookean, {"mu": 0.0}),
        (NeoHookeanKelvinVoigt, {"mu_p": 0.0}),
        (Jeffreys, {"G": 0.0}),
    )
