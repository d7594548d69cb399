r"""Fields and many parameters from Python: localised ES-MDA and En4D-Var on arrays.

What is estimated is an ensemble (N, n) that is changed in place, n up to millions: nothing of its size is made beside
it but a few vectors (n,) and what the model makes of a few members at a time.

En4D-Var finds the minimum of J = ½ (x − x̄0)ᵀB⁻¹(x − x̄0) + ½ ‖y − H(x)‖²_R, B = ρ ∘ X0ᵀX0/(N−1), which is no covariance
of N members. So it goes in the space of the observations: with the tangent Y_l of the predictions along X0 at the
iterate x_l (a bundle), L_l = ρ_xy ∘ X0ᵀY_l/(N−1) and H_l B H_kᵀ = ρ_yy ∘ Y_lᵀY_k/(N−1),

    x* = x̄0 + L_l λ,   (H_l B H_lᵀ + R) λ = y − H(x_l) + H_l(x_l − x̄0),

the Gauss–Newton step; every iterate is x̄0 + Σ_k L_k λ_k, from which J_b and H_l(x_l − x̄0) follow without B. Where J
does not fall, B of the step is made smaller (Levenberg–Marquardt in the metric B⁻¹). Members of the posterior are
x + X0_i + L (H B Hᵀ + R)⁻¹ (R^{1/2} z_i − Y_i), z_i ~ N(0, I) and centred.

Sources: Courtier (1997), Q. J. R. Meteorol. Soc. 123, 2449 (dual form); Emerick & Reynolds (2013), Computers &
Geosciences 55, 3 (ES-MDA).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from en4dvar.errors import En4dvarError
from en4dvar.prior import member_stream
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.local_gain import ByDistance, Gain, parts
from en4dvar.state import Array

Forward = Callable[[Array], Array]  # members (M, n) → predictions (M, K)
TRIALS, SHORTER = 8, 0.3  # steps that are tried, each so much shorter than the one before


@dataclass(frozen=True)
class FieldData:
    """Readings ``values`` (K,) with independent errors ``std`` (K,), and the model that predicts them.

    ``forward``: members (M, n) → predictions (M, K); it gets ``at_once`` members in a call.
    """

    values: Array
    std: Array
    forward: Forward
    at_once: int = 16

    def predict(self, members: Callable[[slice], Array], count: int) -> Array:
        """Predictions (count, K) of members that are made a few at a time. Raises :class:`En4dvarError`."""
        found = np.empty((count, len(self.values)))
        for first in range(0, count, self.at_once):
            some = slice(first, min(first + self.at_once, count))
            found[some] = np.asarray(self.forward(members(some)), dtype=float)
        if not np.isfinite(found).all():
            lost = np.flatnonzero(~np.isfinite(found).all(axis=1))
            raise En4dvarError(f"{len(lost)} of {count} members have predictions that are not finite, first {lost[0]}")
        return found

    def width(self, members: int) -> int:
        """Numbers that a cell takes in an update."""
        return max(len(self.values), members)

    def perturbations(self, seed: int, purpose: str, count: int) -> Array:
        """Centred draws (count, K) of the errors."""
        z = np.stack([member_stream(seed, purpose, i).standard_normal(len(self.values)) for i in range(count)])
        return np.asarray(self.std * (z - z.mean(axis=0)))


def field_esmda(
    ensemble: Array,
    data: FieldData,
    gain: Gain,
    coefficients: Sequence[float] = (4.0, 4.0, 4.0, 4.0),
    seed: int = 0,
) -> None:
    """Prior members (N, n) → posterior members, in place, by ES-MDA with a localised gain.

    Raises :class:`En4dvarError`: predictions that are not finite.
    """
    n_members = len(ensemble)
    for a, alpha in enumerate(ESMDA(tuple(coefficients)).inflations):
        predictions = data.predict(lambda some: ensemble[some], n_members)
        errors = np.sqrt(alpha) * data.perturbations(seed, f"ES-MDA {a}", n_members)
        Y = predictions - predictions.mean(axis=0)
        update = gain.update(Y, alpha * data.std**2, data.values + errors - predictions)
        for part in parts(ensemble.shape[1], data.width(n_members)):
            here = ensemble[:, part]
            here += update(part, here - here.mean(axis=0))


@dataclass
class FieldDescent:
    """Where a descent ended: the ``centre`` (n,), ``costs`` J of each iterate, and whether it ``converged``."""

    centre: Array
    costs: list[float] = field(default_factory=list)
    converged: bool = False
    forward_runs: int = 0


def field_en4dvar(
    ensemble: Array,
    data: FieldData,
    gain: ByDistance,
    *,
    epsilon: float = 1e-3,
    max_iterations: int = 20,
    tolerance: float = 1e-3,
    cost_tolerance: float = 1e-3,
    seed: int = 0,
) -> FieldDescent:
    """Prior members (N, n) → posterior members, in place, by En4D-Var with localised covariances.

    It has converged where the next step is shorter than ``tolerance`` prior standard deviations of the predictions that
    it moves most, or J falls by less than ``cost_tolerance`` of it: where H is not local, the tapered tangent is not
    quite the gradient of J, and further steps creep. Raises :class:`En4dvarError`: predictions that are not finite.
    ValueError: another gain, for which there is no J.
    """
    if not isinstance(gain, ByDistance):
        raise ValueError("En4D-Var is localised by distance; without places use field_esmda(…, ByCorrelation())")
    return _Descent(ensemble, data, gain, epsilon).run(max_iterations, tolerance, cost_tolerance, seed)


@dataclass(frozen=True)
class _Local:
    """About an iterate: Y (N, K), H B Hᵀ (K, K), H (x − x̄0) (K,), innovation y − H(x) (K,), error variance (K,)."""

    tangent: Array
    covariance: Array
    moved: Array
    innovation: Array
    variance: Array

    def dual(self, a: float = 1.0) -> Array:
        """λ (K,) of the step x̄0 + (1 − a)(x − x̄0) + a L λ, which minimises J plus (1/a − 1)/2 δxᵀB⁻¹δx, linearised."""
        system = a * self.covariance + np.diag(self.variance)
        return np.asarray(np.linalg.solve(system, self.innovation + a * self.moved), dtype=np.float64)

    @property
    def length(self) -> float:
        """Of the full step: the largest change of a prediction, in its prior standard deviations."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        return float(np.max(np.abs(self.covariance @ self.dual() - self.moved) / spread))


