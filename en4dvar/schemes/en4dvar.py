"""En4D-Var: the iterative ensemble Kalman smoother on one window.

    J(w) = J_o(x̄0 + X0ᵀw) + (N−1)/2 ‖w‖²
    g = (N−1) w − Sᵀd,   A = (N−1) I + SᵀS,   δw = −A⁻¹ g,   T = √(N−1) A^{-1/2}

Sources: Sakov, Oliver & Bertino (2012), Mon. Wea. Rev. 140, 1988; Bocquet & Sakov (2013), Nonlin. Processes Geophys.
20, 803; projection on the prior anomalies: Raanes, Stordal & Evensen (2019), Nonlin. Processes Geophys. 26, 325.
"""

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.ensemble.linalg import bundle_steps, min_norm_fit
from en4dvar.model.state import Array
from en4dvar.schemes.base import Minimiser, Runs, Weights, regression


@dataclass(frozen=True)
class En4DVar(Minimiser):
    """The scheme; ``linearisation`` says where its members are run.

    ``bundle``: ε away from w, for finite differences about the central prediction (a tangent linearisation). It needs
    no more runs than the anomalies have directions: where r = rank X0 < N − 1, members at w + ε' u_j, u_j the columns
    of the basis, give the same as N members at w + ε e_i, up to O(ε). Where the transform of the iterate before is at
    hand, of an ensemble much narrower than the prior's, the u_j are its axes, with the steps of :func:`bundle_steps`.
    A bundle that is made wider (``Weights.wider``) has members on both sides, at w ± ε' u_j, where these are still
    fewer than N: its error is O(ε²).
    ``tangent``: the same members, of which the model's derivatives say where they are.
    ``transform``: at the rows of 1wᵀ + T, regression about the ensemble mean at posterior spread.
    """

    words = "iterative ensemble smoother"
    localised_keys = frozenset(("epsilon", "max_iterations", "step_tolerance", "cost_tolerance"))

    def economical(self, basis: Array) -> bool:
        n_members, rank = basis.shape
        return not self.regresses and 0 < rank < n_members - 1

    def members(self, weights: Weights, basis: Array | None = None) -> Array:
        """Rows (r or 2r, N) along directions of the basis where these are few, else those of 1wᵀ + εI or 1wᵀ + T."""
        if basis is not None and self.economical(basis):
            rows = self._short(weights) * self._steps(weights, basis) @ basis.T
            return np.asarray(weights.w + (np.vstack([rows, -rows]) if self._on_both_sides(weights, basis) else rows))
        if self.regresses:
            return weights.rows
        return np.asarray(weights.w + self.epsilon * weights.wider * np.eye(len(weights.w)))

    def linearise(self, weights: Weights, runs: Runs) -> tuple[Array, Array]:
        """Reference prediction (Ky,) and anomalies Y = T⁻¹(P − p̄) or (P − p_c)/ε, projected on the prior anomalies.

        Y = U C, returned as C (r, Ky), the minimum-norm regression of the survivors' predictions on their coordinates.
        With all members alive and r = N − 1, U C is Y itself. With r < N − 1 it keeps the weights from fitting
        nonlinearity along directions that do not move the state. With members lost, their rows follow from the
        survivors, exactly if F and H are linear and the survivors span the control space.
        """
        basis, central, active = runs.basis, runs.central, runs.active
        if basis is None or central is None or active is None:
            raise ValueError("en4dvar needs the central run and the basis of one window; on a series use ienks")
        if len(runs.predictions) < len(weights.w):
            if self._on_both_sides(weights, basis):
                ahead, behind = np.split(runs.predictions, 2)
                change = (ahead - behind) / 2
            else:
                change = runs.predictions - central
            return central, np.asarray(np.linalg.solve(self._steps(weights, basis), change / self._short(weights)))
        coordinates = (self.members(weights) - weights.w) @ basis
        if self.regresses:
            return regression(coordinates, runs)
        return central, min_norm_fit(coordinates[active], runs.predictions[active] - central)

    def _steps(self, weights: Weights, basis: Array) -> Array:
        """Of the bundle (r, r) in coordinates of the basis, as shares of ε prior standard deviations."""
        if not len(weights.T):
            return np.eye(basis.shape[1])
        return bundle_steps(*np.linalg.eigh(basis.T @ weights.dense @ basis), self.epsilon)

    def _on_both_sides(self, weights: Weights, basis: Array) -> bool:
        return weights.wider > 1 and 2 * basis.shape[1] < len(basis)

    def _short(self, weights: Weights) -> float:
        """Step along a unit direction of the weights that moves the state by ε, or more, prior standard deviations."""
        return self.epsilon * weights.wider / math.sqrt(len(weights.w) - 1)
