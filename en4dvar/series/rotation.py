"""Random rotations of an ensemble that keep its mean and covariance.

A rotation is a product of Householder reflections H_j = 1 − 2 v_j v_jᵀ / |v_j|² with directions uniform on the unit
sphere of 1⊥: a random walk on the group of such maps whose stationary law is Haar's, at O(N n) where drawing from
Haar's law itself costs O(N³). In compact form H_m … H_1 = 1 − V L Vᵀ with L⁻¹ the lower triangle of VᵀV, its diagonal
halved. Why rotate: Sakov & Oke (2008), Mon. Wea. Rev. 136, 1042; compact form: Schreiber & Van Loan (1989), SIAM J.
Sci. Stat. Comput. 10, 53.
"""

import numpy as np

from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream

REFLECTIONS = 4  # of a rotation
BLOCK = 64  # rotations drawn together; part of the random numbers' definition


def reflections(directions: Array) -> tuple[Array, Array]:
    """Factors (…, N, m) and (…, m, N) of what H_m … H_1 takes away, from directions (…, m, N), not yet in 1⊥."""
    v = directions - directions.mean(axis=-1, keepdims=True)
    gram = v @ np.swapaxes(v, -1, -2)
    inverse = np.tril(gram, -1) + 0.5 * (np.eye(gram.shape[-1]) * gram)
    return np.asarray(np.swapaxes(np.linalg.solve(np.swapaxes(inverse, -1, -2), v), -1, -2)), v


def rotate(anomalies: Array, factors: tuple[Array, Array]) -> Array:
    """Anomalies (N, n) rotated by what :func:`reflections` made of directions (m, N)."""
    left, right = factors
    return np.asarray(anomalies - left @ (right @ anomalies))


class Rotations:
    """The rotations of a sequential run; cycle k has its own, whatever was drawn before."""

    def __init__(self, seed: int, n_members: int):
        self._seed, self._drawn = seed, n_members
        self._block: tuple[int, int] = (-1, -1)
        self._factors = (np.empty(0), np.empty(0))

    def of_cycle(self, cycle: int, n_members: int) -> tuple[Array, Array]:
        """Factors for ``n_members`` ≤ N members, N those of the start."""
        block, within = divmod(cycle, BLOCK)
        if self._block != (block, n_members):
            stream = member_stream(self._seed, "rotation", block)
            directions = stream.standard_normal((BLOCK, REFLECTIONS, self._drawn))[..., :n_members]
            self._factors, self._block = reflections(directions), (block, n_members)
        return self._factors[0][within], self._factors[1][within]
