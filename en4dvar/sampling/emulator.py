r"""The emulator: what a forward model predicts, as polynomials of the control vector fitted to some of its runs.

    m_k(x) ≈ Σ_a c_ka z^a,   z = W (x − x̄),   |a| ≤ degree

Within a posterior predictions bend little, so that a few hundred runs tell them to a small part of the observation
error, and to evaluate them costs nothing. :mod:`~en4dvar.sampling.emulated_cost` makes J of one data set of them.

Sources: polynomial surrogates of posteriors, Marzouk & Xiu (2009), Commun. Comput. Phys. 6, 826; sampling where the
surrogate says, Li & Marzouk (2014), SIAM J. Sci. Comput. 36, A1163.
"""

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array


class Coordinates(NamedTuple):
    """z = whiten (x − centre) of control vectors (B, n); ``root`` is the inverse of ``whiten``."""

    centre: Array
    root: Array
    whiten: Array

    @classmethod
    def about(cls, points: Array) -> "Coordinates":
        """Those in which points (N, n) have mean zero and standard deviation 1 in every direction."""
        root = np.linalg.cholesky(np.atleast_2d(np.cov(points, rowvar=False)))
        return cls(points.mean(axis=0), np.asarray(root), np.asarray(np.linalg.inv(root), dtype=float))

    def of(self, x: Array) -> Array:
        """z (B, n) of control vectors (B, n)."""
        return np.asarray((x - self.centre) @ self.whiten.T)

    def back(self, z: Array) -> Array:
        """Control vectors (B, n) of z (B, n)."""
        return np.asarray(self.centre + z @ self.root.T)


class Emulator(NamedTuple):
    """Polynomials of ``coordinates``: ``coefficients`` (M, K) of the monomials of ``parents``."""

    coordinates: Coordinates
    parents: npt.NDArray[np.int64]
    coefficients: Array

    @classmethod
    def fitted(
        cls, coordinates: Coordinates, degree: int, x: Array, outputs: Array, counts: Array, ridge: float
    ) -> "Emulator":
        """Least squares on runs at ``x`` (B, n) that gave ``outputs`` (B, K) and count so much (B,).

        ``ridge`` is relative to the normal equations of scaled columns: it decides where runs leave a coefficient open.
        """
        parents = monomials(x.shape[1], degree)
        matrix = np.ascontiguousarray(basis(coordinates.of(x), parents).T)
        weighted = matrix * counts[:, None]
        normal = weighted.T @ matrix
        scale = np.sqrt(np.diag(normal))
        normal = normal / np.outer(scale, scale)
        normal[np.diag_indices_from(normal)] += ridge
        coefficients = np.linalg.solve(normal, (weighted.T @ outputs) / scale[:, None]) / scale[:, None]
        return cls(coordinates, parents, np.asarray(coefficients))

    def predictions(self, x: Array) -> Array:
        """Outputs (B, K) at control vectors (B, n)."""
        values = basis(self.coordinates.of(x), self.parents)
        return np.asarray(np.ascontiguousarray(values.T) @ self.coefficients)


def monomials(n: int, degree: int) -> npt.NDArray[np.int64]:
    """(M, 2) of the monomials in n coordinates up to ``degree``, in order of degree; the first is 1.

    Monomial j is monomial ``[j, 0]`` times coordinate ``[j, 1]``.
    """
    index: dict[tuple[int, ...], int] = {(): 0}
    parents = [(0, 0)]
    for d in range(1, degree + 1):
        for combination in itertools.combinations_with_replacement(range(n), d):
            index[combination] = len(parents)
            parents.append((index[combination[:-1]], combination[-1]))
    return np.array(parents, dtype=np.int64)


def basis(z: Array, parents: npt.NDArray[np.int64]) -> Array:
    """Monomials (M, B) of points (B, n), all of one degree at a time."""
    values = np.empty((len(parents), len(z)))
    values[0] = 1.0
    begin = 1
    while begin < len(parents):
        end = int(np.searchsorted(parents[:, 0], begin))  # what is multiplied lies before
        np.multiply(values[parents[begin:end, 0]], z.T[parents[begin:end, 1]], out=values[begin:end])
        begin = end
    return values
