r"""Model error of a series: the state changes by N(0, Q Δt) from one observation time to the next, Q diagonal.

In a window the changes are quantities to estimate like the state at its start: a member is a state and its own changes
at the times in the window, and the weights of the ensemble act on all of them. That is the weak constraint of the
IEnKF-Q and IEnKS-Q; in the linear Gaussian case it is exact where the ensemble has more members than there are such
quantities. In a filter the change joins the state at once, drawn, or by the square root of P + Q in the space that the
ensemble spans.

Sources: Sakov, Haussaire & Bocquet (2018), Q. J. R. Meteorol. Soc. 144, 1297 (IEnKF-Q); Fillion, Bocquet, Gratton,
Gürol & Sakov (2020), SIAM/ASA J. Uncertain. Quantif. 8, 1028 (IEnKS-Q); Raanes, Carrassi & Bertino (2015), Mon. Wea.
Rev. 143, 3857 (square root, "Sqrt-Core").
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from en4dvar.ensemble.linalg import centre, sizes
from en4dvar.model.state import Array, Indices
from en4dvar.priors.prior import whiten_sample

SPANNED = 1e-10  # of the largest singular value: a direction that the ensemble spans


@dataclass(frozen=True)
class ModelError:
    """``rate`` (n,): variance of each variable per unit of time. ``form``: how it enters the ensemble of a filter.

    Raises ValueError: a rate that is negative or not finite, or none that is positive.
    """

    rate: Array
    form: Literal["drawn", "square-root"] = "drawn"

    def __post_init__(self) -> None:
        if not (np.all(np.isfinite(self.rate)) and np.all(self.rate >= 0) and np.any(self.rate > 0)):
            raise ValueError("a model error needs variances that are not negative, one of them positive")

    @cached_property
    def where(self) -> Indices:
        """(q,) the variables that have one."""
        return np.flatnonzero(self.rate > 0)

    def added(self, states: Array, noise: Array, duration: float) -> Array:
        """States (N, n) with standard normal ``noise`` (N, q) that has grown over a ``duration``."""
        changed = states.copy()
        changed[:, self.where] += noise * np.sqrt(self.rate[self.where] * duration)
        return changed

    def widened(self, states: Array, duration: float) -> Array:
        """States (N, n) whose covariance is P + Q in the space that their anomalies span, and whose mean stays.

        With P = V S² Vᵀ of the anomalies U S Vᵀ √(N−1), the anomalies become U (I + S⁻¹VᵀQV S⁻¹)^{1/2} S Vᵀ √(N−1).
        """
        anomalies = states - states.mean(axis=0)
        scale = sizes(anomalies)
        u, s, vt = np.linalg.svd(anomalies / scale, full_matrices=False)
        spanned = s > SPANNED * s.max(initial=0.0)
        u, s, vt = u[:, spanned], s[spanned] / np.sqrt(len(states) - 1), vt[spanned]
        core = (vt * (self.rate * duration / scale**2)) @ vt.T / np.outer(s, s)
        return states + _growth(u, core, anomalies)


def narrowed(states: Array, widened: Array, smoothed: Array) -> Array:
    """``states`` (N, n) by what later observations say of them ``widened``, which then are ``smoothed``.

    The covariance of states with and without a model error is P, not that of the members, which the square root has
    moved. In moments m ← m + Gᵀ (m_s − m), P ← P + Gᵀ (P_s − P_w) G, G = P_w⁺ P; anomalies change by a symmetric root.
    """
    (_, anomalies), (mean, wide) = centre(states), centre(widened)
    scale = sizes(wide)
    _, s, vt = np.linalg.svd(wide / scale, full_matrices=False)
    spanned = s > s.max() * max(wide.shape) * np.finfo(float).eps
    inverse = vt[spanned].T / s[spanned] / scale[:, None]
    u, shared = np.linalg.qr(anomalies @ inverse)  # G = inverse @ shared.T @ u.T @ anomalies
    shift, later = centre((smoothed - mean) @ inverse @ shared.T)
    return states + shift @ (u.T @ anomalies) + _growth(u, later.T @ later - shared @ shared.T, anomalies)


def _growth(u: Array, core: Array, anomalies: Array) -> Array:
    """What (I + U C Uᵀ)^{1/2} adds to anomalies (N, n), with orthonormal columns U (N, r) and C (r, r)."""
    values, vectors = np.linalg.eigh(np.eye(len(core)) + core)
    grown = (vectors * (np.sqrt(np.maximum(values, 0)) - 1)) @ vectors.T
    return np.asarray(u @ (grown @ (u.T @ anomalies)))


def fresh_noise(anomalies: Array, draws: Array) -> Array:
    """Noise (N, q) from standard normal ``draws`` (N, q), its mean zero.

    Where N > rank + q it is second-order exact: of unit sample covariance, uncorrelated with the ``anomalies`` (N, m).
    """
    centred = draws - draws.mean(axis=0)
    if len(draws) - 1 < draws.shape[1]:
        return np.asarray(centred)
    u, s, _ = np.linalg.svd(anomalies / sizes(anomalies), full_matrices=False)
    basis = u[:, s > SPANNED * s.max(initial=0.0)]
    if len(draws) - 1 < basis.shape[1] + draws.shape[1]:
        return np.asarray(centred)
    for _ in range(2):  # twice is enough (Kahan, Parlett)
        centred = centred - basis @ (basis.T @ centred)
    return whiten_sample(centred)
