r"""Gaussian observation errors whose variance may depend on the state, and the whitening that hides this from schemes.

With prediction m, its rate ṁ, value error std and timing error τ the error of an observation is

    s² = std² + (ṁ τ)²,      J_o = Σ_k β_k [ ½ (y−m)²/s² + ln(s/std) ].

Where τ ≠ 0 the variance depends on the control vector. The score and the Fisher information of N(m, s²) are those of
linear least squares in the augmented whitened arrays

    d = √β [ (y−m)/s ;  ((y−m)²/s² − 1)/√2 ],      S = √β [ ∂m/s ;  √2 ∂ln s ],

that is ∇J_o = −Sᵀd exactly and E[∇²J_o] = SᵀS, so a scheme written for constant R performs Fisher scoring unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.observations import Observations
from en4dvar.state import Array


def needs_rate(observations: Observations) -> bool:
    """Whether any observation carries a timing error."""
    return bool(np.any(observations.time_std > 0))


def error_std(observations: Observations, rates: Array | None) -> Array:
    """Total observation-error std s (…, K) for rates (…, K) of the observable; None: no timing error."""
    if rates is None:
        return observations.std
    return np.asarray(np.hypot(observations.std, rates * observations.time_std))


def observation_cost(observations: Observations, predictions: Array, rates: Array | None) -> Array:
    """J_o (…,) of predictions (…, K); +inf where a prediction is not finite."""
    s = error_std(observations, rates)
    with np.errstate(over="ignore", invalid="ignore"):
        z = (observations.values - predictions) / s
        terms = 0.5 * z * z + np.log(s / observations.std)
        total = np.sum(observations.weights * terms, axis=-1)
    return np.where(np.isfinite(total), total, np.inf)


def log_likelihood(observations: Observations, predictions: Array, rates: Array | None) -> Array:
    """Normalised log density of each observation (…, K) in its own unit, unweighted (β = 1)."""
    s = error_std(observations, rates)
    z = (observations.values - predictions) / s
    return np.asarray(-0.5 * z * z - np.log(s) - 0.5 * math.log(2 * math.pi))


@dataclass(frozen=True)
class Linearisation:
    """Predictions about one point: ``prediction`` m (K,), ``anomalies`` ∂m (N, K), and the same of the rates or None.

    Anomalies are per unit weight: row i is the change of the prediction when the control vector moves by the prior
    anomaly of member i.
    """

    prediction: Array
    anomalies: Array
    rate: Array | None = None
    rate_anomalies: Array | None = None


def whiten(observations: Observations, at: Linearisation) -> tuple[Array, Array]:
    """Whitened innovation d (K',) and whitened anomalies S (K', N); K' = K, or 2K with timing errors.

    This is the one place that knows the structure of R: anything with R^{-1/2} fits here.
    """
    root_weight = np.sqrt(observations.weights)
    s = error_std(observations, at.rate)
    z = (observations.values - at.prediction) / s
    d = root_weight * z
    sensitivity = (root_weight / s)[:, None] * at.anomalies.T
    if at.rate is None or at.rate_anomalies is None:
        return d, sensitivity
    log_s_anomalies = (at.rate * observations.time_std**2 / s**2)[:, None] * at.rate_anomalies.T
    return (
        np.concatenate([d, root_weight * (z * z - 1) / math.sqrt(2)]),
        np.concatenate([sensitivity, math.sqrt(2) * root_weight[:, None] * log_s_anomalies]),
    )
