"""One data set seen from weight space, x = x̄0 + X0ᵀw: forecasts, linearisations and trial steps of any descent.

The tangent of the bundle variant needs no more runs than the anomalies have directions: with r = rank X0 < N − 1 the
members w + ε u_j, u_j the columns of an orthonormal basis of those directions, give the same linearisation as N members
w + ε e_i, up to O(ε). Where one of them fails the whole bundle of N members is run instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.descent.step_control import STEP_CONTROLS, Move, Point, Tangent, Trials, run_searches
from en4dvar.ensemble.forecast import NO_TIMES, Forecast, forecast
from en4dvar.ensemble.linalg import anomaly_basis, centre
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
    where r runs stand for all. ``step`` is None where too few do; ``tangent`` is None for a regression.
    """

    weights: Weights
    members: Forecast
    central: Forecast
    active: int
    observation: float
    cost: float
    step: Step | None
    tangent: Tangent | None


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
        points = [Point(at.weights.w, at.cost, at.step, at.tangent) for at in locals_ if at.step is not None]
        found = run_searches([self.step_control(point) for point in points], self.try_out)
        moves: list[Move | None] = [None] * len(locals_)
        for i, move in zip(stepping, found, strict=True):
            moves[i] = move
        return moves

    def linearise(self, weights: Sequence[Weights]) -> list[Local]:
        """Steps at several weights, from one call of the model."""
        rows = [np.vstack([self._member_weights(each), each.w]) for each in weights]
        whole = self.forecast(self.control(np.concatenate(rows)))
        ends = accumulate(len(r) for r in rows)
        runs = [whole[end - len(r) : end] for end, r in zip(ends, rows, strict=True)]
        return [self._local(at, run[:-1], run[-1:]) for at, run in zip(weights, runs, strict=True)]

    @property
    def needed_members(self) -> int:
        """The members that must survive for a regression on the control vector."""
        n_members, n = self.members.shape
        return max(math.ceil(self.settings.min_active_fraction * n_members), min(n + 1, n_members))

    def _member_weights(self, weights: Weights) -> Array:
        if self.economical:
            return np.asarray(weights.w + self._short * self.basis.T)
        return self.scheme.member_weights(weights)

    @property
    def _short(self) -> float:
        """Step along a unit direction of the weights that moves the state by ε prior standard deviations."""
        return self.settings.epsilon / math.sqrt(len(self.members) - 1)

    def _local(self, weights: Weights, members: Forecast, central: Forecast) -> Local:
        reduced = self.economical and bool(members.active.all())
        if self.economical and not reduced:
            members = self.forecast(self.control(self.scheme.member_weights(weights)))
        observation = float(self.observation_cost(central)[0])
        total = float(diag.background_cost(weights.w)) + observation
        active = len(self.members) if reduced else int(members.active.sum())
        if active < self.needed_members or not np.isfinite(total):
            return Local(weights, members, central, active, observation, total, None, None)
        reference, anomalies = self._linearisation(weights, members, central, reduced)
        at = _split(central, reference, anomalies)
        observations = self.problem.observations
        step = self.scheme.step(weights, Evaluation(*whiten(observations, at), self.basis))
        tangent = None
        if self.settings.linearisation == "bundle":
            tangent = Tangent(at.prediction, at.anomalies, precision_times(observations, at, at.anomalies), self.basis)
        return Local(weights, members, central, active, observation, total, step, tangent)

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
