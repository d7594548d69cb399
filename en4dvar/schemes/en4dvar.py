"""En4D-Var: the iterative ensemble Kalman smoother on one window.

    J(w) = J_o(x̄0 + X0ᵀw) + (N−1)/2 ‖w‖²
    g = (N−1) w − Sᵀd,   A = (N−1) I + SᵀS,   δw = −A⁻¹ g,   T = √(N−1) A^{-1/2}

Sources: Sakov, Oliver & Bertino (2012), Mon. Wea. Rev. 140, 1988; Bocquet & Sakov (2013), Nonlin. Processes Geophys.
20, 803; projection on the prior anomalies: Raanes, Stordal & Evensen (2019), Nonlin. Processes Geophys. 26, 325.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from en4dvar.ensemble.linalg import min_norm_fit
from en4dvar.schemes import Evaluation, Step, Weights, gauss_newton
from en4dvar.state import Array


@dataclass(frozen=True)
class En4DVar:
    """The scheme; ``linearisation`` says where its members are run.

    ``bundle``: at w + ε e_i, finite differences about the central prediction (a tangent linearisation).
    ``transform``: at the rows of 1wᵀ + T, regression about the ensemble mean at posterior spread.
    """

    linearisation: Literal["bundle", "transform"] = "bundle"
    epsilon: float = 1e-3

    def init(self, n_members: int) -> Weights:
        """w = 0, T = I."""
        return Weights.prior(n_members)

    def member_weights(self, weights: Weights) -> Array:
        """Rows of 1wᵀ + εI (bundle) or 1wᵀ + T (transform), (N, N)."""
        return np.asarray(weights.w + self._spread(weights))

    def linearise(
        self, weights: Weights, basis: Array, predictions: Array, central: Array, active: Array
    ) -> tuple[Array, Array]:
        """Reference prediction (Ky,) and anomalies Y = T⁻¹(P − p̄) or (P − p_c)/ε, projected on the prior anomalies.

        Y = U C, returned as C (r, Ky), the minimum-norm regression of the survivors' predictions on their coordinates.
        With all members alive and r = N − 1, U C is Y itself. With r < N − 1 it keeps the weights from fitting
        nonlinearity along directions that do not move the state. With members lost, their rows follow from the
        survivors, exactly if F and H are linear and the survivors span the control space.
        """
        coordinates = (self._spread(weights) @ basis)[active]
        survivors = predictions[active]
        if self.linearisation == "bundle":
            return central, min_norm_fit(coordinates, survivors - central)
        design = np.column_stack([np.ones(len(coordinates)), coordinates])
        fit = min_norm_fit(design, survivors - central)
        return central + fit[0], fit[1:]

    def step(self, weights: Weights, evaluation: Evaluation) -> Step:
        """Gauss–Newton direction and symmetric transform."""
        return gauss_newton(weights, evaluation)

    def _spread(self, weights: Weights) -> Array:
        return weights.T if self.linearisation == "transform" else self.epsilon * np.eye(len(weights.w))
