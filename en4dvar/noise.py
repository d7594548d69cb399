r"""Observation errors: kinds of R, which may depend on the state, and the whitening that hides this from schemes.

With prediction m, its rate ṁ, value error std, timing error τ and noise scale σ the errors are R = D C D with

    D = diag(s),   s = σ √(std² + (ṁ τ)²),   z = (y−m)/s,   v = L⁻¹z,   C = L Lᵀ,
    J_o = Σ_k β_k [ ρ(v_k) + ln(s_k/std_k) ],   ρ(v) = ½ v², or Huber's function.

Where τ ≠ 0 or σ is estimated the variance depends on the control vector. The score and the Fisher information of the
errors are those of linear least squares in the augmented whitened arrays

    d = √β [ L⁻¹z ;  B⁻¹(z∘C⁻¹z − 1) ],      S = √β [ L⁻¹ ∂m/s ;  Bᵀ ∂ln s ],      B Bᵀ = I + C∘C⁻¹,

that is ∇J_o = −Sᵀd exactly and E[∇²J_o] = SᵀS, so a scheme written for constant R performs Fisher scoring unchanged:
½ tr(R⁻¹∂R R⁻¹∂R) with ∂R = UR + RU, U = diag(∂ln s), is ∂ln sᵀ (I + C∘C⁻¹) ∂ln s. For C = 1 it is B = √2.

Huber (1981), Robust Statistics, § 4.5: ρ(v) = ½ v² for |v| ≤ c, c|v| − ½c² beyond, the negative logarithm of a density
whose tails are exponential. Its rows of d and S take the weights min(1, c/|v|) (iteratively reweighted least squares):
the gradient is exact, SᵀS bounds the Hessian of the part of m from above.

A kind of errors is one class of this file: :class:`Noise` is Gaussian and independent, the others say what differs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self, cast

import numpy as np

from en4dvar.state import Array


@dataclass(frozen=True)
class Predicted:
    """Predictions with all that R takes from the state, of one run or of many (leading dimensions …).

    ``values`` m (…, K), ``rates`` ṁ (…, K) of the observable or None without timing errors, ``noise_scale`` σ (…,) or
    None where it is neither estimated nor fixed.
    """

    values: Array
    rates: Array | None = None
    noise_scale: Array | None = None

    def __getitem__(self, runs: int | slice) -> Predicted:
        """Of some of the runs."""
        return Predicted(
            self.values[runs],
            None if self.rates is None else self.rates[runs],
            None if self.noise_scale is None else self.noise_scale[runs],
        )

    @property
    def stacked(self) -> Array:
        """(B, Ky): m, where there are rates ṁ, and where there is a noise scale ln σ, of B runs, side by side."""
        parts = [self.values]
        if self.rates is not None:
            parts.append(self.rates)
        if self.noise_scale is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                parts.append(np.log(self.noise_scale)[:, None])
        return np.hstack(parts) if len(parts) > 1 else parts[0]

    def unstacked(self, columns: Array) -> Predicted:
        """The inverse of :attr:`stacked` for columns (…, Ky) of the same make, such as those of an emulator."""
        k = self.values.shape[-1]
        return Predicted(
            columns[..., :k],
            None if self.rates is None else columns[..., k : 2 * k],
            None if self.noise_scale is None else np.exp(columns[..., -1]),
        )


@dataclass(frozen=True)
class Linearisation:
    """Predictions about one point, ``prediction``, and their anomalies per unit of some N coordinates.

    ``anomalies`` ∂m (N, K), ``rate_anomalies`` ∂ṁ (N, K) and ``log_scale_anomalies`` ∂ln σ (N,), the latter two None
    where the prediction has none. Of weights, row i is the change of the prediction when the control vector moves by
    the prior anomaly of member i.
    """

    prediction: Predicted
    anomalies: Array
    rate_anomalies: Array | None = None
    log_scale_anomalies: Array | None = None

    @classmethod
    def of_stacked(cls, like: Predicted, reference: Array, anomalies: Array) -> Linearisation:
        """From reference (Ky,) and anomalies (N, Ky) of what :attr:`Predicted.stacked` of ``like`` holds."""
        k = like.values.shape[-1]
        return cls(
            like.unstacked(reference),
            anomalies[:, :k],
            None if like.rates is None else anomalies[:, k : 2 * k],
            None if like.noise_scale is None else anomalies[:, -1],
        )


@dataclass(frozen=True)
class ScaleSkewness:
    """Expected third derivatives of J_o along ln σ relative to informations (:mod:`en4dvar.descent.noise_scale`).

    ``of_predictions`` r_m and ``of_scale`` r_u; ``information`` of ln σ in one observation.
    """

    of_predictions: float = 2.0
    of_scale: float = 2.0
    information: float = 2.0


@dataclass(frozen=True)
class Noise:
    """Gaussian errors, independent of each other: C = 1, ρ(v) = ½ v².

    ``std`` (K,) > 0 in the observable's unit, ``time_std`` (K,) ≥ 0 of the observation times. Arguments of the methods:
    observed values y (K,), weights β (K,), and predictions (…, K).
    """

    std: Array
    time_std: Array

    words: ClassVar[str] = ""  # what a summary says of these errors, after their std

    def check(self, weights: Array) -> None:
        """Raise :class:`ValueError` where the errors of K observations with these weights (K,) are not well defined."""
        for key in ("std", "time_std"):
            if np.shape(getattr(self, key)) != weights.shape:
                raise ValueError(f"{key} has shape {np.shape(getattr(self, key))}, not {weights.shape}")
        if not (np.all(self.std > 0) and np.all(self.time_std >= 0)):
            raise ValueError("std must be positive, time_std not negative")

    @cached_property
    def timed(self) -> bool:
        """Whether any observation carries a timing error."""
        return bool(np.any(self.time_std > 0))

    @cached_property
    def plain(self) -> bool:
        """Whether J_o is ½ Σ β (y − m)²/std² as long as no noise scale is given."""
        return type(self) is Noise and not self.timed

    def error_std(self, predicted: Predicted) -> Array:
        """Total observation-error std s (…, K)."""
        rates, scale = predicted.rates, predicted.noise_scale
        s = self.std if rates is None else np.asarray(np.hypot(self.std, rates * self.time_std))
        return s if scale is None else np.asarray(s * np.asarray(scale)[..., None])

    def frozen(self, predicted: Predicted) -> Self:
        """Errors whose std is that at a prediction and depends on no state any more."""
        return replace(self, std=self.error_std(predicted), time_std=np.zeros_like(self.std))

    def whitened_residual(self, values: Array, predicted: Predicted) -> Array:
        """v = R^{-1/2}(y − m) (…, K); with correlated errors v_k holds what is new in y_k."""
        return self._decorrelated((values - predicted.values) / self.error_std(predicted))

    def influence(self, residual: Array) -> Array:
        """ρ'(v)/v (…, K) of whitened residuals, at most 1: how much of a Gaussian observation one counts."""
        return np.ones_like(residual)

    @property
    def counts_within(self) -> float:
        """Standard deviations within which an observation counts in full."""
        return math.inf

    def down_weights(self, values: Array, predicted: Predicted) -> Array | None:
        """:meth:`influence` (K,) at a prediction; None where every observation counts in full in any case."""
        return None

    def squares(self, values: Array, predicted: Predicted) -> Array:
        """v ρ'(v) (…, K): squared residuals, whose expectation is 1 under the density of ρ."""
        v = self.whitened_residual(values, predicted)
        return np.asarray(v * v * self.influence(v))

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        """J_o (…,) of predictions; +inf where one is not finite."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            terms = self._loss(self.whitened_residual(values, predicted))
            if predicted.rates is not None or predicted.noise_scale is not None:
                terms = terms + np.log(self.error_std(predicted) / self.std)
            total = np.add.reduce(weights * terms, axis=-1)
        return np.where(np.isfinite(total), total, np.inf)

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        """Normalised log density of each observation (…, K) in its own unit, unweighted (β = 1).

        With correlated errors it is that of an observation given those before it, so that the sum is the joint density.
        """
        v = self.whitened_residual(values, predicted)
        density = -self._loss(v) - np.log(self.error_std(predicted)) - self._log_norm()
        return np.asarray(density - self._log_root())

    def log_normalisation(self, weights: Array) -> float:
        """What −Σ β_k ln p(y_k) exceeds J_o by: Σ β_k ln(std_k √2π), with correlated errors + ½ β ln det C."""
        return float(np.sum(weights * (np.log(self.std) + self._log_norm() + self._log_root())))

    def whiten(self, values: Array, weights: Array, at: Linearisation) -> tuple[Array, Array]:
        """Whitened innovation d (K',) and whitened anomalies S (K', N); K' = K, or 2K where s depends on the state."""
        root_weight = np.sqrt(weights)
        s = self.error_std(at.prediction)
        z = (values - at.prediction.values) / s
        v = self._decorrelated(z)
        row = root_weight * np.sqrt(self.influence(v))
        d, sensitivity = row * v, self._whitened_anomalies(row, s, at.anomalies)
        log_s = self._log_std_anomalies(at)
        if log_s is None:
            return d, sensitivity
        of_scale, scale_sensitivity = self._scale_rows(root_weight, z, v, log_s)
        return np.concatenate([d, of_scale]), np.concatenate([sensitivity, scale_sensitivity])

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        """β R⁻¹ applied to vectors (…, K), R at the prediction, the influence of each observation included."""
        s = self.error_std(at)
        return np.asarray(vectors * (weights * self.influence((values - at.values) / s) / s**2))

    def scale_skewness(self) -> ScaleSkewness:
        """What the mean of ln σ has to know of the density."""
        return ScaleSkewness()

    def attributes(self) -> dict[str, float]:
        """Numbers that say of which kind the errors are, for the record."""
        return {}

    def matrices(self) -> dict[str, tuple[Array, str]]:
        """Matrices (K, K) that belong to the kind, for the record: name → values and what they are."""
        return {}

    def _decorrelated(self, z: Array) -> Array:
        """L⁻¹z (…, K)."""
        return np.asarray(z)

    def _whitened_anomalies(self, row: Array, s: Array, anomalies: Array) -> Array:
        """diag(row) L⁻¹ ∂m/s (K, N)."""
        return np.asarray((row / s)[:, None] * anomalies.T)

    def _scale_rows(self, root_weight: Array, z: Array, v: Array, log_s: Array) -> tuple[Array, Array]:
        """The rows of d and S that belong to ln s, from anomalies ∂ln s (N, K): its score is v ρ'(v) − 1."""
        root = math.sqrt(self.scale_skewness().information)
        of_scale = root_weight * (self.influence(z) * z * z - 1) / root
        return of_scale, root * root_weight[:, None] * log_s.T

    def _log_std_anomalies(self, at: Linearisation) -> Array | None:
        """∂ln s (N, K), or None where s is constant."""
        total, rate = None, at.prediction.rates
        if rate is not None and at.rate_anomalies is not None:
            variance = self.error_std(Predicted(at.prediction.values, rate)) ** 2
            total = (rate * self.time_std**2 / variance) * at.rate_anomalies
        if at.log_scale_anomalies is not None:
            scale = np.broadcast_to(at.log_scale_anomalies[:, None], at.anomalies.shape)
            total = scale if total is None else total + scale
        return None if total is None else np.asarray(total)

    def _loss(self, v: Array) -> Array:
        """ρ (…, K)."""
        return 0.5 * v * v

    def _log_norm(self) -> float:
        """ln ∫ exp(−ρ(v)) dv."""
        return 0.5 * math.log(2 * math.pi)

    def _log_root(self) -> Array | float:
        """ln L_kk (K,)."""
        return 0.0