class _Descent:
    def __init__(self, ensemble: Array, data: FieldData, gain: ByDistance, epsilon: float):
        self.data, self.gain, self.epsilon = data, gain, epsilon
        self.mean = ensemble.mean(axis=0)
        self.anomalies = ensemble
        self.anomalies -= self.mean  # in place: this is the ensemble from now on, until :meth:`spread` ends it
        self.tangents: list[Array] = []  # Y_k (N, K)
        self.duals: list[Array] = []  # λ_k (K,)
        self.at = FieldDescent(self.mean.copy())

    def run(self, max_iterations: int, tolerance: float, cost_tolerance: float, seed: int) -> FieldDescent:
        at = self.at
        try:
            prediction = self.predict_one(at.centre)
            at.costs.append(self.cost(prediction, self.tangents, self.duals))
            while True:
                tangent = self.tangent(prediction)
                here = self.local(prediction, tangent)
                at.converged = here.length <= tolerance or self._creeps(cost_tolerance)
                moved = None
                if not at.converged and len(at.costs) <= max_iterations:
                    moved = self.move(here)
                if moved is None:
                    break
                prediction = moved
            self.spread(tangent, seed)
        except BaseException:
            self.anomalies += self.mean  # the prior, as it was
            raise
        return at

    def _creeps(self, cost_tolerance: float) -> bool:
        """Whether the last move lowered J by too little to go on."""
        costs = self.at.costs
        return len(costs) > 1 and costs[-2] - costs[-1] < cost_tolerance * costs[-1]

    def predict_one(self, x: Array) -> Array:
        self.at.forward_runs += 1
        return self.data.predict(lambda _: x[None], 1)[0]

    def tangent(self, prediction: Array) -> Array:
        """Y (N, K): derivatives of the predictions along the prior anomalies, at the centre."""
        centre, epsilon, count = self.at.centre, self.epsilon, len(self.anomalies)
        self.at.forward_runs += count
        runs = self.data.predict(lambda some: centre + epsilon * self.anomalies[some], count)
        tangent = (runs - prediction) / epsilon
        return np.asarray(tangent - tangent.mean(axis=0))

    def local(self, prediction: Array, tangent: Array) -> _Local:
        """What the centre, its prediction and the tangent there say."""
        covariance = self.gain.between(tangent, tangent)
        moved = sum((self.gain.between(tangent, Y) @ dual for Y, dual in self._so_far), np.zeros(len(prediction)))
        return _Local(tangent, covariance, moved, self.data.values - prediction, self.data.std**2)

    @property
    def _so_far(self) -> list[tuple[Array, Array]]:
        return list(zip(self.tangents, self.duals, strict=True))

    def cost(self, prediction: Array, tangents: Sequence[Array], duals: Sequence[Array]) -> float:
        """J of the iterate x̄0 + Σ_k L_k λ_k."""
        pairs = list(zip(tangents, duals, strict=True))
        background = sum(float(a @ self.gain.between(Y, Z) @ b) for Y, a in pairs for Z, b in pairs)
        misfit = (self.data.values - prediction) / self.data.std
        return 0.5 * background + 0.5 * float(misfit @ misfit)

    def move(self, here: _Local) -> Array | None:
        """Take the longest step that lowers J; the prediction there, None where none does."""
        for k in range(TRIALS):
            a = SHORTER**k
            dual = a * here.dual(a)
            x = self.mean + (1 - a) * (self.at.centre - self.mean)
            for part in parts(len(x), self.data.width(len(self.anomalies))):
                x[part] += self.gain.along(part, self.anomalies[:, part], here.tangent, dual[None])[0]
            try:
                prediction = self.predict_one(x)
            except En4dvarError:  # the model does not run there: nearer
                continue
            tangents, duals = [*self.tangents, here.tangent], [*((1 - a) * old for old in self.duals), dual]
            cost = self.cost(prediction, tangents, duals)
            if cost < self.at.costs[-1]:
                self.at.centre, self.tangents, self.duals = x, tangents, duals
                self.at.costs.append(cost)
                return prediction
        return None

    def spread(self, tangent: Array, seed: int) -> None:
        """The posterior ensemble about the centre, in place of the anomalies."""
        errors = self.data.perturbations(seed, "En4D-Var field", len(self.anomalies))
        update = self.gain.update(tangent, self.data.std**2, errors - tangent)
        for part in parts(self.anomalies.shape[1], self.data.width(len(self.anomalies))):
            here = self.anomalies[:, part]
            here += update(part, here)
            here += self.at.centre[part] - here.mean(axis=0)
