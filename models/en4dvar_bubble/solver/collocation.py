"""Collocation for spherically symmetric fields in the unit ball: even functions of y = r/R, nodes in s = y².

The nodes are the Chebyshev–Radau points ξ ∈ (0, 1] with the wall y = 1 last, so no node sits at the centre and the
fields are smooth there by construction: polynomials in ξ, where s = ξ, or in a map of s that clusters the nodes at the
wall. There is the thermal boundary layer of a collapse, which is thinner than the distance of Chebyshev points.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.special import roots_jacobi

from en4dvar.model.state import Array

_MORE = 30  # points of the quadrature for the map, an entire function


@dataclass(frozen=True)
class Grid:
    """Operators on m interior nodes plus the wall, which is last; they are shared: nobody can write to them.

    ``x`` (m+1,) radii r/R; ``derivative`` (m+1, m+1) d/dx; ``laplacian`` (m+1, m+1) x⁻² d/dx(x² d/dx); ``own`` (2, m+1)
    what else the equations read, of a ball x and the weights of the mean, outside of it x − x⁻² and x⁻⁶.
    """

    x: Array
    derivative: Array
    laplacian: Array
    own: Array

    def __post_init__(self) -> None:
        for array in vars(self).values():
            array.setflags(write=False)

    @property
    def weights(self) -> Array:
        """(m+1,) of the mean over the ball, 3 ∫ f x² dx, exact for polynomials of degree m in ξ."""
        return np.asarray(self.own[1])

    @cached_property
    def rows(self) -> Array:
        """All of them as one array in the kernel's layout, see :class:`arrays.Equations`."""
        return np.vstack([self.derivative, self.laplacian[:-1], self.own])


@cache
def ball(m: int, clustering: float = 0.0) -> Grid:
    """That of ``m`` ≥ 1 interior nodes in the ball. ``clustering`` c ≥ 0: 1 − s = sinh(c (1−ξ))/sinh(c); 0 is s = ξ."""
    n = m + 1
    xi = (np.cos(2 * np.pi * np.arange(m, -1, -1) / (2 * m + 1)) + 1) / 2
    xi[-1] = 1.0
    s, ds_dxi = _clustered(xi, clustering)
    gaps = xi[:, None] - xi[None, :] + np.eye(n)
    barycentric = 1.0 / np.prod(4 * gaps, axis=1) * 4
    d_dxi = barycentric[None, :] / barycentric[:, None] / gaps
    np.fill_diagonal(d_dxi, 0.0)
    np.fill_diagonal(d_dxi, -d_dxi.sum(axis=1))
    d_ds = d_dxi / ds_dxi[:, None]
    y = np.sqrt(s)
    derivative = 2 * y[:, None] * d_ds
    laplacian = 4 * s[:, None] * (d_ds @ d_ds) + 6 * d_ds
    # Weights: 3 ∫ f y² dy = 3/2 ∫ f √s ds, moments of the Legendre polynomials by Gauss–Jacobi quadrature in ξ.
    x, w = roots_jacobi(n + 1 + (_MORE if clustering else 0), 0.0, 0.5)
    s_there, slope_there = _clustered((x + 1) / 2, clustering)
    w = w / w.sum() * np.sqrt(2 * s_there / (x + 1)) * slope_there
    moments = np.polynomial.legendre.legvander(x, m).T @ w
    weights = np.linalg.solve(np.polynomial.legendre.legvander(2 * xi - 1, m).T, moments)
    return Grid(y, derivative, laplacian, np.stack([y, weights]))


def _clustered(xi: Array, clustering: float) -> tuple[Array, Array]:
    """s and ds/dξ."""
    if not clustering:
        return xi, np.ones_like(xi)
    inward, scale = clustering * (1 - xi), np.sinh(clustering)
    return 1 - np.sinh(inward) / scale, clustering * np.cosh(inward) / scale


@cache
def exterior(m: int, length: float) -> Grid:
    """Rational Chebyshev collocation of fields outside the unit ball that vanish at infinity, on x = 1 + ``length``
    (1−ξ)/(1+ξ), clustered at the wall.
    """
    n = m + 1
    xi = np.cos(np.pi * np.arange(n + 1) / n)  # 1 (wall) … −1 (infinity)
    c = np.r_[2.0, np.ones(n - 1), 2.0] * (-1.0) ** np.arange(n + 1)
    d = (c[:, None] / c[None, :]) / (xi[:, None] - xi[None, :] + np.eye(n + 1))
    np.fill_diagonal(d, 0.0)
    np.fill_diagonal(d, -d.sum(axis=1))
    keep = np.r_[np.arange(1, n), 0]  # infinity, where the field is zero, is dropped; the wall goes last
    dxi_dx = -((1 + xi) ** 2) / (2 * length)
    first = dxi_dx[:, None] * d
    second = (first @ first)[np.ix_(keep, keep)]
    x = 1 + length * (1 - xi[keep]) / (1 + xi[keep])
    derivative = first[np.ix_(keep, keep)]
    laplacian = second + (2 / x)[:, None] * derivative
    return Grid(x, derivative, laplacian, np.stack([x - x**-2, x**-6.0]))
