"""A solid that has been softened by the largest stretch that it has seen, which a released bubble has at time zero."""

from functools import lru_cache
from typing import ClassVar

import numpy as np

from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.compiled import kernel
from en4dvar_bubble.laws.base import Limits
from en4dvar_bubble.laws.kelvin_voigt import NeoHookeanKelvinVoigt
from en4dvar_bubble.laws.parameters import MU, G, Values

DAMAGE = Parameter(
    "damage",
    "1",
    "logit",
    (0.0, 1.0),
    "share of the stress that a large stretch takes",
    "$d$",
    source="Simo (1987)",
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


@kernel
def _sum(shares: Array, stresses: Array) -> Array:
    """The matrix product, member by member: its bits do not depend on how many there are."""
    out = np.zeros((shares.shape[0], stresses.shape[1]))
    for i in range(shares.shape[0]):
        for j in range(shares.shape[1]):
            for k in range(stresses.shape[1]):
                out[i, k] += shares[i, j] * stresses[j, k]
    return out


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
        gone = _sum(lost, _stresses(np.ascontiguousarray(stretch).tobytes()))
        return np.asarray(super().stress(stretch, p) + 2 / 3 * p.G * gone)
