r"""Observation errors whose variance may depend on the state, and the whitening that hides this from schemes.

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
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.observations import Observations
from en4dvar.state import Array


def error_std(observations: Observations, rates: Array | None, noise_scale: Array | None = None) -> Array:
    """Total observation-error std s (…, K) for rates (…, K) of the observable and noise scales σ (…,).

    None: no timing error, σ = 1.
    """
    s = observations.std if rates is None else np.asarray(np.hypot(observations.std, rates * observations.time_std))
    return s if noise_scale is None else np.asarray(s * np.asarray(noise_scale)[..., None])


def whitened_residual(
    observations: Observations, predictions: Array, rates: Array | None, noise_scale: Array | None = None
) -> Array:
    """v = R^{-1/2}(y − m) (…, K) of predictions (…, K); with correlated errors v_k holds what is new in y_k."""
    z = (observations.values - predictions) / error_std(observations, rates, noise_scale)
    return z if observations.correlation is None else np.asarray(z @ observations.whitening.T)


def robust_weights(observations: Observations, residual: Array) -> Array:
    """Huber's weights min(1, c/|v|) (…, K) of whitened residuals; 1 where R is Gaussian."""
    if observations.huber is None:
        return np.ones_like(residual)
    return np.asarray(observations.huber / np.maximum(np.abs(residual), observations.huber))


def observation_cost(
    observations: Observations, predictions: Array, rates: Array | None, noise_scale: Array | None = None
) -> Array:
    """J_o (…,) of predictions (…, K); +inf where a prediction is not finite."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        terms = _loss(observations, whitened_residual(observations, predictions, rates, noise_scale))
        if rates is not None or noise_scale is not None:
            terms = terms + np.log(error_std(observations, rates, noise_scale) / observations.std)
        total = np.add.reduce(observations.weights * terms, axis=-1)
    return np.where(np.isfinite(total), total, np.inf)


def log_likelihood(
    observations: Observations, predictions: Array, rates: Array | None, noise_scale: Array | None = None
) -> Array:
    """Normalised log density of each observation (…, K) in its own unit, unweighted (β = 1).

    With correlated errors it is that of an observation given those before it, so that the sum is the joint density.
    """
    s = error_std(observations, rates, noise_scale)
    v = whitened_residual(observations, predictions, rates, noise_scale)
    density = -_loss(observations, v) - np.log(s) - _log_norm(observations)
    return np.asarray(
        density if observations.correlation is None else density + np.log(np.diag(observations.whitening))
    )


def log_normalisation(observations: Observations) -> float:
    """What −Σ β_k ln p(y_k) exceeds J_o by: Σ β_k ln(std_k √2π), with correlated errors + ½ β ln det C."""
    terms = np.log(observations.std) + _log_norm(observations)
    if observations.correlation is not None:
        terms = terms - np.log(np.diag(observations.whitening))
    return float(np.sum(observations.weights * terms))


def fixed_precision(observations: Observations) -> Array | None:
    """(K,) β/std² where the errors are independent, Gaussian and of a std that no control vector changes; else None.

    An estimated noise scale is not known here (see :func:`~en4dvar.ensemble.forecast.has_noise_scale`).
    """
    if observations.timed or observations.huber is not None or observations.correlation is not None:
        return None
    return np.asarray(observations.weights / observations.std**2)


@dataclass(frozen=True)
class Linearisation:
    """Predictions about one point: ``prediction`` m (K,), ``anomalies`` ∂m (N, K), and the same of the rates or None.

    ``log_noise_scale`` is ln σ with anomalies (N,), or None. Anomalies are per unit of some N coordinates: of weights,
    row i is the change of the prediction when the control vector moves by the prior anomaly of member i.
    """

    prediction: Array
    anomalies: Array
    rate: Array | None = None
    rate_anomalies: Array | None = None
    log_noise_scale: float | None = None
    log_noise_scale_anomalies: Array | None = None

    @property
    def noise_scale(self) -> Array | None:
        return None if self.log_noise_scale is None else np.exp(np.asarray(self.log_noise_scale))


def whiten(observations: Observations, at: Linearisation) -> tuple[Array, Array]:
    """Whitened innovation d (K',) and whitened anomalies S (K', N); K' = K, or 2K where s depends on the state.

    This is the one place that knows the structure of R: anything with R^{-1/2} fits here.
    """
    root_weight = observations.root_weights
    s = error_std(observations, at.rate, at.noise_scale)
    z = (observations.values - at.prediction) / s
    whitening = None if observations.correlation is None else observations.whitening
    v = z if whitening is None else whitening @ z
    row = root_weight if observations.huber is None else root_weight * np.sqrt(robust_weights(observations, v))
    if whitening is None:
        d, sensitivity = row * v, (row / s)[:, None] * at.anomalies.T
    else:
        d, sensitivity = row * v, row[:, None] * (whitening @ (at.anomalies / s).T)
    log_s = _log_std_anomalies(observations, at)
    if log_s is None:
        return d, sensitivity
    if whitening is None:
        # score of ln s: 1 − z ρ'(z); its information is 2, less with Huber's lighter outliers
        scalar = math.sqrt(_scale_information(observations.huber))
        of_scale = root_weight * (robust_weights(observations, z) * z * z - 1) / scalar
        scale_sensitivity = scalar * root_weight[:, None] * log_s.T
    else:
        root = observations.scale_root
        of_scale = root_weight * np.linalg.solve(root, z * (whitening.T @ v) - 1)
        scale_sensitivity = root_weight[:, None] * (root.T @ log_s.T)
    return np.concatenate([d, of_scale]), np.concatenate([sensitivity, scale_sensitivity])


def precision_times(observations: Observations, at: Linearisation, vectors: Array) -> Array:
    """β R⁻¹ applied to vectors (…, K), R at the linearisation, Huber's weights included."""
    s = error_std(observations, at.rate, at.noise_scale)
    if observations.correlation is not None:
        whitening = observations.whitening
        return np.asarray(observations.weights * ((vectors / s) @ whitening.T @ whitening) / s)
    weights = observations.weights
    if observations.huber is not None:
        weights = weights * robust_weights(observations, (observations.values - at.prediction) / s)
    return np.asarray(vectors * (weights / s**2))


