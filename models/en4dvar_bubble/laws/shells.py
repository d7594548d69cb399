"""Coated bubbles in a liquid: lipid monolayers, whose tension depends on their area, and shells with a thickness.

The tension σ₀ at rest is the surface tension of the bubble, and what the coating changes of it belongs to J:
−2[σ(λ) − σ₀]/R. So there is no stress at rest, where the gas has the pressure p_∞ + 2σ₀/R₀.
"""

import math
from typing import ClassVar

import numpy as np

from en4dvar.model.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.parameters import MU, Values, positive
from en4dvar_bubble.laws.viscous import Newtonian

_CHURCH = "Church (1995)"
_MARMOTTANT = "Marmottant et al. (2005)"
CHI = positive("chi", "N/m", "elasticity of the coating", r"$\chi$", _MARMOTTANT)
KAPPA_S = positive("kappa_s", "kg/s", "surface viscosity of the coating", r"$\kappa_s$", _MARMOTTANT)
SIGMA_0 = positive("sigma_0", "N/m", "tension of the coating at rest", r"$\sigma_0$", _MARMOTTANT, "mN/m")
SIGMA_W = positive("sigma_w", "N/m", "tension of the broken coating", r"$\sigma_w$", _MARMOTTANT, "mN/m")
G_S = positive("G_s", "Pa", "shear modulus of the shell", "$G_s$", _CHURCH, "MPa")
MU_S = positive("mu_s", "Pa s", "viscosity of the shell", r"$\mu_s$", _CHURCH)
THICKNESS = positive("thickness", "m", "thickness of the shell at rest", "$d$", _CHURCH, "nm")


class SarkarShell(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R - 4\kappa_s\dot R/R^2 - 2[\sigma(\lambda)-\sigma_0]/R$, $\sigma = \sigma_0 +
    \chi(\lambda^2-1)$: a coating of constant elasticity (Sarkar et al. 2005), which may be compressed below no tension.
    """

    name = "sarkar-shell"
    title = "elastic coating (Sarkar)"
    parameters: ClassVar[tuple[Parameter, ...]] = (CHI, KAPPA_S, SIGMA_0, MU)
    example: ClassVar = {"chi": 0.5, "kappa_s": 1e-8, "mu": 1e-3}
    limits: ClassVar[Limits] = ((Newtonian, {"chi": 0.0, "kappa_s": 0.0}),)
    sized = True
    rest_tension = "sigma_0"

    def tension(self, stretch: Array, p: Values) -> Array:
        """σ(λ) in N/m."""
        return p.sigma_0 + p.chi * (stretch**2 - 1)

    def stress(self, stretch: Array, p: Values) -> Array:
        return -2 * (self.tension(stretch, p) - p.sigma_0) / (p.R0 * stretch)

    def strained_viscosity(self, stretch: Array, p: Values) -> Array:
        return p.mu + p.kappa_s / (p.R0 * stretch)


class MarmottantShell(SarkarShell):
    r"""$J = -4\mu\dot R/R - 4\kappa_s\dot R/R^2 - 2[\sigma-\sigma_0]/R$, $\sigma = \chi(R^2/R_b^2 - 1)$ between 0 below
    the buckling radius $R_b = R_0/\sqrt{1+\sigma_0/\chi}$ and $\sigma_w$, where the coating breaks (Marmottant et al.
    2005). A member with $\sigma_0 > \sigma_w$ fails as non-finite.
    """

    name = "marmottant-shell"
    title = "lipid coating that buckles and breaks (Marmottant)"
    parameters: ClassVar[tuple[Parameter, ...]] = (CHI, KAPPA_S, SIGMA_0, SIGMA_W, MU)
    example: ClassVar = {**SarkarShell.example, "sigma_w": 0.072}
    limits: ClassVar[Limits] = ((SarkarShell, {"chi": 0.0, "sigma_0": 0.0}),)
    monotone = False  # no tension changes where it buckles or is broken
    kinked = True

    def tension(self, stretch: Array, p: Values) -> Array:
        limit = np.where(p.sigma_0 <= p.sigma_w, p.sigma_w, np.nan)
        return np.clip((p.chi + p.sigma_0) * stretch**2 - p.chi, 0.0, limit)


class GompertzShell(MarmottantShell):
    r"""As Marmottant's, without kinks: $\sigma = \sigma_w(\sigma_0/\sigma_w)^{e^{c(R_0-R)/R_b}}$, whose largest slope,
    $c = \tfrac{2\chi e}{\sigma_w}\sqrt{1+\tfrac{\sigma_w}{2\chi}}$, is Marmottant's at $\sigma_w/2$ (Gümmer, Schenke &
    Denner 2021). It needs $0 < \sigma_0 < \sigma_w$.
    """

    name = "gompertz-shell"
    title = "lipid coating, smooth (Marmottant–Gompertz)"
    limits: ClassVar[Limits] = ()

    def tension(self, stretch: Array, p: Values) -> Array:
        steep = math.e / p.sigma_w * np.sqrt(2 * (2 * p.chi + p.sigma_w) * (p.chi + p.sigma_0))  # c R0/R_b
        with np.errstate(all="ignore"):  # far below the buckling radius the tension is zero
            return np.asarray(p.sigma_w * np.exp(np.log(p.sigma_0 / p.sigma_w) * np.exp(steep * (1 - stretch))))


class ChurchShell(ConstitutiveLaw):
    r"""$J = -\frac{4}{\lambda^3+v}\left[G_s v\,(1-\lambda^{-1}) + (\mu_s v + \mu\lambda^3)\dot R/R\right]$,
    $v = (1+d/R_0)^3-1$: an elastic shell with a thickness (Church 1995), as dense as the liquid, free of stress at
    rest, the tension of both its surfaces lumped at the gas. For $d \ll R_0$ it is the shell of Hoff et al. (2000).
    """

    name = "church-shell"
    title = "thick elastic shell (Church)"
    parameters: ClassVar[tuple[Parameter, ...]] = (G_S, MU_S, THICKNESS, MU)
    example: ClassVar = {"G_s": 5e7, "mu_s": 1.0, "thickness": 2e-8, "mu": 1e-3}
    limits: ClassVar[Limits] = ((Newtonian, {"thickness": 0.0}),)
    monotone = False  # it gets thinner the more it is stretched
    sized = True

    def stress(self, stretch: Array, p: Values) -> Array:
        v = (1 + p.thickness / p.R0) ** 3 - 1
        return -4 * p.G_s * v * (1 - 1 / stretch) / (stretch**3 + v)

    def strained_viscosity(self, stretch: Array, p: Values) -> Array:
        v = (1 + p.thickness / p.R0) ** 3 - 1
        return (p.mu_s * v + p.mu * stretch**3) / (stretch**3 + v)
