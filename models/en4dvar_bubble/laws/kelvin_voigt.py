"""Solids: a spring, a different one for each class, beside a Newtonian dashpot (Kelvin–Voigt); one is softened by the
largest stretch that it has seen, which a released bubble has at time zero.
"""

from functools import lru_cache
from typing import ClassVar

import numpy as np

from en4dvar.model.state import Array, Parameter
from en4dvar_bubble.laws.base import ConstitutiveLaw, Limits
from en4dvar_bubble.laws.parameters import ALPHA, MU, G, Values, positive


class NeoHookeanKelvinVoigt(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R - \tfrac G2\left[5 - 4\lambda^{-1} - \lambda^{-4}\right]$ (Gaudron et al. 2015)."""

    name = "neo-hookean-kelvin-voigt"
    title = "neo-Hookean Kelvin–Voigt (NHKV)"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU)

    def stress(self, stretch: Array, p: Values) -> Array:
        inverse = 1 / stretch
        return (-0.5 * p.G) * (5 - 4 * inverse - inverse**2 * inverse**2)


class QuadraticKelvinVoigt(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R + \tfrac{G(3\alpha-1)}2[5 - 4\lambda^{-1} - \lambda^{-4}]
    + 2G\alpha[\tfrac{27}{40} + \tfrac18\lambda^{-8} + \tfrac15\lambda^{-5} + \lambda^{-2} - 2\lambda]$ (Mancia et al.
    2021, eq. 2).
    """

    name = "quadratic-kelvin-voigt"
    title = "quadratic-law Kelvin–Voigt (QLKV)"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"alpha": 0.0}),)

    def stress(self, stretch: Array, p: Values) -> Array:
        inverse = 1 / stretch
        fourth = inverse**2 * inverse**2
        neo_hookean = 5 - 4 * inverse - fourth
        stiffening = 27 / 40 + fourth * (fourth / 8 + inverse / 5) + inverse**2 - 2 * stretch
        return (p.G * (1.5 * p.alpha - 0.5)) * neo_hookean + (2 * p.G * p.alpha) * stiffening


class LinearKelvinVoigt(ConstitutiveLaw):
    r"""$J = -4\mu\dot R/R - \tfrac{4G}3\left[1 - \lambda^{-3}\right]$ (Yang & Church 2005): small-strain elasticity,
    used at any strain; its stress levels off at $4G/3$.
    """

    name = "linear-kelvin-voigt"
    title = "linear Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MU)

    def stress(self, stretch: Array, p: Values) -> Array:
        return -4 / 3 * p.G * (1 - stretch**-3.0)


MIXING = Parameter("mixing", "1", "logit", (0.0, 1.0), "share of the second invariant", "$m$", source="Mooney (1940)")


class MooneyRivlinKelvinVoigt(ConstitutiveLaw):
    r"""$W = \tfrac G2\left[(1-m)(I_1-3) + m(I_2-3)\right]$ (Mooney 1940; Rivlin 1948), with a dashpot:
    $J_e = -(1-m)\tfrac G2\left[5-4\lambda^{-1}-\lambda^{-4}\right] - mG\left[2\lambda-1-\lambda^{-2}\right]$.
    """

    name = "mooney-rivlin-kelvin-voigt"
    title = "Mooney–Rivlin Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, MIXING, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"mixing": 0.0}),)

    def stress(self, stretch: Array, p: Values) -> Array:
        first = 0.5 * (5 - 4 / stretch - stretch**-4.0)
        second = 2 * stretch - 1 - stretch**-2.0
        return -p.G * ((1 - p.mixing) * first + p.mixing * second)


class FungKelvinVoigt(ConstitutiveLaw):
    r"""$W = \tfrac G{2\alpha}\left[e^{\alpha(I_1-3)} - 1\right]$, $I_1 = \lambda^{-4}+2\lambda^2$ (Fung 1993; Yang et
    al. 2020), with a dashpot. To first order in $\alpha(I_1-3)$ it is the quadratic law.
    """

    name = "fung-kelvin-voigt"
    title = "Fung exponential Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, ALPHA, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"alpha": 0.0}),)
    stretch_range = (0.5, 9.0)  # beyond, the slope of the table loses its sixth digit

    def strain_energy_rate(self, stretch: Array, p: Values) -> Array:
        I1 = stretch**-4.0 + 2 * stretch**2
        return 2 * p.G * np.exp(p.alpha * (I1 - 3)) * (stretch - stretch**-5.0)


J_M = positive("J_m", "1", "limit of I₁ − 3", "$J_m$", "Gent (1996)")


