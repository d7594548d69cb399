"""EnKF: the stochastic ensemble Kalman filter, every member analysed with its own perturbed observations.

    δ_i = A⁻¹ Sᵀ (d_i + z_i),   A = (N−1) I + SᵀS,   z_i ~ N(0, I)

along the anomalies, d_i the whitened innovation of member i. The z_i are centred, so that the mean moves by the Kalman
gain without sampling noise. Divided by N−1 their sample covariance then has the mean I, and that of the members after
the analysis the mean (N−1) A⁻¹ along the anomalies, as it is of the ETKF: no scale is needed.

Sources: Burgers, van Leeuwen & Evensen (1998), Mon. Wea. Rev. 126, 1719; Evensen (2003), Ocean Dynamics 53, 343.
"""

from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np

from en4dvar.ensemble.linalg import Hessian, LowRank
from en4dvar.model.state import Array
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights
from en4dvar.schemes.etkf import ETKF


def perturbed_transform(hessian: Hessian, S: Array, noise: Array, T: Array) -> Array:
    """T (N, N) after an update with whitened anomalies S (K', N) per row of T and perturbations ``noise`` (N, K')."""
    # anomalies of the members' innovations: −S_i of the predictions and the perturbations
    innovations = noise - noise.mean(axis=0) - S.T
    if len(S) < S.shape[1]:  # the cheaper order of the same product
        return np.asarray(T + innovations @ (hessian.solve(S) @ T))
    return np.asarray(T + hessian.solve(innovations @ S) @ T)


@dataclass(frozen=True)
class EnKF(ETKF):
    """The filter."""

    words: ClassVar[str] = "perturbed observations"
    perturbs: ClassVar[bool] = True

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        hessian, n = Hessian.of(evaluation.S), len(weights.w)
        shift = hessian.solve(evaluation.d @ evaluation.S)
        noise = draw("perturbed observations")
        if len(evaluation.S) < n:
            innovations = noise - noise.mean(axis=0) - evaluation.S.T
            transform = cast(Array, LowRank(innovations, hessian.solve(evaluation.S)))  # T = I before
        else:
            transform = perturbed_transform(hessian, evaluation.S, noise, weights.T)
        return Step(Weights(weights.w + shift, transform), hessian.norm(shift))
