"""The Hessian of an analysis that stays near its prior: roots by a polynomial, without a decomposition.

With A = (N−1)(I + M), M = SᵀS/(N−1), the transform is T = (I + M)^{-1/2}. Where the observations inform less than twice
the prior, ‖M‖ ≤ 2, as in any filter that keeps up with its observations, a Chebyshev series of (1 + x)^{-1/2} reaches
rounding error with 13 to 30 terms, which are a handful of matrix products (Paterson & Stockmeyer 1973, SIAM J. Comput.
2, 60): three to four times faster than the eigenvectors of a matrix of 40 rows. A⁻¹ and T⁻¹ follow from T by a product.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from en4dvar.linalg import Hessian
from en4dvar.state import Array

LARGEST = 2.0  # ‖M‖, in the Frobenius norm
SMALLEST_SIDE = 16  # of S: below, the decomposition of the smaller Gram matrix is as fast
GROUP = 4  # powers of M that the series is evaluated with


@dataclass(frozen=True)
class NearPrior:
    """A by its ``transform`` T = √(N−1) A^{-1/2} (N, N) and M (N, N)."""

    transform: Array
    information: Array

    @classmethod
    def of(cls, s: Array) -> NearPrior | Hessian:
        """From whitened anomalies S (K', N); a :class:`~en4dvar.linalg.Hessian` where the series would be long."""
        n_members = s.shape[1]
        if min(s.shape) < SMALLEST_SIDE:
            return Hessian.of(s)
        information = s.T @ s
        information *= 1 / (n_members - 1)
        norm = np.sqrt(np.vdot(information, information))
        if not norm <= LARGEST:
            return Hessian.of(s)
        upper = 2.0 ** (0.5 * max(-6.0, np.ceil(2 * np.log2(norm)))) if norm > 0 else 0.125
        return cls(_inverse_root(information, float(upper)), information)

    @property
    def prior_precision(self) -> float:
        """N − 1."""
        return float(len(self.transform) - 1)

    def solve(self, g: Array) -> Array:
        """A⁻¹ g for g (N,)."""
        return np.asarray(self.transform @ (self.transform @ g) / self.prior_precision)

    @property
    def inverse_transform(self) -> Array:
        """T⁻¹ (N, N)."""
        return np.asarray(self.transform + self.transform @ self.information)


@lru_cache(maxsize=16)
def _series(upper: float) -> Array:
    """Coefficients (blocks, GROUP) of (1 + x)^{-1/2} on [0, upper] in powers of t = 2x/upper − 1, to rounding.

    The coefficient of degree d is of the order of ρ^{−d}, ρ the sum of the semi-axes of the ellipse with foci ±1
    through the singularity, t = −z.
    """
    z = 1 + 2 / upper
    degree = -np.log(np.finfo(float).eps) / np.arccosh(z) + 2
    blocks = int(np.ceil((degree + 1) / GROUP))
    series = Chebyshev.interpolate(lambda t: 1 / np.sqrt(1 + upper * (t + 1) / 2), GROUP * blocks - 1)
    powers = series.convert(kind=Polynomial).coef  # without trailing zeros
    return np.asarray(np.pad(powers, (0, GROUP * blocks - len(powers))).reshape(blocks, GROUP))


def _inverse_root(m: Array, upper: float) -> Array:
    """(I + M)^{-1/2} of a symmetric M (N, N) with eigenvalues in [0, upper]."""
    coefficients, n = _series(upper), len(m)
    t = np.empty((GROUP, n, n))
    t[0] = 0.0
    t[0].flat[:: n + 1] = 1.0
    np.multiply(m, 2 / upper, out=t[1])
    t[1].flat[:: n + 1] -= 1.0
    for j in range(2, GROUP):
        np.matmul(t[j - 1], t[1], out=t[j])
    beyond = t[GROUP - 1] @ t[1]
    blocks = (coefficients @ t.reshape(GROUP, -1)).reshape(-1, n, n)
    root = blocks[-1]
    for block in blocks[-2::-1]:
        root = root @ beyond
        root += block
    return np.asarray(root)
