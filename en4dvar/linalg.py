"""Small dense algebra of an ensemble: centring, the space its anomalies span, the Gauss–Newton Hessian in weight space.

Nothing here is larger than (N, n) or (K', N); no n×n matrix is ever formed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.state import Array


def centre(ensemble: Array) -> tuple[Array, Array]:
    """Mean (n,) and anomalies (N, n) of members as rows (N, n)."""
    mean = ensemble.mean(axis=0)
    return mean, ensemble - mean


def anomaly_basis(anomalies: Array) -> Array:
    """Orthonormal columns U (N, r) that span the column space of the anomalies X (N, n), r = rank X ≤ min(n, N − 1).

    Row i is member i in the coordinates of the ensemble. U Uᵀ projects weights on those that move the state: what it
    removes, the null space of Xᵀ, has no effect on x̄ + Xᵀw. Columns are scaled first, so units do not matter.
    """
    scale = np.sqrt(np.mean(anomalies**2, axis=0))
    u, s, _ = np.linalg.svd(anomalies / np.where(scale > 0, scale, 1.0), full_matrices=False)
    rank = int(np.sum(s > s[0] * max(anomalies.shape) * np.finfo(float).eps)) if s[0] > 0 else 0
    return np.asarray(u[:, :rank])


def min_norm_fit(design: Array, values: Array) -> Array:
    """Minimum-norm least-squares solution C of ``design @ C = values``; (m, r), (m, k) → (r, k)."""
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0])


@dataclass(frozen=True)
class Hessian:
    """A = (N−1) I + SᵀS through one economy SVD of the whitened anomalies S (K', N).

    ``singular_values`` (m,) and ``right`` (m, N), m = min(K', N), are S = (left) diag(singular_values) right.
    """

    singular_values: Array
    right: Array

    @classmethod
    def of(cls, s: Array) -> Hessian:
        _, sigma, right = np.linalg.svd(s, full_matrices=False)
        return cls(sigma, right)

    @property
    def prior_precision(self) -> float:
        """N − 1."""
        return float(self.right.shape[1] - 1)

    def solve(self, g: Array, damping: float = 0.0) -> Array:
        """(A + damping (N−1) I)⁻¹ g for g (N,)."""
        base = self.prior_precision * (1 + damping)
        coefficients = self.right @ g
        return np.asarray(g / base + (coefficients * (1 / (base + self.singular_values**2) - 1 / base)) @ self.right)

    @cached_property
    def transform(self) -> Array:
        """T = √(N−1) A^{-1/2} (N, N), the symmetric root: T 1 = 1 when S 1 = 0."""
        shrink = 1 / np.sqrt(1 + self.singular_values**2 / self.prior_precision) - 1
        return np.asarray(np.eye(self.right.shape[1]) + (self.right.T * shrink) @ self.right)
