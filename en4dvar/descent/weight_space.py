"""One data set seen from weight space, x = x̄0 + X0ᵀw: forecasts, linearisations and trial steps of any descent.

The tangent of the bundle variant needs no more runs than the anomalies have directions: with r = rank X0 < N − 1 the
members w + ε u_j, u_j the columns of an orthonormal basis of those directions, give the same linearisation as N members
w + ε e_i, up to O(ε). Where one of them fails the whole bundle of N members is run instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.descent.step_control import STEP_CONTROLS, Move, Point, Tangent, Trials, run_searches
from en4dvar.ensemble.forecast import NO_TIMES, Forecast, forecast
from en4dvar.ensemble.linalg import Hessian, anomaly_basis, centre
from en4dvar.executor import Executor
from en4dvar.likelihood import Linearisation, observation_cost, precision_times, whiten
from en4dvar.prior import Prior, Sampling
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.schemes import Evaluation, Scheme, Step, Weights
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.state import Array


@dataclass(frozen=True)
class Local:
    """What is known at weights: the runs it took, J_o and J at the centre, and the step from there.

    ``members`` are the runs beside the centre, N of them or r. ``active`` counts the members that inform the step: N
    where r runs stand for all. Where too few do, ``linear``, the linearisation in coordinates of the basis, and
    ``step`` are None.
    """

    weights: Weights
    members: Forecast
    central: Forecast
    active: int
    observation: float
    cost: float
    linear: Linearisation | None
    step: Step | None


_Seen = tuple[Weights, Forecast, Forecast, int, float, float, Linearisation | None]  # a Local but for its step


@dataclass(frozen=True)
class PriorEnsemble:
    """Members E0 (N, n), transformed, their mean (n,), anomalies X0 (N, n), variance (n,) and basis (N, r) of X0."""

    members: Array
    mean: Array
    anomalies: Array
    variance: Array
    basis: Array


@lru_cache(maxsize=4)
def prior_ensemble(prior: Prior, n_members: int, seed: int, sampling: Sampling) -> PriorEnsemble:
    """The ensemble that every data set of a campaign starts from: drawn once, read-only."""
    members = prior.sample(n_members, seed, sampling)
    mean, anomalies = centre(members)
    drawn = PriorEnsemble(members, mean, anomalies, members.var(axis=0), anomaly_basis(anomalies))
    for array in vars(drawn).values():
        array.flags.writeable = False
    return drawn


class WeightSpace:
    """The ensemble of a problem, its model behind an executor, and the count of forward runs."""

    def __init__(self, problem: InverseProblem, settings: AssimilationSettings, seed: int, executor: Executor):
        self.problem, self.settings, self.executor = problem, settings, executor
        self.scheme: Scheme = En4DVar(settings.linearisation, settings.epsilon)
        self.step_control = STEP_CONTROLS[settings.step_control]
        drawn = prior_ensemble(problem.prior, settings.members, seed, settings.sampling)
        self.members, self.mean, self.anomalies = drawn.members, drawn.mean, drawn.anomalies
        self.prior_variance, self.basis = drawn.variance, drawn.basis
        self.forward_runs = 0

    @property
    def economical(self) -> bool:
        """Whether a tangent takes fewer runs than members."""
        rank, n_members = self.basis.shape[1], len(self.members)
        return self.settings.linearisation == "bundle" and 0 < rank < n_members - 1

    def control(self, w: Array) -> Array:
        """Control vectors (…, n) of weights (…, N)."""
        return np.asarray(self.mean + w @ self.anomalies)

    def forecast(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        self.forward_runs += len(x)
        return forecast(self.problem, x, self.executor, extra_times)

    def observation_cost(self, run: Forecast) -> Array:
        return observation_cost(self.problem.observations, run.predictions, run.rates, run.noise_scale)

    def try_out(self, w: Array) -> Trials:
        """J and predictions of central trajectories at weights (B, N)."""
        run = self.forecast(self.control(w))
        return Trials(diag.background_cost(w) + self.observation_cost(run), run.predictions)

    def search(self, locals_: Sequence[Local]) -> list[Move | None]:
        """One move of each descent, by the configured step control; None where there is no step or no decrease."""
        stepping = [i for i, at in enumerate(locals_) if at.step is not None]
        points = [Point(at.weights.w, at.cost, at.step, self._tangent(at)) for at in locals_ if at.step is not None]
        found = run_searches([self.step_control(point) for point in points], self.try_out)
        moves: list[Move | None] = [None] * len(locals_)
        for i, move in zip(stepping, found, strict=True):
            moves[i] = move
        return moves

    def linearise(self, weights: Sequence[Weights]) -> list[Local]:
        """Steps at several weights, from one call of the model."""
        rows = [self._run_at(each) for each in weights]
        whole = self.forecast(self.control(np.concatenate(rows)))
        centres = np.cumsum([len(row) for row in rows]) - 1
        observation = self.observation_cost(whole.rows(centres)).tolist()
        background = diag.background_cost(np.array([each.w for each in weights])).tolist()
        seen, first = [], 0
        for at, last, of_prior, of_data in zip(weights, centres.tolist(), background, observation, strict=True):
            seen.append(self._seen(at, whole[first:last], whole[last : last + 1], of_prior, of_data))
            first = last + 1
        return self._with_steps(seen)

    def _with_steps(self, seen: Sequence[_Seen]) -> list[Local]:
        observations = self.problem.observations
        told = [None if linear is None else whiten(observations, linear) for *_, linear in seen]
        sensitivities = [s for _, s in filter(None, told)]
        hessians = iter(Hessian.of_each(np.array(sensitivities), self.basis) if sensitivities else ())
        steps = [
            None if pair is None else self.scheme.step(at, Evaluation(*pair, self.basis, next(hessians)))
            for (at, *_), pair in zip(seen, told, strict=True)
        ]
        return [Local(*parts, step) for parts, step in zip(seen, steps, strict=True)]

    def _tangent(self, at: Local) -> Tangent | None:
        """None for a regression."""
        if at.linear is None or self.settings.linearisation != "bundle":
            return None
        precision = partial(precision_times, self.problem.observations, at.linear)
        return Tangent(at.linear.prediction, at.linear.anomalies, precision, self.basis)

    @property
    def needed_members(self) -> int:
        """The members that must survive for a regression on the control vector."""
        n_members, n = self.members.shape
        return max(math.ceil(self.settings.min_active_fraction * n_members), min(n + 1, n_members))

    def _run_at(self, weights: Weights) -> Array:
        """Weights to be run for a linearisation; the last row is the centre."""
        if self.economical:
            return np.asarray(weights.w + self._offsets)
        return np.vstack([self.scheme.member_weights(weights), weights.w])

    @cached_property
    def _offsets(self) -> Array:
        return np.vstack([self._short * self.basis.T, np.zeros(len(self.members))])

    @property
    def _short(self) -> float:
        """Step along a unit direction of the weights that moves the state by ε prior standard deviations."""
        return self.settings.epsilon / math.sqrt(len(self.members) - 1)

    def _seen(
        self, weights: Weights, members: Forecast, central: Forecast, background: float, observation: float
    ) -> _Seen:
        reduced = self.economical and not any(members.failures)
        if self.economical and not reduced:
            members = self.forecast(self.control(self.scheme.member_weights(weights)))
        total = background + observation
        active = len(self.members) if reduced else int(members.active.sum())
        linear = None
        if active >= self.needed_members and math.isfinite(total):
            linear = _split(central, *self._linearisation(weights, members, central, reduced))
        return weights, members, central, active, observation, total, linear

    def _linearisation(
        self, weights: Weights, members: Forecast, central: Forecast, reduced: bool
    ) -> tuple[Array, Array]:
        """Reference (Ky,) and anomalies (r, Ky) of all that :func:`_stack` puts side by side, per unit coordinate."""
        stacked, reference = _stack(members), _stack(central)
        if reduced:
            return reference[0], (stacked - reference[0]) / self._short
        return self.scheme.linearise(weights, self.basis, stacked, reference[0], members.active)


def _stack(run: Forecast) -> Array:
    """Predictions, where there are timing errors rates, and where there is a noise scale ln σ: (B, Ky)."""
    parts = [run.predictions]
    if run.rates is not None:
        parts.append(run.rates)
    if run.noise_scale is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            parts.append(np.log(run.noise_scale)[:, None])
    return np.hstack(parts) if len(parts) > 1 else parts[0]


def _split(run: Forecast, reference: Array, anomalies: Array) -> Linearisation:
    """The linearisation of what was stacked."""
    k = run.predictions.shape[1]
    rate = rate_anomalies = scale_anomalies = None
    log_scale = None
    if run.rates is not None:
        rate, rate_anomalies = reference[k : 2 * k], anomalies[:, k : 2 * k]
    if run.noise_scale is not None:
        log_scale, scale_anomalies = float(reference[-1]), anomalies[:, -1]
    return Linearisation(reference[:k], anomalies[:, :k], rate, rate_anomalies, log_scale, scale_anomalies)
