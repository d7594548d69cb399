r"""The linear response of a posterior: where its mode goes when predictions, observations or the prior change.

In coordinates c of the control vector, x = x̂ + Eᵀc, in which the prior's covariance is 1/(N−1), with the whitened
tangent S (K', r) at the mode x̂ of J,

    g(c) = (N−1) (c − c_b) − Sᵀ d(c),     A = (N−1) I + SᵀS,     δc = −A⁻¹ (g' − g),

g' the gradient of the changed problem and g that of the problem itself (0 at its minimum, within what the iterations
leave). With a constant R and the same prior this is δx = C JᵀR⁻¹ (δy − δm), C = EᵀA⁻¹E the covariance of the posterior.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.data.noise import Linearisation
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.influence import ReadingTangent
from en4dvar.model.state import Array


@dataclass(frozen=True)
class LinearResponse:
    """The tangent of the predictions at a control vector ``at`` (n,), and the prior about it.

    ``linear`` holds anomalies (r, K) per unit of r coordinates, ``directions`` E (r, n) the control vector's change per
    unit of each, ``precision`` is N − 1.
    """

    at: Array
    linear: Linearisation
    directions: Array
    precision: float
    observations: Observations

    @property
    def defined(self) -> bool:
        """True if the mode could be run."""
        return bool(np.isfinite(self.linear.prediction.values).all())

    @cached_property
    def whitened(self) -> tuple[Array, Array]:
        """d (K',) and S (K', r) at ``at``."""
        return self.observations.whiten(self.linear)

    @cached_property
    def gain(self) -> Array:
        """∂x̂/∂d (n, K'): how the mode follows the whitened innovation."""
        _, S = self.whitened
        return np.asarray(self.directions.T @ np.linalg.solve(self._hessian(S), S.T))

    def coordinates(self, changes: Array) -> Array:
        """Coordinates (…, r) of changes (…, n) of the control vector, of least length."""
        return np.asarray(np.linalg.lstsq(self.directions.T, changes.T, rcond=None)[0].T)

    def step(
        self, observations: Observations, linear: Linearisation, moved: Array, prior_shift: Array
    ) -> tuple[Array, float]:
        """δx (n,) to the mode of a changed problem, from ``at`` + ``moved`` (n,), where ``linear`` has its prediction
        and a tangent, and by how much its J falls on the way, as far as it is quadratic.

        ``observations`` are the changed ones, ``prior_shift`` (n,) is the change of the prior's mean.
        """
        d, S = self.whitened
        changed, tangent = observations.whiten(linear)
        gradient = self.precision * self.coordinates(moved - prior_shift) - tangent.T @ changed + S.T @ d
        step = -np.linalg.solve(self._hessian(tangent), gradient)
        return np.asarray(step @ self.directions), -0.5 * float(gradient @ step)

    def tangent(self, members: Array) -> ReadingTangent:
        """The rows of each reading, of independent errors, beside control vectors (N, n).

        Rows of what moves R follow those of the observations, in the same order.
        """
        d, S = self.whitened
        k = len(self.observations)
        rows = d.reshape(-1, k).T, S.reshape(-1, k, S.shape[1]).transpose(1, 0, 2)
        return ReadingTangent(*rows, self.coordinates(members - self.at), self.directions)

    def _hessian(self, S: Array) -> Array:
        return np.asarray(self.precision * np.eye(S.shape[1]) + S.T @ S)
