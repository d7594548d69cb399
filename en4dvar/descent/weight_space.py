"""One data set seen from weight space, x = x̄0 + X0ᵀw: its prior ensemble, forecasts and J."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from en4dvar.descent.step_control import Trials
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast, costs
from en4dvar.ensemble.linalg import FEW, Hessian, LowRank, anomaly_basis, centre, least_coordinates
from en4dvar.ensemble.missing import filled
from en4dvar.ensemble.tangent import check_derivatives, derivatives_of
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.plumbing.hints import listed
from en4dvar.priors.varying.model import clock
from en4dvar.problem import InverseProblem
from en4dvar.schemes.base import Minimiser, Weights
from en4dvar.schemes.settings import AssimilationSettings

NOT_READ: Array = np.empty((0, 0))
SHOWN = 3  # readings that a message names


class WeightSpace:
    """The ensemble of a problem, its model behind an executor, and the count of forward runs.

    ``members`` E0 (N, n), transformed, their ``mean`` (n,), ``anomalies`` X0 (N, n), ``prior_variance`` (n,) and the
    ``basis`` (N, r) of X0.
    """

    def __init__(self, problem: InverseProblem, settings: AssimilationSettings, seed: int, executor: Executor):
        self.problem, self.settings, self.scheme, self.executor = problem, settings, settings.own, executor
        self.seed = seed
        self.composite = Composite(problem, executor)
        self.derivatives = derivatives_of(problem, getattr(settings.own.minimiser, "linearisation", ""))
        self.members = problem.prior.sample(settings.members, seed, settings.sampling)
        self.mean, self.anomalies = centre(self.members)
        self.prior_variance, self.basis = self.members.var(axis=0), anomaly_basis(self.anomalies)
        self.forward_runs = 0

    @property
    def minimiser(self) -> Minimiser:
        assert self.scheme.minimiser is not None
        return self.scheme.minimiser

    @property
    def needed_members(self) -> int:
        """The members that must survive for a regression on the control vector."""
        n_members, n = self.members.shape
        return int(max(math.ceil(self.settings.min_active_fraction * n_members), min(n + 1, n_members)))

    def member_costs(self, run: Forecast) -> Array:
        """J (N + 1,) of the members and their mean, whose ``run`` is there."""
        weights = np.vstack([self.basis, np.zeros(self.basis.shape[1])])
        return diag.background_cost(weights, len(self.members)) + self.problem.observations.cost(run.predicted)

    @property
    def side_by_side(self) -> int:
        """Descents for which a linearisation of each costs no more than one bundle of N together."""
        return int(len(self.members) // (self.basis.shape[1] + 1))

    def affordable(self, run: Forecast) -> list[int]:
        """Members of lowest J, as many as go :attr:`side_by_side`; at least one. ``run``: see :meth:`member_costs`."""
        costs = self.member_costs(run)
        best = np.argsort(costs, kind="stable").tolist()
        count = self.side_by_side if self.minimiser.economical(self.basis) else 1
        return [i for i in best[:count] if np.isfinite(costs[i])] or best[:1]

    def control(self, w: Array) -> Array:
        """Control vectors (…, n) of weights (…, N)."""
        return np.asarray(self.mean + w @ self.anomalies)

    def weights_of(self, x: Array) -> Array:
        """The shortest weights (…, N) of control vectors (…, n) that the anomalies reach."""
        return least_coordinates(self.anomalies, x - self.mean)

    def ensemble(self, w: Array, transform: Array | LowRank) -> Array:
        """Control vectors (N + 1, n) of the members w + T_i of a transform T and, last, of w (N,)."""
        if isinstance(transform, LowRank):
            middle = self.control(w)
            return np.vstack([middle + transform @ self.anomalies, middle])
        return self.control(np.vstack([w + transform, w]))

    def weights_at(self, w: Array, hessian: Hessian | None = None) -> Weights:
        """Weights of a descent at w (N,), with the transform of the prior, or of the Hessian where it comes from.

        Few members take it along in any case; of many, only a regression over the ensemble asks for it.
        """
        if len(self.members) > FEW and not (self.scheme.minimiser and self.scheme.minimiser.regresses):
            return Weights(w, NOT_READ)
        return Weights(w, np.eye(len(w)) if hessian is None else hessian.transform)

    def forecast(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        self.forward_runs += len(x)
        return self.composite(x, extra_times)

    def whole(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        """The forecast of an ensemble, with the readings that some of its members lack by regression on the others."""
        return filled(self.forecast(x, extra_times), x)

    def about(self, x: Array, counts: Sequence[int]) -> list[Forecast]:
        """Of several sets of members, one after the other (B, n), so many in each with their centre the last: by the
        model's derivatives, of which one call counts as a run, or all of them in one forecast.
        """
        parts = [slice(end - count, end) for end, count in zip(np.cumsum(counts).tolist(), counts, strict=True)]
        if self.derivatives:
            self.forward_runs += len(parts)
            return [self.derivatives(x[part]) for part in parts]
        whole = self.forecast(x)
        return [whole[part] for part in parts]

    def check_derivatives(self, prior_run: Forecast) -> None:
        """At the prior mean, or at the first member of its forecast that is alive. Raises :class:`ConfigError`."""
        alive = np.flatnonzero(np.roll(prior_run.active, 1))
        if self.derivatives and len(alive):
            at = np.vstack([self.mean, self.members])[alive[0]]
            self.forward_runs += 1
            check_derivatives(self.problem, self.derivatives, at, self.forecast)

    def costs(self, x: Array, run: Forecast) -> Array:
        """J (B,) of control vectors (B, n), from their forecast and the prior's own mean and covariance."""
        return costs(self.problem, x, run)

    def with_sampled_prior(self, x: Array, costs: Array) -> Array:
        """J (B,) of control vectors (B, n) with the prior's mean and covariance of the members, from ``costs``."""
        along = self.basis.T @ self.anomalies  # weights of all x would be a square of the members
        coordinates = least_coordinates(along, x - self.mean)
        return costs - self.problem.prior.cost(x) + diag.background_cost(coordinates, len(self.members))

    def try_out(self, w: Array, expected: Callable[[Array], Array] | None = None) -> Trials:
        """J and predictions of central trajectories at weights (B, N).

        A reading that one lacks is taken as ``expected``: weights → (B, Ky) as ``Predicted.stacked``.
        """
        run = self.forecast(self.control(w))
        if expected and (partial := run.partial).any():
            stacked = run.predicted.stacked
            stacked = np.where(partial[:, None] & np.isnan(stacked), expected(w), stacked)
            run = replace(run, predicted=run.predicted.unstacked(stacked))
        return Trials(diag.background_cost(w) + self.problem.observations.cost(run.predicted), run.predictions)

    def require_members(self, run: Forecast, stage: str) -> None:
        """Raise :class:`TooFewMembersError` unless enough members are active for a regression on the control vector."""
        require_members(self.problem, run, self.needed_members, stage)


def require_members(problem: InverseProblem, run: Forecast, needed: int, stage: str) -> None:
    """Raise :class:`TooFewMembersError` where fewer than ``needed`` members survive a forecast."""
    lost = sum(map(bool, run.failures))
    if len(run) - lost < needed:
        raise TooFewMembersError(
            f"{problem.observations.name}: {lost} of {len(run)} members failed in the {stage}; at least {needed} "
            f"must survive. Most frequent reasons: {diag.common_reasons(run.failures)}{_lacking(problem, run.lacking)}"
        )


def _lacking(problem: InverseProblem, readings: Sequence[int]) -> str:
    if not readings:
        return ""
    times, told = problem.observations.file_times, []
    for k in readings:
        part = next(part for part in problem.parts if k < part.end)
        told.append(f"reading {k - part.begin + 1} of {part.name} (at {clock(problem.model, times[k])})")
    return (
        f". Too few of them, if any, have a number for {listed(told, SHOWN, longest=100)}: leave such readings out (an "
        "empty cell of the table, NaN in Python), or narrow the priors to where the model has one"
    )