class GentKelvinVoigt(ConstitutiveLaw):
    r"""$W = -\tfrac{GJ_m}2\ln\left[1-(I_1-3)/J_m\right]$ (Gent 1996), with a dashpot. It has values as long as
    $I_1-3 < J_m$, at stretches from about $J_m^{-1/4}$ to $\sqrt{J_m/2}$; a member whose wall gets beyond fails as
    non-finite.
    """

    name = "gent-kelvin-voigt"
    title = "Gent Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, J_M, MU)
    example: ClassVar = {"J_m": 1e6}
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"J_m": np.inf}),)

    def strain_energy_rate(self, stretch: Array, p: Values) -> Array:
        room = 1 - (stretch**-4.0 + 2 * stretch**2 - 3) / p.J_m
        return 2 * p.G * (stretch - stretch**-5.0) / np.where(room > 0, room, np.nan)


EXPONENT = Parameter("a", "1", "lognormal", (1e-3, 20.0), "Ogden exponent", "$a$", source="Ogden (1972)")


class OgdenKelvinVoigt(ConstitutiveLaw):
    r"""$W = \tfrac{2G}{a^2}\left[\lambda_1^a+\lambda_2^a+\lambda_3^a - 3\right]
    = \tfrac{2G}{a^2}\left[\lambda^{-2a}+2\lambda^a-3\right]$ (Ogden 1972; G is the shear modulus), with a dashpot.
    """

    name = "ogden-kelvin-voigt"
    title = "Ogden (one term) Kelvin–Voigt"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, EXPONENT, MU)
    example: ClassVar = {"a": 2.5}
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"a": 2.0}),)

    def strain_energy_rate(self, stretch: Array, p: Values) -> Array:
        return 4 * p.G / p.a * (stretch ** (p.a - 1) - stretch ** (-2 * p.a - 1))


DAMAGE = Parameter(
    "damage", "1", "logit", (0.0, 1.0), "share of the stress that a large stretch takes", "$d$", source="Simo (1987)"
)

# ∫₀¹ … dv/v over the shells, in ln v: from where no stretch below e^10.5 is felt to the wall, where a compressed medium
# has all its strain within 1 − v ~ λ³.
_EDGES = np.concatenate([np.arange(-55.0, -1.0, 3.0), -(4.0 ** -np.arange(10)), [0.0]])
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_SHARE = np.exp((_EDGES[:-1, None] + np.diff(_EDGES)[:, None] * (_POINTS + 1) / 2).ravel())
_WEIGHT = (np.diff(_EDGES)[:, None] * _WEIGHTS / 2).ravel()


@lru_cache(maxsize=8)  # the nodes of the tables, again and again
def _stresses(stretches: bytes) -> Array:
    """(l⁻¹ − l⁻⁷) dv/v of the shells, (shells, K)."""
    grown = np.log1p(_SHARE[:, None] * (np.frombuffer(stretches) ** 3 - 1))  # ln l³
    return np.asarray(-np.exp(-grown / 3) * np.expm1(-2 * grown) * _WEIGHT[:, None])


class SofteningKelvinVoigt(NeoHookeanKelvinVoigt):
    r"""$J = -4\mu\dot R/R - \tfrac{2G}3\int_0^1(1-D)\,(l^{-1}-l^{-7})\,\tfrac{dv}v$, $D = d\,(1-e^{-W_m/G})$: each
    shell of a neo-Hookean medium has lost the share $D$ of its stress by its largest strain energy $W_m$ (Simo 1987),
    which it had at $R_{\max}$. Its stretch is now $l$, $l^3 = 1 + v(\lambda^3-1)$. Left out is what a collapse adds to
    the damage, and growth beyond $R_{\max}$.
    """

    name = "softening-kelvin-voigt"
    title = "neo-Hookean Kelvin–Voigt, softened by its largest stretch"
    parameters: ClassVar[tuple[Parameter, ...]] = (G, DAMAGE, MU)
    limits: ClassVar[Limits] = ((NeoHookeanKelvinVoigt, {"damage": 0.0}),)
    sized = released = True

    def stress(self, stretch: Array, p: Values) -> Array:
        largest = np.cbrt(1 + _SHARE * ((p.R_max / p.R0) ** 3 - 1))
        lost = -p.damage * np.expm1(1.5 - 0.5 * largest**-4.0 - largest**2)
        stresses = _stresses(np.ascontiguousarray(stretch).tobytes())
        gone = np.einsum("is,sk->ik", lost, stresses)  # without BLAS, whose bits depend on how many members there are
        return np.asarray(super().stress(stretch, p) + 2 / 3 * p.G * gone)
