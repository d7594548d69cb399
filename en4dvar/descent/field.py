r"""Fields and many parameters: localised ES-MDA and En4D-Var on arrays.

What is estimated is an ensemble (N, n) that is changed in place, n up to millions: nothing of its size is made beside
it but a few vectors (n,) and what the model makes of a few members at a time.

En4D-Var finds the minimum of J = ½ (x − x̄0)ᵀB⁻¹(x − x̄0) + ½ ‖y − H(x)‖²_R, B = ρ ∘ X0ᵀX0/(N−1), which is no covariance
of N members. So it goes in the space of the observations: with the tangent Y_l of the predictions along X0 at the
iterate x_l (a bundle), L_l = ρ_xy ∘ X0ᵀY_l/(N−1) and H_l B H_kᵀ = ρ_yy ∘ Y_lᵀY_k/(N−1),

    x* = x̄0 + L_l λ,   (H_l B H_lᵀ + R) λ = y − H(x_l) + H_l(x_l − x̄0),

the Gauss–Newton step; every iterate is x̄0 + Σ_k L_k λ_k, from which J_b and H_l(x_l − x̄0) follow without B. Where J
does not fall, B of the step is made smaller (Levenberg–Marquardt in the metric B⁻¹). Members of the posterior are
x + X0_i + L (H B Hᵀ + R)⁻¹ (R^{1/2} z_i − Y_i), z_i ~ N(0, I) and centred. What has no place is not tapered: B has a
block of its own for it, X0ᵀX0/(N−1), and a run each tells its derivatives.

Sources: Courtier (1997), Q. J. R. Meteorol. Soc. 123, 2449 (dual form); Emerick & Reynolds (2013), Computers &
Geosciences 55, 3 (ES-MDA).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from en4dvar.descent.field_data import FieldData, Pass, moment_of
from en4dvar.descent.loop import Descends, Objective, minimise
from en4dvar.descent.step_control import Move, Search
from en4dvar.ensemble.missing import fitted
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.schemes.base import mda_inflations
from en4dvar.schemes.local_gain import ByDistance, Gain, Split, Update, parts

TRIALS, SHORTER = 8, 0.3  # steps that are tried, each so much shorter than the one before


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
    passes = Passes(ensemble, data, gain, mda_inflations(coefficients), seed)
    minimise(passes, [passes])


class Passes(Objective["Passes"], Descends):
    """The passes of ES-MDA over an ensemble, which is their only descent, with R times each of the ``inflations``.

    ``alive`` are the members that came through all, ``fewest`` at least, by default all of them; the others stay where
    they failed. ``first`` (N, K): predictions of the prior members, where they are known. ``tell`` hears of each pass.
    """

    def __init__(
        self, ensemble: Array, data: FieldData, gain: Gain, inflations: Array, seed: int, fewest: int | None = None,
        first: Array | None = None, tell: Callable[[Pass], None] = lambda at: None,
    ):  # fmt: skip
        self.ensemble, self.data, self.gain, self.inflations, self.seed = ensemble, data, gain, inflations, seed
        self.fewest, self.first, self.tell = fewest, first, tell
        self.alive = np.arange(len(ensemble))
        self.iteration = 0

    def linearise(self, going: "Sequence[Passes]") -> list[Update]:
        a, alpha, first = self.iteration, self.inflations[self.iteration], self.first
        predictions = self._predicted() if a or first is None else first
        finite = np.isfinite(predictions).all(axis=1)
        self.alive, predictions = self.alive[finite], predictions[finite]
        errors = np.sqrt(alpha) * self.data.perturbations(self.seed, f"ES-MDA {a}", self.alive)
        ensemble, alive = self.ensemble, self.alive
        self.tell(Pass(moment_of(ensemble, alive), predictions.mean(axis=0), lambda part: ensemble[alive, part]))
        anomalies, innovations = predictions - predictions.mean(axis=0), self.data.values + errors - predictions
        tangent, gain = Split(anomalies), self.gain
        if isinstance(gain, ByDistance) and len(gain.common):
            tangent = Split.by_regression(anomalies, ensemble[np.ix_(alive, gain.common)])
        return [gain.update(tangent, alpha * self.data.std**2, innovations)]

    def move(self, going: "Sequence[Passes]", moves: Sequence[Move | None]) -> None:
        for part in parts(self.ensemble.shape[1], self.data.width(len(self.ensemble))):
            here = self.ensemble[self.alive, part]
            self.ensemble[self.alive, part] = here + self.step(part, here - here.mean(axis=0))
        self.iteration += 1
        self.ended = self.iteration == len(self.inflations)

    def _predicted(self) -> Array:
        """(M, K) of the M members alive; what some lack is regressed on the others."""
        predictions = np.full((len(self.ensemble), len(self.data.values)), np.nan)
        predictions[self.alive] = self.data.runs(lambda some: self.ensemble[self.alive[some]], len(self.alive))
        return self.data.enough(fitted(self.ensemble, predictions)[self.alive], self.fewest)


@dataclass(frozen=True)
class DualSystem:
    """About an iterate: Y (N, K), H B Hᵀ (K, K), H (x − x̄0) (K,), innovation y − H(x) (K,), error variance (K,)."""

    tangent: Split
    covariance: Array
    moved: Array
    innovation: Array
    variance: Array

    def dual(self, a: float = 1.0) -> Array:
        """λ (K,) of the step x̄0 + (1 − a)(x − x̄0) + a L λ, which minimises J plus (1/a − 1)/2 δxᵀB⁻¹δx, linearised."""
        system = a * self.covariance + np.diag(self.variance)
        return np.asarray(np.linalg.solve(system, self.innovation + a * self.moved), dtype=np.float64)

    @property
    def leverages(self) -> Array:
        """(K,) of the readings, the diagonal of H B Hᵀ (H B Hᵀ + R)⁻¹; their sum are the degrees of freedom."""
        return np.diag(np.linalg.solve(self.covariance + np.diag(self.variance), self.covariance))

    @property
    def length(self) -> float:
        """Of the full step: the largest change of a prediction, in its posterior standard deviations."""
        std = np.sqrt(np.maximum(self.leverages * self.variance, 1e-300))
        return float(np.max(np.abs(self.covariance @ self.dual() - self.moved) / std))


@dataclass
class FieldDescent(Descends):
    """Where a descent stands: the ``centre`` x̄0 + Σ_k L_k λ_k (n,), its ``background`` J_b and ``prediction`` (K,),
    ``costs`` J of each iterate, the ``tangents`` Y_k (N, K) and ``duals`` λ_k (K,) so far; its ``step`` is a
    :class:`DualSystem`."""

    centre: Array
    prediction: Array
    background: float = 0.0
    costs: list[float] = field(default_factory=list)
    tangents: tuple[Split, ...] = ()
    duals: tuple[Array, ...] = ()
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
    tell: Callable[[Pass], None] = lambda at: None,
) -> FieldDescent:
    """Prior members (N, n) → posterior members, in place, by En4D-Var with localised covariances.

    It has converged where the next step is shorter than ``tolerance`` posterior standard deviations of the prediction
    that it moves most, or J falls by less than ``cost_tolerance`` of it: where H is not local, the tapered tangent is
    not quite the gradient of J, and further steps creep. ``tell`` hears of each iterate. Raises
    :class:`En4dvarError`: predictions that are not finite. ValueError: another gain, for which there is no J.
    """
    if not isinstance(gain, ByDistance):
        raise ValueError("En4D-Var is localised by distance; without places use field_esmda(…, ByCorrelation())")
    mean = ensemble.mean(axis=0)
    ensemble -= mean  # in place: these are anomalies until :meth:`FieldObjective.spread` ends it
    objective = FieldObjective(
        ensemble, mean, data, gain, epsilon, (max_iterations, tolerance, cost_tolerance), seed, tell
    )
    try:
        descent = objective.start()
        minimise(objective, [descent])
        objective.spread(descent)
    except BaseException:
        ensemble += mean  # the prior, as it was
        raise
    return descent


class FieldObjective(Objective[FieldDescent]):
    """J of fields with prior ``anomalies`` (N, n) about the ``mean`` (n,), in the space of the observations."""

    def __init__(
        self, anomalies: Array, mean: Array, data: FieldData, gain: ByDistance, epsilon: float,
        limits: tuple[int, float, float], seed: int, tell: Callable[[Pass], None],
    ):  # fmt: skip
        self.anomalies, self.mean, self.data, self.gain = anomalies, mean, data, gain
        self.epsilon, self.limits, self.tell = epsilon, limits, tell
        self.errors = data.perturbations(seed, "En4D-Var field", range(len(anomalies)))

    def start(self) -> FieldDescent:
        first = self.data.predict(lambda _: self.mean[None], 1)[0]
        descent = FieldDescent(self.mean.copy(), first, forward_runs=1)
        descent.costs.append(self.cost(first, 0.0))
        return descent

    def linearise(self, going: Sequence[FieldDescent]) -> list[DualSystem]:
        return [self._system(at) for at in going]

    def _system(self, at: FieldDescent) -> DualSystem:
        """By the derivatives of the predictions along the prior anomalies."""
        count, common = len(self.anomalies), self.gain.common

        def beside(some: slice) -> Array:
            x = at.centre + self.epsilon * self.anomalies[some]
            x[:, common] = at.centre[common]
            return x

        at.forward_runs += count + len(common)
        local = np.delete(self.anomalies, common, axis=1) if len(common) else self.anomalies
        runs = self.data.enough(fitted(local, self.data.runs(beside, count)))
        placed = (runs - at.prediction) / self.epsilon
        tangent = Split(placed - placed.mean(axis=0))
        if len(common):
            X = self.anomalies[:, common]
            steps = np.zeros((len(common), len(at.centre)))
            steps[range(len(common)), common] = size = self.epsilon * X.std(axis=0)
            runs = self.data.predict(lambda some: at.centre + steps[some], len(common))
            tangent = replace(tangent, common=X @ ((runs - at.prediction) / size[:, None]))
        between = self.gain.between
        pairs = zip(at.tangents, at.duals, strict=True)
        moved = sum((between(tangent, Y) @ dual for Y, dual in pairs), np.zeros(len(at.prediction)))
        innovation = self.data.values - at.prediction
        return DualSystem(tangent, between(tangent, tangent), moved, innovation, self.data.std**2)

    def judge(self, going: Sequence[FieldDescent]) -> None:
        most, tolerance, cost_tolerance = self.limits
        for at in going:
            costs, length = at.costs, at.step.length
            if length <= tolerance:
                at.stop = f"step of {length:.2g} posterior standard deviations"
            elif len(costs) > 1 and costs[-2] - costs[-1] < cost_tolerance * costs[-1]:
                at.stop = f"relative decrease of J below {cost_tolerance:g}"
            at.converged = bool(at.stop)
            if not at.stop and len(costs) > most:
                at.stop = f"iteration limit ({most}) reached"

    def search(self, descent: FieldDescent) -> Search:
        """The longest step that lowers J."""
        at, system = descent, descent.step
        for k in range(TRIALS):
            a = SHORTER**k
            dual = a * system.dual(a)
            x = self.mean + (1 - a) * (at.centre - self.mean)
            for part in parts(len(x), self.data.width(len(self.anomalies))):
                x[part] += self.gain.along(part, self.anomalies[:, part], system.tangent, dual[None])[0]
            at.forward_runs += 1
            prediction = yield x[None]
            if prediction is None:  # the model does not run there: nearer
                continue
            across = dual @ ((1 - a) * system.moved + 0.5 * system.covariance @ dual)
            background = (1 - a) ** 2 * at.background + float(across)
            ahead = replace(
                at, centre=x, prediction=prediction, background=background, tangents=(*at.tangents, system.tangent),
                duals=(*((1 - a) * old for old in at.duals), dual),
            )  # fmt: skip
            cost = self.cost(prediction, background)
            if cost < at.costs[-1]:
                return Move(ahead, cost, a)
        return None

    def try_out(self, candidates: Array) -> Array | None:
        """The prediction (K,) at a candidate (1, n); None where the model does not run there."""
        try:
            return np.asarray(self.data.predict(lambda _: candidates, 1)[0])
        except En4dvarError:
            return None

    def move(self, going: Sequence[FieldDescent], moves: Sequence[Move | None]) -> None:
        for at, move in zip(going, moves, strict=True):
            here = self._pass(at)
            if move is None:
                at.stop = at.stop or "no decrease of J along the step"
            else:
                ahead: FieldDescent = move.w
                at.centre, at.prediction, at.background = ahead.centre, ahead.prediction, ahead.background
                at.tangents, at.duals = ahead.tangents, ahead.duals
                at.costs.append(move.cost)
            self.tell(replace(here, share=move.step_length if move else 0.0))
            at.ended = bool(at.stop)

    def cost(self, prediction: Array, background: float) -> float:
        """J of an iterate with its J_b."""
        misfit = (self.data.values - prediction) / self.data.std
        return background + 0.5 * float(misfit @ misfit)

    def _pass(self, at: FieldDescent) -> Pass:
        """The iterate as it is told, with the posterior ensemble of its tangent."""
        centre, update = at.centre, self.update(at.step.tangent)

        def members(part: slice) -> Array:
            anomalies = self.anomalies[:, part]
            return np.asarray(centre[part] + anomalies + update(part, anomalies))

        return Pass(centre, at.prediction, members, at.background, at.step.length, dfs=float(at.step.leverages.sum()))

    def update(self, tangent: Split) -> Update:
        """What turns prior anomalies into posterior ones."""
        return self.gain.update(tangent, self.data.std**2, self.errors - tangent.whole)

    def spread(self, at: FieldDescent) -> None:
        """The posterior ensemble about the centre, in place of the anomalies."""
        update = self.update(at.step.tangent)
        for part in parts(self.anomalies.shape[1], self.data.width(len(self.anomalies))):
            here = self.anomalies[:, part]
            here += update(part, here)
            here += at.centre[part] - here.mean(axis=0)
