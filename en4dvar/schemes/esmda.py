"""ES-MDA: the ensemble smoother with multiple data assimilation, for parameters.

The same observations are assimilated several times, each time with their error covariance inflated by α_a, where
Σ 1/α_a = 1: in the linear Gaussian case the sequence is one plain update, in a nonlinear one it is gentler. With the
whitened anomalies S and innovations d_i = R^{-1/2}(y − p_i) of the current ensemble, member i moves by

    δ_i = A⁻¹ Sᵀ (d_i + √α z_i) / α,   A = (N−1) I + SᵀS/α,   z_i ~ N(0, I)        (perturbed)

along the current anomalies. Perturbations are centred, so that the mean of the ensemble moves by the Kalman gain of its
moments without sampling noise. ``square-root`` needs none: it moves the mean in the same way and the anomalies by the
symmetric transform, and is exactly one update for a linear model.

Sources: Emerick & Reynolds (2013), Computers & Geosciences 55, 3; square root: as the ETKF, applied to αR.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from en4dvar.ensemble.linalg import Hessian
from en4dvar.schemes import Evaluation, Weights
from en4dvar.state import Array

Form = Literal["perturbed", "square-root"]


@dataclass(frozen=True)
class ESMDA:
    """``coefficients``: α_a relative to each other; :attr:`inflations` are scaled so that Σ 1/α_a = 1.

    >>> ESMDA((9.333, 7.0, 4.0, 2.0)).inflations.round(2).tolist()
    [9.33, 7.0, 4.0, 2.0]
    """

    coefficients: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    form: Form = "perturbed"

    def __post_init__(self) -> None:
        if not self.coefficients or not all(alpha > 0 for alpha in self.coefficients):
            raise ValueError(f"MDA coefficients must be positive, not {self.coefficients}")

    @property
    def inflations(self) -> Array:
        """α_a, one an assimilation."""
        alpha = np.array(self.coefficients)
        return np.asarray(alpha * np.sum(1 / alpha))

    def update(self, weights: Weights, evaluation: Evaluation, alpha: float, perturbations: Array) -> Weights:
        """One assimilation.

        Parameters
        ----------
        weights: of the current ensemble. evaluation: d (K',) of its mean prediction and S (K', N) of its predictions,
            members as they are: per unit of the *current* anomalies.
        alpha: of this assimilation. perturbations: z (N, K'), standard normal; not read by ``square-root``.
        """
        root = np.sqrt(alpha)
        d, S = evaluation.d / root, evaluation.S / root
        hessian = Hessian.of(S)
        centre = weights.w + hessian.solve(d @ S) @ weights.T
        if self.form == "square-root":
            return Weights(centre, hessian.transform @ weights.T)
        # anomalies of the members' innovations: −S_i of the predictions and the perturbations
        innovations = perturbations - perturbations.mean(axis=0) - S.T
        if len(S) < S.shape[1]:  # the cheaper order of the same product
            return Weights(centre, weights.T + innovations @ (hessian.solve(S) @ weights.T))
        return Weights(centre, weights.T + hessian.solve(innovations @ S) @ weights.T)
