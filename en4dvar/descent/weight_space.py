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
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast
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
    """What is known at weights: the runs it took, J_b and J_o at the centre, and the step from there.

    ``part`` of the runs ``whole``, shared with other places, belongs to this one: N members or r, then the centre.
    ``again`` are N members that were run because one of r failed. ``active`` counts the members that inform the step: N
    where r runs stand for all. Where too few do, ``linear``, the linearisation in coordinates of the basis, and
    ``step`` are None.
    """

    weights: Weights
    whole: Forecast
    part: slice
    again: Forecast | None
    active: int
    background: float
    observation: float
    linear: Linearisation | None
    step: Step | None

    @property
    def cost(self) -> float:
        """J = J_b + J_o."""
        return self.background + self.observation

    @property
    def members(self) -> Forecast:
        """The runs beside the centre, N of them or r."""
        return self.whole[self.part.start : self.part.stop - 1] if self.again is None else self.again

    @property
    def failures(self) -> tuple[str, ...]:
        """Of the runs beside the centre."""
        return self.whole.failures[self.part.start : self.part.stop - 1] if self.again is None else self.again.failures

    @property
    def central(self) -> Forecast:
        """The run of the centre."""
        return self.whole[self.part.stop - 1 : self.part.stop]


_Tangent = tuple[Array, Array]  # reference (Ky,) and anomalies (r, Ky) of what :func:`_stack` puts side by side
_Seen = tuple[Weights, Forecast, slice, Forecast | None, int, float, float, Linearisation | None]  # a Local, no step


@dataclass(frozen=True)
class PriorEnsemble:
    """Members E0 (N, n), transformed, their mean (n,), anomalies X0 (N, n), variance (n,) and basis (N, r) of X0."""

    members: Array
    mean: Array
    anomalies: Array
    variance: Array
    basis: Array

    @cached_property
    def at_members(self) -> Array:
        """Weights (N + 1, N) of the members and, last, of their mean.

        e_i is moved to the minimum-norm weights of the same member, so that J_b is ½‖x − x̄0‖² in the prior covariance.
        """
        weights = np.vstack([self.basis @ self.basis.T, np.zeros(len(self.members))])
        weights.flags.writeable = False
        return weights

    @cached_property
    def background_at_members(self) -> Array:
        """J_b (N + 1,) there."""
        return diag.background_cost(self.at_members)


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
        self.composite = Composite(problem, executor)
        self.scheme: Scheme = En4DVar(settings.linearisation, settings.epsilon)
        self.step_control = STEP_CONTROLS[settings.step_control]
        self.drawn = drawn = prior_ensemble(problem.prior, settings.members, seed, settings.sampling)
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
        return self.composite(x, extra_times)

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
        w = np.array([each.w for each in weights])
        rows = self._rows(weights, w)
        size = rows.shape[1]
        whole = self.forecast(self.control(rows.reshape(-1, rows.shape[2])))
        tangents = self._tangents(whole, size) if self.economical else [None] * len(weights)
        costs = zip(
            diag.background_cost(w).tolist(), self.observation_cost(whole[size - 1 :: size]).tolist(), strict=True
        )
        seen = [
            self._seen(at, whole, slice(size * i, size * (i + 1)), tangent, *cost)
            for i, (at, tangent, cost) in enumerate(zip(weights, tangents, costs, strict=True))
        ]
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

    def _rows(self, weights: Sequence[Weights], w: Array) -> Array:
        """Weights (B, M, N) to be run for linearisations at centres ``w`` (B, N), which come last of each M."""
        if self.economical:
            return np.asarray(w[:, None] + self._offsets)
        return np.array([[*self.scheme.member_weights(each), each.w] for each in weights])

    @cached_property
    def _offsets(self) -> Array:
        return np.array([*(self._short * self.basis.T), np.zeros(len(self.members))])

    @property
    def _short(self) -> float:
        """Step along a unit direction of the weights that moves the state by ε prior standard deviations."""
        return self.settings.epsilon / math.sqrt(len(self.members) - 1)

    def _tangents(self, whole: Forecast, size: int) -> list[_Tangent | None]:
        """From r runs and the centre, ``size`` together, for each place; None where one of the r failed."""
        outputs = _stack(whole)
        outputs = outputs.reshape(-1, size, outputs.shape[1])
        reference = outputs[:, -1]
        tangents: list[_Tangent | None] = list(
            zip(reference, (outputs[:, :-1] - reference[:, None]) / self._short, strict=True)
        )
        if any(whole.failures):
            for i in range(len(tangents)):
                if any(whole.failures[size * i : size * (i + 1) - 1]):
                    tangents[i] = None
        return tangents

    def _seen(
        self,
        weights: Weights,
        whole: Forecast,
        part: slice,
        tangent: _Tangent | None,
        background: float,
        observation: float,
    ) -> _Seen:
        active, again, runnable = len(self.members), None, math.isfinite(background + observation)
        if tangent is None:
            members, central = whole[part.start : part.stop - 1], whole[part.stop - 1 : part.stop]
            if self.economical:
                members = again = self.forecast(self.control(self.scheme.member_weights(weights)))
            active = int(members.active.sum())
            if active >= self.needed_members and runnable:
                tangent = self.scheme.linearise(
                    weights, self.basis, _stack(members), _stack(central)[0], members.active
                )
        linear = _split(whole, *tangent) if tangent is not None and runnable else None
        return weights, whole, part, again, active, background, observation, linear


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
