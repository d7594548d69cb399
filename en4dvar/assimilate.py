"""The only loop: forecast → linearise → step → step control → record, then the posterior and its predictions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.errors import TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.forecast import NO_TIMES, Forecast, check_problem, cost, forecast, log_posterior
from en4dvar.likelihood import Linearisation, error_std, log_likelihood, observation_cost, whiten
from en4dvar.linalg import anomaly_basis, centre
from en4dvar.problem import Analysis, AssimilationSettings, InverseProblem, IterationRecord
from en4dvar.schemes import Evaluation, Scheme, Step, Weights
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.state import Array
from en4dvar.step_control import STEP_CONTROLS

__all__ = ["assimilate", "cost", "forecast", "log_posterior"]

GRID_POINTS = 200  # M, of the plotting grid
Progress = Callable[[str, IterationRecord], None]


def assimilate(
    problem: InverseProblem,
    settings: AssimilationSettings,
    seed: int,
    executor: Executor | None = None,
    progress: Progress | None = None,
    resume: LoopState | None = None,
    on_iteration: Callable[[LoopState], None] | None = None,
) -> Analysis:
    """Estimate the parameters of one data set.

    Parameters
    ----------
    seed: of the prior ensemble; the same seed gives the same bits for any executor.
    executor: where members run; default in this process.
    progress: called with the name of the data set and the record of each iteration.
    resume: where an earlier call with the same arguments was interrupted; the result has the same bits as without.
    on_iteration: called with the state that the next iteration starts from.

    Raises
    ------
    ConfigError: the problem is not complete. TooFewMembersError: too few members survive a forecast.
    """
    with one_blas_thread():
        return _Run(problem, settings, seed, executor or SerialExecutor(), progress, on_iteration).analysis(resume)


@dataclass(frozen=True)
class LoopState:
    """All that the rest of the iterations depends on, besides the problem, the settings and the seed.

    ``worst_loss`` (N,) reasons of failure in the iteration that lost most members, or empty.
    """

    weights: Weights
    forward_runs: int
    warnings: tuple[str, ...] = ()
    records: tuple[IterationRecord, ...] = ()
    worst_loss: tuple[str, ...] = ()
    stop_reason: str = ""
    converged: bool = False


@dataclass(frozen=True)
class _Outcome:
    """Where the iterations ended."""

    weights: Weights
    step: Step
    cost: float
    converged: bool
    reason: str
    records: tuple[IterationRecord, ...]
    warnings: tuple[str, ...]


class _Run:
    """One data set seen from weight space: x = x̄0 + X0ᵀw."""

    def __init__(
        self,
        problem: InverseProblem,
        settings: AssimilationSettings,
        seed: int,
        executor: Executor,
        progress: Progress | None,
        on_iteration: Callable[[LoopState], None] | None,
    ):
        self.fixed_parameters = check_problem(problem)
        self.problem, self.settings, self.seed = problem, settings, seed
        self.executor, self.progress, self.on_iteration = executor, progress, on_iteration
        self.scheme: Scheme = En4DVar(settings.linearisation, settings.epsilon)
        self.search = STEP_CONTROLS[settings.step_control]
        self.members = problem.prior.sample(settings.members, seed, settings.sampling)
        self.mean, self.anomalies = centre(self.members)
        self.basis = anomaly_basis(self.anomalies)
        self.forward_runs = 0

    def control(self, w: Array) -> Array:
        """Control vectors (…, n) of weights (…, N)."""
        return np.asarray(self.mean + w @ self.anomalies)

    def forecast(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        self.forward_runs += len(x)
        return forecast(self.problem, x, self.executor, extra_times)

    def cost_of(self, w: Array) -> Array:
        """J (B,) of central trajectories at weights (B, N)."""
        return diag.background_cost(w) + self.observation_cost(self.forecast(self.control(w)))

    def observation_cost(self, run: Forecast) -> Array:
        return observation_cost(self.problem.observations, run.predictions, run.rates)

    def analysis(self, resume: LoopState | None) -> Analysis:
        problem, observations = self.problem, self.problem.observations
        grid = np.linspace(observations.times[0], observations.times[-1], GRID_POINTS)
        prior_run = self.forecast(np.vstack([self.members, self.mean]), grid)
        self.require_members(prior_run[:-1], "prior forecast")
        state = resume or self.start(prior_run)
        self.forward_runs = state.forward_runs
        end = self.iterate(state)

        posterior = self.control(end.weights.w + end.step.transform)
        mode = self.control(end.weights.w)
        final = self.forecast(np.vstack([posterior, mode]), grid)
        after, last = final[:-1], final[-1:]
        centre_rates = None if last.rates is None else last.rates[0]
        per_parameter = diag.dfs_per_parameter(self.members, posterior)
        record = end.records[-1]
        used = int(np.sum(observations.weights > 0))
        prior = problem.prior
        return Analysis(
            name=observations.name,
            parameters=prior.parameters,
            fixed=problem.fixed,
            fixed_parameters=self.fixed_parameters,
            observable=problem.observable,
            observations=observations,
            time_unit=problem.model.time_unit,
            time_display_unit=problem.model.time_display_unit,
            prior=prior.to_physical(self.members),
            posterior=prior.to_physical(posterior),
            centre=prior.to_physical(mode),
            prior_predictions=prior_run.predictions[:-1],
            posterior_predictions=after.predictions,
            centre_predictions=last.predictions[0],
            error_std=error_std(observations, centre_rates),
            log_likelihood=log_likelihood(observations, after.predictions, after.rates),
            trajectory_times=grid,
            prior_trajectories=prior_run.path[:-1],
            posterior_trajectories=after.path,
            prior_failures=prior_run.failures[:-1],
            posterior_failures=after.failures,
            iterations=end.records,
            dfs_per_parameter=per_parameter,
            converged=end.converged,
            stop_reason=end.reason,
            forward_runs=self.forward_runs,
            seed=self.seed,
            settings=self.settings,
            log_evidence=diag.log_evidence(end.cost, end.step.hessian.singular_values, len(self.members), observations),
            warnings=(
                *state.warnings,
                *(() if end.converged else (f"not converged: {end.reason}",)),
                *diag.loss_warning("prior forecast", prior_run.failures[:-1]),
                *end.warnings,
                *diag.loss_warning("posterior forecast", after.failures),
                *diag.fit_warnings(record.chi2_per_observation * used, used, record.dfs),
                *diag.conflict_warnings(prior.names, mode, prior.mean, prior.std),
                *diag.information_warnings(prior.names, per_parameter),
            ),
        )

    def start(self, run: Forecast) -> LoopState:
        """Where to start from: one of the prior members or (last row of ``run``) their mean."""
        # e_i moved to the minimum-norm weights of the same member, so that J_b is ½‖x − x̄0‖² in the prior covariance
        candidates = np.vstack([self.basis @ self.basis.T, np.zeros(len(self.members))])
        costs = diag.background_cost(candidates) + self.observation_cost(run)
        start = candidates[int(np.argmin(costs))]
        warnings: tuple[str, ...] = ()
        if self.settings.start == "prior-mean":
            if np.isfinite(costs[-1]):
                start = candidates[-1]
            else:
                warnings = (f"the prior mean cannot be run ({run.failures[-1]}); started from the best prior member",)
        return LoopState(Weights(start, self.scheme.init(len(start)).T), self.forward_runs, warnings)

    def iterate(self, state: LoopState) -> _Outcome:
        settings, scheme = self.settings, self.scheme
        weights, records, worst_loss = state.weights, list(state.records), state.worst_loss
        stop, converged = state.stop_reason, state.converged
        while True:
            if self.on_iteration is not None:
                self.on_iteration(
                    LoopState(weights, self.forward_runs, state.warnings, tuple(records), worst_loss, stop, converged)
                )
            run = self.forecast(self.control(np.vstack([scheme.member_weights(weights), weights.w])))
            members, central = run[:-1], run[-1:]
            self.require_members(members, f"forecast of iteration {len(records) + 1}")
            worst_loss = max(worst_loss, members.failures, key=lambda failures: sum(map(bool, failures)))
            step = scheme.step(weights, self.evaluate(weights, members, central))
            observation = float(self.observation_cost(central)[0])
            total = float(diag.background_cost(weights.w)) + observation

            move, contracted = None, Weights(weights.w, step.transform)
            if not stop:
                if step.norm <= settings.step_tolerance:
                    stop, converged = f"step of {step.norm:.2g} posterior standard deviations", True
                elif len(records) == settings.max_iterations:
                    stop = f"iteration limit ({settings.max_iterations}) reached"
                else:
                    move = self.search(weights.w, total, step, self.cost_of)
                    if move is None and self.same_members(contracted, weights):
                        stop = "no decrease possible along the step"
                        converged = step.predicted_decrease <= self.small(total)
            step_length = move.step_length if move else 0.0
            records.append(self.record(len(records), weights, step, observation, central, members, step_length))
            if self.progress is not None:
                self.progress(self.problem.observations.name, records[-1])
            if stop:
                warnings = diag.loss_warning("iterations", worst_loss)
                return _Outcome(weights, step, total, converged, stop, tuple(records), warnings)
            if move is None:  # a regression over a narrower ensemble may still show the way down
                weights = contracted
                continue
            if total - move.cost <= self.small(total) and step.predicted_decrease <= self.small(total):
                # one more forecast, to linearise at the end point
                stop, converged = f"relative decrease of J below {settings.cost_tolerance:g}", True
            weights = Weights(move.w, step.transform)

    def same_members(self, a: Weights, b: Weights) -> bool:
        """Whether the scheme would run the same members again, to the step tolerance."""
        difference = self.scheme.member_weights(a) - self.scheme.member_weights(b)
        return bool(np.max(np.abs(difference)) <= self.settings.step_tolerance)

    def small(self, total: float) -> float:
        """A decrease of J that counts as none; below J = 1 it is absolute, for there J has no more to tell."""
        return self.settings.cost_tolerance * max(total, 1.0)

    def evaluate(self, weights: Weights, members: Forecast, central: Forecast) -> Evaluation:
        """Linearise predictions (and rates) about the centre and whiten."""
        k = members.predictions.shape[1]
        stacked = [
            np.hstack([f.predictions] if f.rates is None else [f.predictions, f.rates]) for f in (members, central)
        ]
        reference, anomalies = self.scheme.linearise(weights, self.basis, stacked[0], stacked[1][0], members.active)
        at = Linearisation(reference[:k], anomalies[:, :k])
        if members.rates is not None:
            at = Linearisation(reference[:k], anomalies[:, :k], reference[k:], anomalies[:, k:])
        return Evaluation(*whiten(self.problem.observations, at))

    def record(
        self,
        iteration: int,
        weights: Weights,
        step: Step,
        observation: float,
        central: Forecast,
        members: Forecast,
        step_length: float,
    ) -> IterationRecord:
        background = float(diag.background_cost(weights.w))
        ensemble = self.control(weights.w + step.transform)
        rates = None if central.rates is None else central.rates[0]
        return IterationRecord(
            iteration=iteration,
            cost=background + observation,
            background=background,
            observation=observation,
            step_norm=step.norm,
            step_length=step_length,
            chi2_per_observation=diag.chi2_per_observation(self.problem.observations, central.predictions[0], rates),
            dfs=diag.dfs(step.hessian.singular_values, len(weights.w)),
            spread=diag.spread(ensemble, self.members),
            active=int(members.active.sum()),
            members=self.problem.prior.to_physical(ensemble),
            centre=self.problem.prior.to_physical(self.control(weights.w)),
        )

    def require_members(self, run: Forecast, stage: str) -> None:
        """Raise unless enough members are active for a regression on the control vector."""
        n_members, n = self.members.shape
        needed = max(math.ceil(self.settings.min_active_fraction * n_members), min(n + 1, n_members))
        active = int(run.active.sum())
        if active < needed:
            raise TooFewMembersError(
                f"{self.problem.observations.name}: {n_members - active} of {n_members} members failed in the {stage}; "
                f"at least {needed} must survive. Most frequent reasons: {diag.common_reasons(run.failures)}"
            )
