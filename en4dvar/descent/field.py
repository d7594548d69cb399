r"""Fields and many parameters: localised ES-MDA and En4D-Var on arrays.

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
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from en4dvar.descent.field_data import FieldData, Members, Pass, mean_of, silent
from en4dvar.errors import En4dvarError
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.local_gain import ByDistance, Gain, Update, parts
from en4dvar.state import Array

TRIALS, SHORTER = 8, 0.3  # steps that are tried, each so much shorter than the one before


def field_esmda(
    ensemble: Array,
    data: FieldData,
    gain: Gain,
    coefficients: Sequence[float] = (4.0, 4.0, 4.0, 4.0),
    seed: int = 0,
    fewest: int | None = None,
    first: Array | None = None,
    tell: Callable[[Pass], None] = silent,
) -> Members:
    """Prior members (N, n) → posterior members, in place, by ES-MDA with a localised gain.

    Returns the members that came through all passes, ``fewest`` at least, by default all; the others stay where they
    failed. ``first`` (N, K): predictions of the prior members, where they are known. ``tell`` hears of each pass.

    Raises :class:`En4dvarError`: predictions that are not finite.
    """
    alive = np.arange(len(ensemble))
    for a, alpha in enumerate(ESMDA(tuple(coefficients)).inflations):
        predictions = _of_some(ensemble, alive, data, fewest) if a or first is None else first
        found = np.isfinite(predictions).all(axis=1)
        alive, predictions = alive[found], predictions[found]
        errors = np.sqrt(alpha) * data.perturbations(seed, f"ES-MDA {a}", alive)
        mean = predictions.mean(axis=0)
        tell(Pass(mean_of(ensemble, alive), mean, partial(_part_of, ensemble, alive)))
        update = gain.update(predictions - mean, alpha * data.std**2, data.values + errors - predictions)
        for part in parts(ensemble.shape[1], data.width(len(ensemble))):
            here = ensemble[alive, part]
            ensemble[alive, part] = here + update(part, here - here.mean(axis=0))
    return alive


def _of_some(ensemble: Array, alive: Members, data: FieldData, fewest: int | None) -> Array:
    return data.predict(lambda some: ensemble[alive[some]], len(alive), fewest)


def _part_of(ensemble: Array, alive: Members, part: slice) -> Array:
    return np.asarray(ensemble[alive, part])


@dataclass
class FieldDescent:
    """Where a descent ended: the ``centre`` (n,), ``costs`` J of each iterate, whether it ``converged``, and why it
    stopped."""

    centre: Array
    costs: list[float] = field(default_factory=list)
    converged: bool = False
    stop: str = ""
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
    tell: Callable[[Pass], None] = silent,
) -> FieldDescent:
    """Prior members (N, n) → posterior members, in place, by En4D-Var with localised covariances.

    It has converged where the next step is shorter than ``tolerance`` posterior standard deviations of the prediction
    that it moves most, or J falls by less than ``cost_tolerance`` of it: where H is not local, the tapered tangent is
    not quite the gradient of J, and further steps creep. ``tell`` hears of each iterate. Raises
    :class:`En4dvarError`: predictions that are not finite. ValueError: another gain, for which there is no J.
    """
    if not isinstance(gain, ByDistance):
        raise ValueError("En4D-Var is localised by distance; without places use field_esmda(…, ByCorrelation())")
    return _Descent(ensemble, data, gain, epsilon, seed, tell).run(max_iterations, tolerance, cost_tolerance)


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
    def dfs(self) -> float:
        """The trace of H B Hᵀ (H B Hᵀ + R)⁻¹."""
        return float(np.trace(np.linalg.solve(self.covariance + np.diag(self.variance), self.covariance)))

    @property
    def length(self) -> float:
        """Of the full step: the largest change of a prediction, in its posterior standard deviations."""
        C = self.covariance
        variance = np.diag(C) - np.sum(C * np.linalg.solve(C + np.diag(self.variance), C), axis=0)
        return float(np.max(np.abs(C @ self.dual() - self.moved) / np.sqrt(np.maximum(variance, 1e-300))))


class _Descent:
    def __init__(
        self,
        ensemble: Array,
        data: FieldData,
        gain: ByDistance,
        epsilon: float,
        seed: int,
        tell: Callable[[Pass], None],
    ):
        self.data, self.gain, self.epsilon, self.tell = data, gain, epsilon, tell
        self.errors = data.perturbations(seed, "En4D-Var field", range(len(ensemble)))
        self.mean = ensemble.mean(axis=0)
        self.anomalies = ensemble
        self.anomalies -= self.mean  # in place: this is the ensemble from now on, until :meth:`spread` ends it
        self.tangents: list[Array] = []  # Y_k (N, K)
        self.duals: list[Array] = []  # λ_k (K,)
        self.at = FieldDescent(self.mean.copy())

    def run(self, max_iterations: int, tolerance: float, cost_tolerance: float) -> FieldDescent:
        at = self.at
        try:
            prediction = self.predict_one(at.centre)
            at.costs.append(self.cost(prediction, self.tangents, self.duals))
            while True:
                tangent = self.tangent(prediction)
                here = self.local(prediction, tangent)
                before, moved = self._pass(prediction, here), None
                self._judge(here.length, max_iterations, tolerance, cost_tolerance)
                if not at.stop and (moved := self.move(here)) is None:
                    at.stop = "no decrease of J along the step"
                share, prediction = moved or (0.0, prediction)
                self.tell(replace(before, share=share))
                if moved is None:
                    break
            self.spread(tangent)
        except BaseException:
            self.anomalies += self.mean  # the prior, as it was
            raise
        return at

    def _judge(self, length: float, max_iterations: int, tolerance: float, cost_tolerance: float) -> None:
        """Whether the descent ends here, and why."""
        at, costs = self.at, self.at.costs
        if length <= tolerance:
            at.stop = f"step of {length:.2g} posterior standard deviations"
        elif len(costs) > 1 and costs[-2] - costs[-1] < cost_tolerance * costs[-1]:
            at.stop = f"relative decrease of J below {cost_tolerance:g}"
        at.converged = bool(at.stop)
        if not at.stop and len(costs) > max_iterations:
            at.stop = f"iteration limit ({max_iterations}) reached"

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
        misfit = (self.data.values - prediction) / self.data.std
        return self.background(tangents, duals) + 0.5 * float(misfit @ misfit)

    def background(self, tangents: Sequence[Array], duals: Sequence[Array]) -> float:
        """J_b of the iterate x̄0 + Σ_k L_k λ_k."""
        pairs = list(zip(tangents, duals, strict=True))
        return 0.5 * sum(float(a @ self.gain.between(Y, Z) @ b) for Y, a in pairs for Z, b in pairs)

    def _pass(self, prediction: Array, here: _Local) -> Pass:
        """The iterate as it is told, with the posterior ensemble of its tangent."""
        centre, update = self.at.centre, self.update(here.tangent)

        def members(part: slice) -> Array:
            anomalies = self.anomalies[:, part]
            return np.asarray(centre[part] + anomalies + update(part, anomalies))

        background = self.background(self.tangents, self.duals)
        return Pass(centre, prediction, members, background, here.length, dfs=here.dfs)

    def move(self, here: _Local) -> tuple[float, Array] | None:
        """Take the longest step that lowers J; its share of the full one and the prediction there, None where none
        does."""
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
                return a, prediction
        return None

    def update(self, tangent: Array) -> Update:
        """What turns prior anomalies into posterior ones."""
        return self.gain.update(tangent, self.data.std**2, self.errors - tangent)

    def spread(self, tangent: Array) -> None:
        """The posterior ensemble about the centre, in place of the anomalies."""
        update = self.update(tangent)
        for part in parts(self.anomalies.shape[1], self.data.width(len(self.anomalies))):
            here = self.anomalies[:, part]
            here += update(part, here)
            here += self.at.centre[part] - here.mean(axis=0)