def _log_std_anomalies(observations: Observations, at: Linearisation) -> Array | None:
    """∂ln s (N, K), or None where s is constant."""
    total = None
    if at.rate is not None and at.rate_anomalies is not None:
        variance = error_std(observations, at.rate) ** 2
        total = (at.rate * observations.time_std**2 / variance) * at.rate_anomalies
    if at.log_noise_scale_anomalies is not None:
        scale = np.broadcast_to(at.log_noise_scale_anomalies[:, None], at.anomalies.shape)
        total = scale if total is None else total + scale
    return None if total is None else np.asarray(total)


def _loss(observations: Observations, v: Array) -> Array:
    """ρ (…, K) of whitened residuals."""
    c = observations.huber
    if c is None:
        return 0.5 * v * v
    inner = np.minimum(np.abs(v), c)
    return np.asarray(inner * (np.abs(v) - 0.5 * inner))


def _log_norm(observations: Observations) -> float:
    """ln ∫ exp(−ρ(v)) dv."""
    c = observations.huber
    return 0.5 * math.log(2 * math.pi) if c is None else math.log(_inside(c) + 2 / c * math.exp(-0.5 * c * c))


def _inside(c: float) -> float:
    """∫ exp(−½v²) dv over |v| < c."""
    return math.sqrt(2 * math.pi) * math.erf(c / math.sqrt(2))


def _scale_information(c: float | None) -> float:
    """E[(v ρ'(v) − 1)²] = E[v² ρ'²] − 1 under exp(−ρ): the Fisher information of ln s in one observation."""
    if c is None:
        return 2.0
    edge = math.exp(-0.5 * c * c)
    fourth = 3 * _inside(c) - 2 * (c**3 + 3 * c) * edge + 2 * c * c * edge * (c + 2 / c + 2 / c**3)
    return fourth / (_inside(c) + 2 / c * edge) - 1
