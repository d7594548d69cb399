"""Liquids and solids with memory: a branch that relaxes (Maxwell), alone or beside a solvent (Jeffreys, Oldroyd-B), a
spring (Zener), or both.
"""

from typing import ClassVar

from en4dvar.model.state import Parameter
from en4dvar_bubble.laws.base import Limits, Liquid
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt, QuadraticKelvinVoigt
from en4dvar_bubble.laws.memory import MemoryVariable, linear_maxwell, upper_convected_maxwell
from en4dvar_bubble.laws.parameters import ALPHA, MU, MU_P, RELAXATION_TIME, G, Values
from en4dvar_bubble.laws.viscous import Newtonian


class _Branch:
    """With a Maxwell branch beside what the law has else."""

    def memory(self, p: Values) -> tuple[MemoryVariable, ...]:
        return linear_maxwell(p.mu_p, p.relaxation_time)


class Maxwell(_Branch, Liquid):
    r"""$J = s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$ (Allen & Roy 2000; Warnez & Johnsen 2015)."""

    name = "maxwell"
    title = "linear Maxwell liquid"
    parameters: ClassVar[tuple[Parameter, ...]] = (MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((Newtonian, {"mu_p": 0.0, "mu": 0.0}),)


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


class ZenerNeoHookean(_Branch, NeoHookeanKelvinVoigt):
    r"""$J = -\tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$:
    a neo-Hookean spring beside a Maxwell branch (Hua & Johnsen 2013; Warnez & Johnsen 2015).
    """

    name = "zener-neo-hookean"
    title = "standard linear solid (Zener), neo-Hookean spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"mu_p": 0.0, "mu": 0.0}), (Maxwell, {"G": 0.0}))


class ZenerQuadratic(_Branch, QuadraticKelvinVoigt):
    r"""$J = J_e(\lambda; G, \alpha) + s$, $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$: the spring of the quadratic
    law beside a Maxwell branch (Warnez & Johnsen 2015; Yang et al. 2020).
    """

    name = "zener-quadratic"
    title = "standard linear solid (Zener), quadratic spring"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU_P, RELAXATION_TIME)
    limits: ClassVar[Limits] = ((ZenerNeoHookean, {"alpha": 0.0}), (QuadraticKelvinVoigt, {"mu_p": 0.0, "mu": 0.0}))


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