@dataclass(frozen=True)
class HuberNoise(Noise):
    """Independent errors with exponential tails beyond ``threshold`` c > 0 standard deviations."""

    threshold: float

    def check(self, weights: Array) -> None:
        super().check(weights)
        if not self.threshold > 0:
            raise ValueError("the threshold of the robust cost must be positive")

    @property
    def words(self) -> str:  # type: ignore[override]
        return f", robust beyond {self.threshold:g} std"

    @property
    def counts_within(self) -> float:
        return self.threshold

    def influence(self, residual: Array) -> Array:
        return np.asarray(self.threshold / np.maximum(np.abs(residual), self.threshold))

    def down_weights(self, values: Array, predicted: Predicted) -> Array:
        return self.influence(self.whitened_residual(values, predicted))

    def attributes(self) -> dict[str, float]:
        return {"huber_threshold": self.threshold}

    def scale_skewness(self) -> ScaleSkewness:
        """As for Gaussian errors for large thresholds.

        >>> round(HuberNoise(np.ones(1), np.zeros(1), 6.0).scale_skewness().of_scale, 4)
        2.0
        """
        c, edge = self.threshold, self._edge
        if c > 8:  # e^{−c²/2} is rounding there
            return ScaleSkewness()
        from scipy.special import exp1

        norm = self._inside + 2 / c * edge
        slope = self._inside / norm  # E[ψ']
        square = (self._inside - 2 * c * edge) / norm  # E[v²ψ']
        at_edge = 2 * edge / norm  # E[vψ''] = −c · at_edge, E[v³ψ''] = −c³ · at_edge: ψ' drops to 0 at ±c
        weight = slope + 2 * c * edge * float(exp1(c * c)) * math.exp(c * c) / norm  # E[ψ/v]
        information = 1 + square  # E[v²ψ²] − 1 = E[vψ + v²ψ'], for E[vψ] = 1
        return ScaleSkewness(
            (2 * slope - c * at_edge) / weight, (1 + 3 * square - c**3 * at_edge) / information, information
        )

    def _loss(self, v: Array) -> Array:
        inner = np.minimum(np.abs(v), self.threshold)
        return np.asarray(inner * (np.abs(v) - 0.5 * inner))

    def _log_norm(self) -> float:
        return math.log(self._inside + 2 / self.threshold * self._edge)

    @property
    def _edge(self) -> float:
        """exp(−½c²)."""
        return math.exp(-0.5 * self.threshold**2)

    @property
    def _inside(self) -> float:
        """∫ exp(−½v²) dv over |v| < c."""
        return math.sqrt(2 * math.pi) * math.erf(self.threshold / math.sqrt(2))


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

    words: ClassVar[str] = ", correlated"

    def check(self, weights: Array) -> None:
        super().check(weights)
        self.correlation.check_size(len(weights))
        if np.ptp(weights) > 0:
            raise ValueError("correlated observation errors need one weight for all observations")

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        s, whitening = self.error_std(at), self.correlation.whitening
        return np.asarray(weights * ((vectors / s) @ whitening.T @ whitening) / s)

    def matrices(self) -> dict[str, tuple[Array, str]]:
        return {"correlation": (self.correlation.matrix, "correlation of the observation errors")}

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


def noise_of_record(
    std: Array, time_std: Array, matrices: Mapping[str, Array], attributes: Mapping[str, object]
) -> Noise:
    """The errors whose :meth:`Noise.matrices` and :meth:`Noise.attributes` are among what a file holds."""
    threshold = attributes.get("huber_threshold")
    return noise_of(
        std, time_std, matrices.get("correlation"), None if threshold is None else float(cast(float, threshold))
    )


def noise_of(
    std: Array, time_std: Array | None = None, correlation: Array | None = None, huber: float | None = None
) -> Noise:
    """Errors of the kind that is given: independent, correlated by a matrix (K, K), or robust beyond ``huber`` std.

    Raises
    ------
    ValueError: both, or a matrix that is no correlation.
    """
    time_std = np.zeros_like(std) if time_std is None else time_std
    if correlation is not None and huber is not None:
        raise ValueError("a robust cost needs independent observation errors")
    if correlation is not None:
        return CorrelatedNoise(std, time_std, Correlation(correlation))
    return Noise(std, time_std) if huber is None else HuberNoise(std, time_std, huber)
