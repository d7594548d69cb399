"""A series of observation vectors for sequential assimilation, and the whitening of its errors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.state import Array


@dataclass(frozen=True)
class Series:
    """Observations ``values`` (K, p) at increasing ``times`` (K,) > 0 with errors R_k = D_k C D_k, D_k = diag(std_k).

    ``std`` is (p,) or (K, p). ``correlation`` C (p, p), full or block diagonal, is that of the errors of one instant;
    None: independent. Errors of different instants are independent.

    Raises
    ------
    ValueError: shapes that do not fit, times that do not increase from zero, std that is not positive, C that is no
        correlation matrix.
    """

    times: Array
    values: Array
    std: Array
    correlation: Array | None = None

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.times.shape != self.values.shape[:1]:
            raise ValueError(f"values {self.values.shape} do not match times {self.times.shape}")
        if self.std.shape not in (self.values.shape, self.values.shape[1:]):
            raise ValueError(f"std {self.std.shape} does not match values {self.values.shape}")
        if not (np.all(np.diff(self.times, prepend=0.0) > 0) and np.all(self.std > 0)):
            raise ValueError("times must increase from zero and std must be positive")
        if self.correlation is not None:
            root_of_correlation(self.correlation, self.values.shape[1])

    def whiten(self, k: int, reference: Array, anomalies: Array) -> tuple[Array, Array]:
        """d = R_k^{-1/2}(y_k − reference) (p,) and S = R_k^{-1/2} anomaliesᵀ (p, N) of anomalies (N, p)."""
        std = self.std if self.std.ndim == 1 else self.std[k]
        d, s = (self.values[k] - reference) / std, (anomalies / std).T
        return (d, s) if self._whitening is None else (self._whitening @ d, self._whitening @ s)

    @cached_property
    def _whitening(self) -> Array | None:
        """L⁻¹ (p, p), lower triangular, with C = L Lᵀ."""
        if self.correlation is None:
            return None
        root = root_of_correlation(self.correlation, self.values.shape[1])
        return np.asarray(np.tril(np.linalg.solve(root, np.eye(len(root)))))


def root_of_correlation(correlation: Array, size: int) -> Array:
    """Lower triangular L (p, p) with C = L Lᵀ. Raises :class:`ValueError` where C is no correlation matrix (p, p)."""
    if correlation.shape != (size, size):
        raise ValueError(f"correlation {correlation.shape} does not match {size} observations")
    if not (np.array_equal(correlation, correlation.T) and np.allclose(np.diag(correlation), 1, rtol=0, atol=1e-12)):
        raise ValueError("the correlation of the observation errors must be symmetric with a unit diagonal")
    try:
        return np.asarray(np.linalg.cholesky(correlation))
    except np.linalg.LinAlgError:
        raise ValueError("the covariance of the observation errors is not positive definite") from None
