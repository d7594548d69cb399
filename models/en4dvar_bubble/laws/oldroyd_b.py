"""Oldroyd-B liquid."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.newtonian import Newtonian
from en4dvar_bubble.laws.parameters import MU, MU_P, RELAXATION_TIME
from en4dvar_bubble.laws.upper_convected import UpperConvectedMaxwell


class OldroydB(UpperConvectedMaxwell):
    r"""$J = -4\mu\dot R/R + s_1 + s_2$, $\dot s_1 = -s_1/\theta - Vs_1 - 2(\mu_p/\theta)V$,
    $\dot s_2 = -s_2/\theta - 4Vs_2 - 2(\mu_p/\theta)V$ (Oldroyd 1950; Warnez & Johnsen 2015): polymer in a solvent.
    """

    name: ClassVar[str] = "oldroyd-b"
    title: ClassVar[str] = "Oldroyd-B liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((UpperConvectedMaxwell, {"mu": 0.0}), (Newtonian, {"mu_p": 0.0}))
