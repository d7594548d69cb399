"""One data set seen from weight space, x = x̄0 + X0ᵀw: its prior ensemble, forecasts and J."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.descent.step_control import Trials
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast
from en4dvar.ensemble.linalg import anomaly_basis, centre
from en4dvar.ensemble.repeat import check_repeats
from en4dvar.errors import TooFewMembersError
from en4dvar.executor import Executor
from en4dvar.prior import Prior, Sampling
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.state import Array


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
        self.drawn = drawn = prior_ensemble(problem.prior, settings.members, seed, settings.sampling)
        self.members, self.mean, self.anomalies = drawn.members, drawn.mean, drawn.anomalies
        self.prior_variance, self.basis = drawn.variance, drawn.basis
        self.forward_runs = 0

    @property
    def needed_members(self) -> int:
        """The members that must survive for a regression on the control vector."""
        n_members, n = self.members.shape
        return max(math.ceil(self.settings.min_active_fraction * n_members), min(n + 1, n_members))

    def control(self, w: Array) -> Array:
        """Control vectors (…, n) of weights (…, N)."""
        return np.asarray(self.mean + w @ self.anomalies)

    def forecast(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        self.forward_runs += len(x)
        return self.composite(x, extra_times)

    def check_repeats(self, prior_run: Forecast, extra_times: Array) -> None:
        """Run two members of the prior forecast again, at the same instants; ``forward_runs`` does not count them.

        Raises :class:`ConfigError`: they give other predictions.
        """

        def again(members: list[int]) -> tuple[Array, tuple[str, ...]]:
            run = self.composite(self.members[members], extra_times)
            return run.predictions, run.failures

        alive = prior_run[: len(self.members)]
        check_repeats(self.problem.model, alive.predictions, alive.failures, again, self.problem.observations.name)

    def observation_cost(self, run: Forecast) -> Array:
        """J_o (B,)."""
        return self.problem.observations.cost(run.predicted)

    def try_out(self, w: Array) -> Trials:
        """J and predictions of central trajectories at weights (B, N)."""
        run = self.forecast(self.control(w))
        return Trials(diag.background_cost(w) + self.observation_cost(run), run.predictions)

    def require_members(self, failures: tuple[str, ...], stage: str) -> None:
        """Raise :class:`TooFewMembersError` unless enough members are active for a regression on the control vector."""
        lost, needed = sum(1 for reason in failures if reason), self.needed_members
        if len(failures) - lost < needed:
            raise TooFewMembersError(
                f"{self.problem.observations.name}: {lost} of {len(failures)} members failed in the {stage}; "
                f"at least {needed} must survive. Most frequent reasons: {diag.common_reasons(failures)}"
            )
