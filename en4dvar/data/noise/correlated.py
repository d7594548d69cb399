"""Gaussian errors that are correlated by a given matrix."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.data.noise.gaussian import Noise
from en4dvar.data.noise.predicted import Predicted
from en4dvar.model.state import Array


@dataclass(frozen=True)
class Correlation:
    """C (K, K), symmetric with a unit diagonal, positive definite. Raises :class:`ValueError` where it is not."""

    matrix: Array

    def __post_init__(self) -> None:
        c = self.matrix
        if c.ndim != 2 or c.shape[0] != c.shape[1] or not np.all(np.isfinite(c)):
            raise ValueError(f"the correlation of the observation errors must be a finite square matrix, not {c.shape}")
        if not (np.array_equal(c, c.T) and np.allclose(np.diag(c), 1, rtol=0, atol=1e-12)):
            raise ValueError("the correlation of the observation errors must be symmetric with a unit diagonal")
        try:
            _ = self.root
        except np.linalg.LinAlgError:
            raise ValueError("the covariance of the observation errors is not positive definite") from None

    def check_size(self, size: int) -> None:
        """Raise :class:`ValueError` unless it is that of so many errors."""
        if self.matrix.shape != (size, size):
            raise ValueError(f"correlation {self.matrix.shape} does not match {size} observations")

    @cached_property
    def root(self) -> Array:
        """L (K, K), lower triangular, with C = L Lᵀ."""
        return np.asarray(np.linalg.cholesky(self.matrix))

    @cached_property
    def whitening(self) -> Array:
        """L⁻¹ (K, K), lower triangular."""
        return np.asarray(np.tril(np.linalg.solve(self.root, np.eye(len(self.root)))))

    def decorrelated(self, columns: Array) -> Array:
        """L⁻¹ applied to columns (K,) or (K, N)."""
        return np.asarray(self.whitening @ columns)

    def correlated(self, rows: Array) -> Array:
        """Independent numbers (M, K) made to have this correlation."""
        return np.asarray(rows @ self.root.T)

    @cached_property
    def scale_root(self) -> Array:
        """B (K, K), lower triangular, with B Bᵀ = I + C∘C⁻¹, the Fisher information of ln s."""
        precision = self.whitening.T @ self.whitening
        return np.asarray(np.linalg.cholesky(np.eye(len(self.root)) + self.matrix * precision))


@dataclass(frozen=True)
class CorrelatedNoise(Noise):
    """Gaussian errors R = D C D."""

    correlation: Correlation

    @property
    def words(self) -> str:
        return ", correlated"

    @property
    def independent(self) -> bool:
        return False

    def check(self, weights: Array) -> None:
        super().check(weights)
        self.correlation.check_size(len(weights))
        if np.ptp(weights) > 0:
            raise ValueError("correlated observation errors need one weight for all observations")

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        s, whitening = self.error_std(at), self.correlation.whitening
        return np.asarray(weights * ((vectors / s) @ whitening.T @ whitening) / s)

    def log_conditional(self, values: Array, predicted: Predicted) -> Array:
        """With the precision P = C⁻¹ it is N((Pz)_k/P_kk, 1/P_kk) of what is new in z_k beside all others."""
        s, whitening = self.error_std(predicted), self.correlation.whitening
        scaled = ((values - predicted.values) / s) @ whitening.T @ whitening
        precision = np.sum(whitening**2, axis=0)
        return np.asarray(-0.5 * scaled**2 / precision + 0.5 * np.log(precision) - np.log(s) - self._log_norm())

    def matrices(self) -> dict[str, tuple[Array, str]]:
        return {"correlation": (self.correlation.matrix, "correlation of the observation errors")}

    def _correlated(self, v: Array) -> Array:
        return self.correlation.correlated(v)

    def _decorrelated(self, z: Array) -> Array:
        return np.asarray(z @ self.correlation.whitening.T)

    def _whitened_anomalies(self, row: Array, s: Array, anomalies: Array) -> Array:
        return np.asarray(row[:, None] * (self.correlation.whitening @ (anomalies / s).T))

    def _scale_rows(self, root_weight: Array, z: Array, v: Array, log_s: Array) -> tuple[Array, Array]:
        root = self.correlation.scale_root
        of_scale = root_weight * np.linalg.solve(root, z * (self.correlation.whitening.T @ v) - 1)
        return of_scale, root_weight[:, None] * (root.T @ log_s.T)

    def _log_root(self) -> Array:
        return np.asarray(-np.log(np.diag(self.correlation.whitening)))
