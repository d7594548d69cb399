"""Linear Jeffreys liquid."""

from __future__ import annotations

from typing import ClassVar

from en4dvar.state import Parameter
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.maxwell import Maxwell
from en4dvar_bubble.laws.newtonian import Newtonian
from en4dvar_bubble.laws.parameters import MU, MU_P, RELAXATION_TIME


class Jeffreys(Maxwell):
    r"""$J = -4\mu\dot R/R + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$: a Maxwell branch beside a solvent
    (Allen & Roy 2000); retardation time $\theta\mu/(\mu+\mu_p)$.
    """

    name: ClassVar[str] = "jeffreys"
    title: ClassVar[str] = "linear Jeffreys liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0}), (Maxwell, {"mu": 0.0}))
