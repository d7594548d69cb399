"""The only loop: forecast → linearise → step → step control → record, then the posterior and its predictions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.analysis import Analysis, IterationRecord, Progress, Record
from en4dvar.caution import Caution, caution
from en4dvar.descent.mda import assimilate_once
from en4dvar.descent.noise_scale import mean_beyond_mode
from en4dvar.descent.record import Taken, make_records, worse
from en4dvar.descent.start import Comparison, choose_start
from en4dvar.descent.weight_space import Local, WeightSpace
from en4dvar.ensemble.forecast import Forecast, check_problem, cost, forecast, log_posterior
from en4dvar.errors import ConfigError, TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.honesty import ControlEnsembles, examine
from en4dvar.likelihood import error_std, log_likelihood, robust_weights, whitened_residual
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.sampling import mcmc
from en4dvar.sampling.shape import examine_shape, guide
from en4dvar.schemes import Step, Weights
from en4dvar.schemes.esmda import ESMDA
from en4dvar.state import Array

__all__ = ["assimilate", "cost", "forecast", "log_posterior"]

GRID_POINTS = 200  # M, of the plotting grid


def assimilate(
    problem: InverseProblem,
    settings: AssimilationSettings,
    seed: int,
    executor: Executor | None = None,
    progress: Progress | None = None,
    resume: LoopState | None = None,
    keep: Callable[[Callable[[], LoopState]], None] | None = None,
) -> Analysis:
    """Estimate the parameters of one data set.

    Parameters
    ----------
    seed: of the prior ensemble; the same seed gives the same bits for any executor.
    executor: where members run; default in this process.
    progress: called with the name of the data set and the record of each round of the start, each iteration and each
        look at the chain.
    resume: where an earlier call with the same arguments was interrupted; the result has the same bits as without.
    keep: called before each round of the start and each iteration, and at each look at the chain, with a function that
        gives the state to resume from.

    Raises
    ------
    ConfigError: the problem is not complete. TooFewMembersError: too few members survive a forecast.
    """
    with one_blas_thread():
        return _Run(problem, settings, seed, executor or SerialExecutor(), progress, keep).analysis(resume)


@dataclass(frozen=True)
class LoopState:
    """All that the rest of the iterations depends on, besides the problem, the settings and the seed.

    ``worst_loss`` (N,) reasons of failure in the iteration that lost most members, or empty. ``comparison`` is there
    until the start is chosen, ``refinement`` once the iterations are done and the Markov chain is under way.
    """

    weights: Weights
    forward_runs: int
    warnings: tuple[Caution, ...] = ()
    records: tuple[IterationRecord, ...] = ()
    worst_loss: tuple[str, ...] = ()
    stop_reason: str = ""
    converged: bool = False
    comparison: Comparison | None = None
    refinement: Refinement | None = None

    @property
    def reached(self) -> str:
        """How far it has got, in words."""
        if self.comparison is not None:
            return f"after {self.comparison.rounds} rounds of the start"
        return f"after {len(self.records)} iterations"


@dataclass(frozen=True)
class Refinement:
    """A Markov chain under way, and the forward runs up to there."""

    chain: mcmc.ChainState
    forward_runs: int


@dataclass(frozen=True)
class _Outcome:
    """Where the iterations ended."""

    weights: Weights
    transform: Array
    step: Step
    cost: float
    converged: bool
    reason: str
    records: tuple[IterationRecord, ...]
    worst_loss: tuple[str, ...]


class _Run:
    """One data set: prior forecast, start, iterations, posterior forecast."""

    def __init__(
        self,
        problem: InverseProblem,
        settings: AssimilationSettings,
        seed: int,
        executor: Executor,
        progress: Progress | None,
        keep: Callable[[Callable[[], LoopState]], None] | None,
    ):
        self.fixed_parameters = check_problem(problem)
        self.problem, self.settings, self.seed = problem, settings, seed
        self.progress, self.keep = progress, keep
        self.mda = ESMDA(settings.mda_coefficients, settings.mda_form) if settings.scheme == "es-mda" else None
        if self.mda and (problem.has_noise_scale or problem.observations.huber is not None):
            raise ConfigError("es-mda takes Gaussian errors of known std: neither sigma nor a robust cost; use en4dvar")
        if self.mda:  # step and J of its ensembles are regressed over them
            settings = replace(settings, linearisation="transform")
        self.space = WeightSpace(problem, settings, seed, executor)

    def analysis(self, resume: LoopState | None) -> Analysis:
        problem, observations = self.problem, self.problem.observations
        grid = np.linspace(observations.times[0], observations.times[-1], GRID_POINTS)
        space = self.space
        prior_run = space.forecast(np.vstack([space.members, space.mean]), grid)
        self.require_members(prior_run[:-1].failures, "prior forecast")
        state = self.start(prior_run, resume) if resume is None or resume.comparison else resume
        space.forward_runs = state.forward_runs
        end = self.assimilate_repeatedly(state, self.mda) if self.mda else self.iterate(state)

        both = space.control(np.vstack([end.weights.w + end.transform, end.weights.w]))
        posterior, mode = both[:-1], both[-1]
        dfs = diag.dfs(end.step.hessian.singular_values, len(space.members))
        posterior = posterior + mean_beyond_mode(problem, mode, posterior, dfs)
        posterior, refinement, refine_warnings = self.refine(posterior, state.refinement)
        ends = np.vstack([posterior, mode])
        final = space.forecast(ends, grid)
        after, last = final[:-1], final[-1:]
        self.require_members(after.failures, "posterior forecast")
        at_centre = (
            None if last.rates is None else last.rates[0],
            None if last.noise_scale is None else last.noise_scale[0],
        )
        costs = self.costs(ends, final)
        shape = {} if refinement else examine_shape(space, posterior, mode, costs[:-1], self.seed)
        prior = problem.prior
        analysis = Analysis(
            problem=problem,
            settings=self.settings,
            seed=self.seed,
            fixed_parameters=self.fixed_parameters,
            prior=prior.to_physical(space.members),
            posterior=prior.to_physical(posterior),
            centre=prior.to_physical(mode),
            prior_predictions=prior_run.predictions[:-1],
            posterior_predictions=after.predictions,
            centre_predictions=last.predictions[0],
            error_std=error_std(observations, *at_centre),
            log_likelihood=log_likelihood(observations, after.predictions, after.rates, after.noise_scale),
            trajectory_times=grid,
            prior_trajectories=prior_run.path[:-1],
            posterior_trajectories=after.path,
            prior_failures=prior_run.failures[:-1],
            posterior_failures=after.failures,
            iterations=end.records,
            dfs_per_parameter=diag.dfs_per_parameter(space.prior_variance, posterior),
            converged=end.converged,
            stop_reason=end.reason,
            forward_runs=space.forward_runs,
            shape=shape,
            huber_weight=self.robust_weights(last.predictions[0], *at_centre),
            refinement=refinement,
            log_evidence=diag.log_evidence(
                end.cost, end.step.hessian.singular_values, len(space.members), observations
            ),
            extremes=after.extremes,
        )
        control = ControlEnsembles(space.members, posterior, mode, costs[:-1], float(costs[-1]))
        found = (*state.warnings, *refine_warnings)
        return replace(analysis, cautions=examine(analysis, control, end.worst_loss, found))

    def start(self, prior_run: Forecast, resume: LoopState | None) -> LoopState:
        space, prior = self.space, Weights.prior(len(self.space.members))
        if self.mda:
            return LoopState(prior, space.forward_runs)
        if resume is not None:
            space.forward_runs = resume.forward_runs

        def keep(comparison: Callable[[], Comparison]) -> None:
            if self.keep is not None:
                self.keep(lambda: LoopState(prior, space.forward_runs, comparison=comparison()))

        start = choose_start(space, prior_run, resume.comparison if resume else None, keep, self.tell)
        history = start.history
        for record in history.records:
            self.tell(record)
        weights = Weights(start.w, history.transform)
        return LoopState(weights, space.forward_runs, start.warnings, history.records, history.worst_loss)

    def robust_weights(self, prediction: Array, rate: Array | None, scale: Array | None) -> Array | None:
        """Huber's weights (K,) at the centre; None with Gaussian errors."""
        observations = self.problem.observations
        if observations.huber is None:
            return None
        return robust_weights(observations, whitened_residual(observations, prediction, rate, scale))

    def costs(self, members: Array, run: Forecast) -> Array:
        """J (B,) of control vectors (B, n), from their forecast and the prior's own mean and covariance."""
        z = (members - self.problem.prior.mean) / self.problem.prior.std
        return np.asarray(0.5 * np.sum(z**2, axis=1) + self.space.observation_cost(run))

    def refine(
        self, posterior: Array, earlier: Refinement | None
    ) -> tuple[Array, dict[str, float], tuple[Caution, ...]]:
        """The posterior ensemble (N, n), the summary of the chain that replaced it, and warnings.

        ``earlier`` is where the chain was interrupted.
        """
        if self.settings.refine == "none":
            return posterior, {}, ()
        space = self.space

        def log_density(x: Array) -> Array:
            space.forward_runs += len(x)
            return log_posterior(self.problem, x, space.executor)

        def keep(chain: mcmc.ChainState) -> None:
            if self.keep is not None:
                self.keep(lambda: replace(self.latest, refinement=Refinement(chain, space.forward_runs)))

        emulated = guide(space, posterior, self.seed)  # made again after an interruption, from the same runs
        if earlier is not None:
            space.forward_runs = earlier.forward_runs
        resume = earlier.chain if earlier else None
        chain = mcmc.sample(
            log_density, posterior, self.seed, resume=resume, keep=keep, look=self.tell, emulated=emulated
        )
        warnings = () if chain.converged else (caution("chain-not-converged", chain.warning()),)
        return chain.thin(len(posterior), self.settings.sampling == "exact"), chain.summary(), warnings

    def iterate(self, state: LoopState) -> _Outcome:
        settings, space = self.settings, self.space
        weights, records, worst_loss = state.weights, list(state.records), state.worst_loss
        stop, converged = state.stop_reason, state.converged
        while True:
            if self.keep is not None:
                self.latest = replace(
                    state, weights=weights, forward_runs=space.forward_runs, records=tuple(records),
                    worst_loss=worst_loss, stop_reason=stop, converged=converged,
                )  # fmt: skip
                self.keep(lambda: self.latest)
            (at,) = space.linearise([weights])
            step, total = self.require_step(at, f"forecast of iteration {len(records) + 1}"), at.cost
            worst_loss = worse(worst_loss, at)

            move, contracted = None, Weights(weights.w, step.transform)
            if not stop:
                if step.norm <= settings.step_tolerance:
                    stop, converged = f"step of {step.norm:.2g} posterior standard deviations", True
                elif len(records) == settings.max_iterations:
                    stop = f"iteration limit ({settings.max_iterations}) reached"
                else:
                    (move,) = space.search([at])
                    if move is None and self.same_members(contracted, weights):
                        stop = "no decrease possible along the step"
                        converged = step.predicted_decrease <= self.small(total)
            taken = Taken(at, step, step.transform, move.step_length if move else 0.0)
            records += make_records(space, len(records), [taken])
            self.tell(records[-1])
            if stop:
                return _Outcome(weights, step.transform, step, total, converged, stop, tuple(records), worst_loss)
            if move is None:  # a regression over a narrower ensemble may still show the way down
                weights = contracted
                continue
            if total - move.cost <= self.small(total) and step.predicted_decrease <= self.small(total):
                # one more forecast, to linearise at the end point
                stop, converged = f"relative decrease of J below {settings.cost_tolerance:g}", True
            weights = Weights(move.w, step.transform)

    def assimilate_repeatedly(self, state: LoopState, scheme: ESMDA) -> _Outcome:
        """ES-MDA: every iteration is one of its assimilations; the last record is the end point."""
        space, count = self.space, len(scheme.coefficients)
        weights, records, worst_loss = state.weights, list(state.records), state.worst_loss
        while True:
            if self.keep is not None:
                self.latest = replace(
                    state, weights=weights, forward_runs=space.forward_runs, records=tuple(records),
                    worst_loss=worst_loss,
                )  # fmt: skip
                self.keep(lambda: self.latest)
            (at,) = space.linearise([weights])
            step = self.require_step(at, f"forecast of iteration {len(records) + 1}")
            worst_loss = worse(worst_loss, at)
            done = len(records) == count
            records += make_records(space, len(records), [Taken(at, step, weights.T, 0.0 if done else 1.0)])
            self.tell(records[-1])
            if done:
                ending = f"{count} assimilations"
                return _Outcome(weights, weights.T, step, at.cost, True, ending, tuple(records), worst_loss)
            weights = assimilate_once(space, at, scheme, len(records) - 1, self.seed)

    def same_members(self, a: Weights, b: Weights) -> bool:
        """Whether the scheme would run the same members again, to the step tolerance."""
        difference = self.space.scheme.member_weights(a) - self.space.scheme.member_weights(b)
        return bool(np.max(np.abs(difference)) <= self.settings.step_tolerance)

    def small(self, total: float) -> float:
        """A decrease of J that counts as none; below J = 1 it is absolute, for there J has no more to tell."""
        return self.settings.cost_tolerance * max(total, 1.0)

    def tell(self, record: Record) -> None:
        if self.progress is not None:
            self.progress(self.problem.observations.name, record)

    def require_step(self, at: Local, stage: str) -> Step:
        """The step from there, or an error where the members lost do not allow one."""
        if at.step is None:
            self.require_members(at.failures, stage)
            raise TooFewMembersError(f"{self.problem.observations.name}: the centre cannot be run in the {stage}")
        return at.step

    def require_members(self, failures: tuple[str, ...], stage: str) -> None:
        """Raise unless enough members are active for a regression on the control vector."""
        lost, needed = sum(1 for reason in failures if reason), self.space.needed_members
        if len(failures) - lost < needed:
            raise TooFewMembersError(
                f"{self.problem.observations.name}: {lost} of {len(failures)} members failed in the {stage}; "
                f"at least {needed} must survive. Most frequent reasons: {diag.common_reasons(failures)}"
            )
