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

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Gt, MinLen

from en4dvar.ensemble.linalg import Hessian
from en4dvar.model.state import Array
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights, mda_inflations
from en4dvar.schemes.filters import ETKF, perturbed_transform


@dataclass(frozen=True)
class ESMDA(ETKF):
    """``mda_coefficients``: α_a relative to each other; :attr:`inflations` are scaled so that Σ 1/α_a = 1.

    >>> ESMDA((9.333, 7.0, 4.0, 2.0)).inflations.round(2).tolist()
    [9.33, 7.0, 4.0, 2.0]
    """

    words = "multiple data assimilation"

    mda_coefficients: Annotated[
        tuple[Annotated[float, Gt(0)], ...],
        MinLen(1),
        "Inflation of R in each assimilation, scaled so that the inverses sum to one.",
    ] = (4.0, 4.0, 4.0, 4.0)
    mda_form: Annotated[Literal["perturbed", "square-root"], "Analysis: perturbed observations, or a square root."] = (
        "perturbed"
    )

    on = ("window",)
    localised_keys = frozenset(("mda_coefficients",))

    def __post_init__(self) -> None:
        if not self.mda_coefficients or not all(alpha > 0 for alpha in self.mda_coefficients):
            raise ValueError(f"MDA coefficients must be positive, not {self.mda_coefficients}")

    @property
    def passes(self) -> int:
        return len(self.mda_coefficients)

    @property
    def inflations(self) -> Array:
        return mda_inflations(self.mda_coefficients)

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Assimilation number ``iteration``; d is that of the mean prediction, S per unit of the current anomalies."""
        root = np.sqrt(float(self.inflations[iteration]))
        d, S = evaluation.d / root, evaluation.S / root
        hessian = Hessian.of(S)
        shift = hessian.solve(d @ S)
        w, norm = weights.w + shift @ weights.T, hessian.norm(shift)
        if self.mda_form == "square-root":
            return Step(Weights(w, hessian.transform @ weights.T), norm)
        noise = draw(f"ES-MDA {iteration}")
        return Step(Weights(w, perturbed_transform(hessian, S, noise) @ weights.T), norm)
