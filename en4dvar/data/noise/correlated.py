"""Gaussian errors that are correlated: by a given matrix, or because they have parts in common."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded

from en4dvar.data.noise.gaussian import Noise, Predicted
from en4dvar.model.state import Array


class AnyCorrelation:
    """C (K, K) of errors, with a unit diagonal: its ``matrix``, and what a kind of them may know without forming it."""

    matrix: Array

    def check_size(self, size: int) -> None:
        """Raise :class:`ValueError` unless it is that of so many errors."""
        if (k := len(self.log_root)) != size:
            raise ValueError(f"correlation {(k, k)} does not match {size} observations")

    @cached_property
    def root(self) -> Array:
        """L (K, K), lower triangular, with C = L Lᵀ."""
        return np.asarray(np.linalg.cholesky(self.matrix))

    @cached_property
    def whitening(self) -> Array:
        """L⁻¹ (K, K), lower triangular."""
        return np.asarray(np.tril(np.linalg.solve(self.root, np.eye(len(self.root)))))

    @cached_property
    def precision(self) -> Array:
        """C⁻¹ (K, K)."""
        return np.asarray(self.whitening.T @ self.whitening)

    @property
    def precision_diagonal(self) -> Array:
        """The diagonal of C⁻¹ (K,)."""
        return np.diag(self.precision)

    @property
    def log_root(self) -> Array:
        """ln L_kk (K,)."""
        return np.asarray(np.log(np.diag(self.root)))

    def decorrelated(self, rows: Array) -> Array:
        """L⁻¹ applied to rows (…, K)."""
        return np.asarray(rows @ self.whitening.T)

    def correlated(self, rows: Array) -> Array:
        """Independent numbers (…, K) made to have this correlation."""
        return np.asarray(rows @ self.root.T)

    def solved(self, rows: Array) -> Array:
        """C⁻¹ applied to rows (…, K)."""
        return np.asarray(rows @ self.precision)

    @cached_property
    def _scale_root(self) -> Array:
        return np.asarray(np.linalg.cholesky(np.eye(len(self.root)) + self.matrix * self.precision))

    def of_scale(self, score: Array, slopes: Array) -> tuple[Array, Array]:
        """B⁻¹ applied to (K,) and Bᵀ to (K, N), with B Bᵀ = I + C∘C⁻¹, the Fisher information of ln s."""
        return np.asarray(np.linalg.solve(self._scale_root, score)), self._scale_root.T @ slopes

    def record(self) -> dict[str, tuple[Array, str]]:
        """What a file holds of it: name → values and what they are."""
        return {"correlation": (self.matrix, "correlation of the observation errors")}


@dataclass(frozen=True)
class Correlation(AnyCorrelation):
    """C (K, K) as a matrix. Raises :class:`ValueError` where it is no correlation, or not positive definite."""

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


@dataclass(frozen=True)
class SharedErrors(AnyCorrelation):
    """C = Δ + WWᵀ (K, K) of errors that share k independent parts: ``columns`` W (K, k), and Δ = 1 − Σ_c W_kc² of the
    part of each reading alone, so that C has a unit diagonal. No matrix (K, K) is formed unless errors of the times
    need it: time and memory are those of K k numbers.

    With a_j = w_j/√Δ_j and z_j an error over √Δ_j, the shared parts x ~ N(0, I) are known from the errors before j as
    a Kalman filter knows them: with the covariance P_j = (I + Σ_{i<j} a_i a_iᵀ)⁻¹ and the mean P_j Σ_{i<j} a_i z_i. So
    h_j = P_j a_j and d_j² = 1 + a_jᵀh_j are all of the Cholesky factor, and P_{K+1} that of Woodbury's identity.

    Raises :class:`ValueError` for columns that are not finite, or where a reading has hardly an error of its own.
    """

    columns: Array

    def __post_init__(self) -> None:
        if self.columns.ndim != 2 or not np.all(np.isfinite(self.columns)):
            raise ValueError(f"shared errors must be finite columns (K, k), not {self.columns.shape}")
        if not np.all(self._own > 1e-8):
            raise ValueError("shared errors must be below 10⁴ times the error of each reading alone")

    @classmethod
    def beside(cls, std: Array, columns: Array) -> tuple[Array, Self]:
        """From stds (K,) of each reading alone and of what is shared (K, k): the total std (K,) and the correlation."""
        total = np.sqrt(std**2 + np.sum(columns**2, axis=1))
        return total, cls(columns / total[:, None])

    @property
    def matrix(self) -> Array:  # type: ignore[override]
        matrix = self.columns @ self.columns.T
        np.fill_diagonal(matrix, 1.0)
        return np.asarray(0.5 * (matrix + matrix.T))

    @cached_property
    def _own(self) -> Array:
        """Δ (K,)."""
        return np.asarray(1 - np.sum(self.columns**2, axis=1))

    @cached_property
    def _a(self) -> Array:
        return np.asarray(self.columns / np.sqrt(self._own)[:, None])

    @cached_property
    def _filter(self) -> tuple[Array, Array, Array]:
        """h (K, k), d (K,) and the last P (k, k)."""
        h, d, P = np.empty_like(self._a), np.empty(len(self._a)), np.eye(self._a.shape[1])
        for j, a in enumerate(self._a):
            h[j] = P @ a
            d[j] = np.sqrt(1 + a @ h[j])
            P -= np.outer(h[j] / d[j], h[j] / d[j])
        return h, d, P

    @property
    def precision_diagonal(self) -> Array:
        return np.asarray((1 - np.sum((self._a @ self._filter[2]) * self._a, axis=1)) / self._own)

    @property
    def log_root(self) -> Array:
        return np.asarray(np.log(self._filter[1]) + 0.5 * np.log(self._own))

    def decorrelated(self, rows: Array) -> Array:
        (h, d, _), z = self._filter, rows / np.sqrt(self._own)
        return np.asarray((z - _from_before(h, self._a, z)) / d)

    def correlated(self, rows: Array) -> Array:
        h, d, _ = self._filter
        return np.asarray((d * rows + _from_before(self._a, h, rows / d)) * np.sqrt(self._own))

    def solved(self, rows: Array) -> Array:
        z = rows / np.sqrt(self._own)
        return np.asarray((z - z @ self._a @ self._filter[2] @ self._a.T) / np.sqrt(self._own))

    def record(self) -> dict[str, tuple[Array, str]]:
        return {SHARED: (self.columns, "what observation errors share, each column in total standard deviations")}


@dataclass(frozen=True)
class DecayingErrors(AnyCorrelation):
    """C = exp(−|Δt|) at ``times`` (K,) in correlation times, increasing: an error, given those before it, depends on
    the last of them alone. So L⁻¹ has two diagonals, C⁻¹ three, and time and memory are those of K numbers.

    Raises :class:`ValueError` for times that do not increase, to rounding.
    """

    times: Array

    def __post_init__(self) -> None:
        if self.times.ndim != 1 or not np.all(self._kept < 1):  # also of NaN
            words = "the covariance of the observation errors is not positive definite"
            raise ValueError(f"{words}: readings are too close in time for their correlation time")

    @cached_property
    def matrix(self) -> Array:  # type: ignore[override]
        return np.asarray(np.exp(-np.abs(np.subtract.outer(self.times, self.times))))

    @cached_property
    def _kept(self) -> Array:
        """φ (K,), the correlation with the error before, 0 of the first."""
        return np.exp(-np.diff(self.times, prepend=-np.inf))

    @cached_property
    def _new(self) -> Array:
        """L_kk (K,), the std of what is new in an error."""
        return np.sqrt(-np.expm1(-2 * np.diff(self.times, prepend=-np.inf)))

    @cached_property
    def _pull(self) -> Array:
        """φ/L_kk (K,)."""
        return np.asarray(self._kept / self._new)

    @cached_property
    def precision_diagonal(self) -> Array:
        return np.asarray(self._new**-2 + np.append(self._pull[1:] ** 2, 0.0))

    @property
    def log_root(self) -> Array:
        return np.asarray(np.log(self._new))

    def decorrelated(self, rows: Array) -> Array:
        v = rows / self._new
        v[..., 1:] -= self._pull[1:] * rows[..., :-1]
        return np.asarray(v)

    def correlated(self, rows: Array) -> Array:
        diagonals = np.stack([1 / self._new, -np.append(self._pull[1:], 0.0)])
        columns = solve_banded((1, 0), diagonals, rows.reshape(-1, rows.shape[-1]).T)
        return np.asarray(columns.T.reshape(rows.shape))

    def solved(self, rows: Array) -> Array:
        v = self.decorrelated(rows)
        u = v / self._new
        u[..., :-1] -= self._pull[1:] * v[..., 1:]
        return np.asarray(u)

    @cached_property
    def _scale_root(self) -> Array:
        """The two diagonals (2, K) of B."""
        information = np.stack([1 + self.precision_diagonal, -np.append(self._pull[1:] ** 2, 0.0)])
        return np.asarray(cholesky_banded(information, lower=True))

    def of_scale(self, score: Array, slopes: Array) -> tuple[Array, Array]:
        transposed = self._scale_root[0, :, None] * slopes
        transposed[:-1] += self._scale_root[1, :-1, None] * slopes[1:]
        return np.asarray(solve_banded((1, 0), self._scale_root, score)), transposed

    def record(self) -> dict[str, tuple[Array, str]]:
        return {DECAY: (self.times, "time in correlation times: errors are correlated by exp(−|Δ|)")}


SHARED, DECAY = "shared_errors", "decay_time"  # in the record


def recorded(record: Mapping[str, Array]) -> Array | AnyCorrelation | None:
    """The inverse of ``record``: what errors share, their decay, or their matrix; None where they have none."""
    if SHARED in record:
        return SharedErrors(record[SHARED])
    return DecayingErrors(record[DECAY]) if DECAY in record else record.get("correlation")


def _from_before(to: Array, of: Array, rows: Array) -> Array:
    """Σ_{i<j} to_j·of_i rows_i for each j, of rows (…, K); ``to`` and ``of`` (K, k)."""
    total = np.zeros_like(rows)
    for outer, inner in zip(to.T, of.T, strict=True):
        part = inner * rows
        total += outer * (np.cumsum(part, axis=-1) - part)
    return total


@dataclass(frozen=True)
class CorrelatedNoise(Noise):
    """Gaussian errors R = D C D."""

    correlation: AnyCorrelation

    words = ", correlated"
    independent = False

    def check(self, weights: Array) -> None:
        super().check(weights)
        self.correlation.check_size(len(weights))
        if np.ptp(weights) > 0:
            raise ValueError("correlated observation errors need one weight for all observations")

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        s = self.error_std(at)
        return np.asarray(weights * self.correlation.solved(vectors / s) / s)

    def log_conditional(self, values: Array, predicted: Predicted) -> Array:
        """With the precision P = C⁻¹ it is N((Pz)_k/P_kk, 1/P_kk) of what is new in z_k beside all others."""
        s, precision = self.error_std(predicted), self.correlation.precision_diagonal
        scaled = self.correlation.solved((values - predicted.values) / s)
        return np.asarray(-0.5 * scaled**2 / precision + 0.5 * np.log(precision) - np.log(s) - self._log_norm())

    def matrices(self) -> dict[str, tuple[Array, str]]:
        return self.correlation.record()

    def _correlated(self, v: Array) -> Array:
        return self.correlation.correlated(v)

    def _decorrelated(self, z: Array) -> Array:
        return self.correlation.decorrelated(z)

    def _whitened_anomalies(self, row: Array, s: Array, anomalies: Array) -> Array:
        return np.asarray(row[:, None] * self.correlation.decorrelated(anomalies / s).T)

    def _scale_rows(self, root_weight: Array, z: Array, v: Array, log_s: Array) -> tuple[Array, Array]:
        if not self.timed:  # all stds grow alike: the score is vᵀv − K, the information 2K
            return super()._scale_rows(root_weight, v, v, log_s)
        of_scale, slopes = self.correlation.of_scale(z * self.correlation.solved(z) - 1, log_s.T)
        return root_weight * of_scale, root_weight[:, None] * slopes

    def _log_root(self) -> Array:
        return self.correlation.log_root
