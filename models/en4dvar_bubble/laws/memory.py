"""Memory variables: stresses that relax."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from en4dvar.model.state import Array

Source = float | Array | Callable[[Array], Array]


@dataclass(frozen=True)
class MemoryVariable:
    """A stress s (Pa) that adds to J, with ds/dt = −s/θ + k V s + V a(λ) + b(λ)/θ, V = Ṙ/R.

    Attributes
    ----------
    relaxation_time: θ in s, number or (N, 1).
    convection: k, a number.
    stiffness: a(λ) in Pa: a number, (N, 1), or a function of the stretch (K,) → (N, K).
    equilibrium: b(λ) in Pa, likewise: the value of s at rest.
    """

    relaxation_time: float | Array
    convection: float = 0.0
    stiffness: Source = 0.0
    equilibrium: Source = 0.0

    def stiffness_at(self, stretch: Array) -> float | Array:
        """a at stretches (K,)."""
        return self.stiffness(stretch.copy()) if callable(self.stiffness) else self.stiffness

    def equilibrium_at(self, stretch: Array) -> float | Array:
        """b at stretches (K,)."""
        return self.equilibrium(stretch.copy()) if callable(self.equilibrium) else self.equilibrium


class MemoryTables(NamedTuple):
    """The memory variables of N members as the compiled solver takes them; tables on the grid of ln λ."""

    relaxation_time: Array
    """θ (N, M) in s."""
    convection: Array
    """k (M,)."""
    stiffness: Array
    """a (N, M, cells, 8) in Pa."""
    equilibrium: Array
    """b (N, M, cells, 8) in Pa."""


def linear_maxwell(viscosity: Array, relaxation_time: Array) -> tuple[MemoryVariable, ...]:
    r"""A dashpot and a linear spring in series: $\dot s = -s/\theta - 4(\mu_p/\theta)\dot R/R$.

    Exact for small strain within a relaxation time. The rheometry codes differentiate at fixed r instead of with the
    material, which adds $-3\dot R/R\,s$ (``convection=-3``); the two agree at small strain, and at large strain neither
    is objective: prefer :func:`upper_convected_maxwell` there.
    """
    return (MemoryVariable(relaxation_time, stiffness=-4 * viscosity / relaxation_time),)


def upper_convected_maxwell(viscosity: Array, relaxation_time: Array) -> tuple[MemoryVariable, ...]:
    r"""The upper-convected Maxwell liquid: $\dot s_1 = -s_1/\theta - V s_1 - 2(\mu_p/\theta)V$ and
    $\dot s_2 = -s_2/\theta - 4V s_2 - 2(\mu_p/\theta)V$ (Warnez & Johnsen 2015: $Z_i = R^3 s_i$).

    Exact at any strain for a liquid at rest before time zero. Along $r^3 - R^3 = y$ the equations
    $\dot\tau_{rr} + 4\frac{R^2\dot R}{r^3}\tau_{rr} + \tau_{rr}/\theta = -4\frac{\mu_p}\theta\frac{R^2\dot R}{r^3}$,
    $\dot\tau_{\theta\theta} - 2\frac{R^2\dot R}{r^3}\tau_{\theta\theta} + \tau_{\theta\theta}/\theta
    = 2\frac{\mu_p}\theta\frac{R^2\dot R}{r^3}$ have integrating factors $r^4$ and $r^{-2}$. The integral over y gives
    $J = -2\frac{\mu_p}\theta\int e^{-(t-t')/\theta}\,V'\,\frac{q^2-q^{-4}}{q^3-1}\,dt'$ with $q = R(t)/R(t')$, and
    $(q^2-q^{-4})/(q^3-1) = q^{-1}+q^{-4}$: two exponentials. The two are not the integrals of
    $\tau_{rr}$ and $\tau_{\theta\theta}$, which do not close on their own; only the sum is exact.
    """
    stiffness = -2 * viscosity / relaxation_time
    return (MemoryVariable(relaxation_time, -1.0, stiffness), MemoryVariable(relaxation_time, -4.0, stiffness))
