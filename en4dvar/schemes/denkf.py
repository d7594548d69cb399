"""DEnKF: the deterministic ensemble Kalman filter.

The mean moves by the Kalman gain K, the anomalies by half of it, which is the square root to first order in KH and
otherwise keeps more spread, as some inflation would:

    w = A⁻¹ Sᵀ d,   T = I − ½ A⁻¹ SᵀS,   A = (N−1) I + SᵀS.

Source: Sakov & Oke (2008), Tellus A 60, 361.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights, gauss_newton
from en4dvar.schemes.etkf import ETKF


@dataclass(frozen=True)
class DEnKF(ETKF):
    """The filter."""

    words: ClassVar[str] = "deterministic"
    approximate: ClassVar[str] = "moves anomalies by half of the gain, which leaves them wider than the posterior"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        step = gauss_newton(weights.w, evaluation)
        # A⁻¹ SᵀS = I − (N−1) A⁻¹ = I − T²
        transform = 0.5 * (np.eye(len(weights.w)) + step.transform @ step.transform)
        return Step(Weights(step.w + step.direction, transform), step.norm)
