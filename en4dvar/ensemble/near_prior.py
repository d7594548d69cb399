"""The Hessian of an analysis that stays near its prior: roots by a polynomial, without a decomposition.

With A = (N−1)(I + M), M = SᵀS/(N−1), the transform is T = (I + M)^{-1/2}. Where the observations inform no direction
more than the prior does, M ≤ 1, as in a filter that keeps up with its observations, a Chebyshev series of (1 + x)^{-½}
reaches rounding error with 12 to 24 terms, which are a handful of matrix products (Paterson & Stockmeyer 1973, SIAM J.
Comput. 2, 60): three times faster than the eigenvectors of a matrix of 40 rows. A⁻¹ and T⁻¹ follow from T by a product.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from en4dvar.ensemble.linalg import Hessian
from en4dvar.model.state import Array

LARGEST = 1.0  # bound (Σ λ⁴)^{1/4} of the eigenvalues of M
SMALLEST_SIDE = 16  # of S: below, the decomposition of the smaller Gram matrix is as fast
GROUP = 4  # powers of M, from 0, that the series is evaluated with


@dataclass(frozen=True)
class NearPrior:
    """A by its ``transform`` T = √(N−1) A^{-1/2} (N, N) and M (N, N)."""

    transform: Array
    information: Array

    @classmethod
    def of(cls, s: Array) -> "NearPrior | Hessian":
        """From whitened anomalies S (K', N); a :class:`~en4dvar.ensemble.linalg.Hessian` for a long series."""
        n_members = s.shape[1]
        if min(s.shape) < SMALLEST_SIDE:
            return Hessian.of(s)
        information = s.T @ s
        information *= 1 / (n_members - 1)
        square = information @ information
        bound = float(np.vdot(square, square)) ** 0.25
        if not bound <= LARGEST:
            return Hessian.of(s)
        upper = 2.0 ** (0.5 * max(-6, math.ceil(2 * math.log2(bound)))) if bound > 0 else 0.125
        return cls(_inverse_root(information, square, upper), information)

    @property
    def prior_precision(self) -> float:
        """N − 1."""
        return float(len(self.transform) - 1)

    def solve(self, g: Array) -> Array:
        """A⁻¹ g for g (N,), or for every row of g (M, N)."""
        return np.asarray((self.transform @ (self.transform @ g.T)).T / self.prior_precision)

    @property
    def inverse_transform(self) -> Array:
        """T⁻¹ (N, N)."""
        return np.asarray(self.transform + self.transform @ self.information)


@lru_cache(maxsize=16)
def _series(upper: float) -> Array:
    """Coefficients (blocks, GROUP) of (1 + x)^{-1/2} on [0, upper] in powers of x, to rounding.

    That of degree d in Chebyshev polynomials is of the order of ρ^{−d}, ρ the sum of the semi-axes of the ellipse with
    the foci 0 and ``upper``, scaled to ±1, through the singularity at x = −1.
    """
    degree = -math.log(np.finfo(float).eps) / math.acosh(1 + 2 / upper) + 2
    blocks = math.ceil((degree + 1) / GROUP)
    interval = [0, upper]
    series = Chebyshev.interpolate(lambda x: 1 / np.sqrt(1 + x), GROUP * blocks - 1, interval)
    powers = series.convert(interval, Polynomial, interval).coef  # without trailing zeros
    return np.asarray(np.pad(powers, (0, GROUP * blocks - len(powers))).reshape(blocks, GROUP))


def _inverse_root(m: Array, square: Array, upper: float) -> Array:
    """(I + M)^{-1/2} of a symmetric M (N, N) with eigenvalues in [0, upper] and its square."""
    coefficients, n = _series(upper), len(m)
    powers = np.empty((GROUP, n, n))
    powers[0] = 0.0
    powers[0].flat[:: n + 1] = 1.0
    powers[1], powers[2] = m, square
    np.matmul(square, m, out=powers[3])
    beyond = square @ square
    blocks = (coefficients @ powers.reshape(GROUP, -1)).reshape(-1, n, n)
    root = blocks[-1]
    for block in blocks[-2::-1]:
        root = root @ beyond
        root += block
    return np.asarray(root)
