"""One data set from its prior ensemble to the posterior and its predictions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from en4dvar import diagnostics as diag
from en4dvar.analysis import Analysis, Descents, Discrepancy, Mode, Progress, Record
from en4dvar.caution import Caution, caution
from en4dvar.descent.loop import iterate
from en4dvar.descent.marginal import marginal_members
from en4dvar.descent.minima import Minimum, merged
from en4dvar.descent.noise_scale import mean_beyond_mode
from en4dvar.descent.search import Found, Search, SearchState
from en4dvar.descent.start import StartState, choose_start
from en4dvar.descent.variance import shares_of_variance
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.ensemble.forecast import Forecast, check_problem, cost, forecast, log_posterior
from en4dvar.errors import ConfigError, TooFewMembersError
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.honesty import ControlEnsembles, examine
from en4dvar.influence import Influence
from en4dvar.noise import Predicted
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.residuals import Residuals
from en4dvar.response.ledger import ledger
from en4dvar.response.linear import LinearResponse
from en4dvar.response.what_if import what_if
from en4dvar.sampling import mcmc
from en4dvar.sampling.refine import Refined, in_doubt, mode_cautions, refined, samples, that_count
from en4dvar.sampling.shape import CLEARED, examine_shape
from en4dvar.schemes import window_scheme
from en4dvar.schemes.base import Weights
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.state import Array

__all__ = ["assimilate", "cost", "forecast", "log_posterior"]

GRID_POINTS = 200  # M, of the plotting grid


@dataclass(frozen=True)
class Ends:
    """An ensemble (N, n), transformed, about the ``mode`` (n,) of J, and what came of running both."""

    members: Array
    mode: Array
    run: Forecast
    central: Forecast


@dataclass(frozen=True)
class Refinement:
    """A Markov chain under way, and the forward runs up to there."""

    chain: mcmc.ChainState
    forward_runs: int


@dataclass(frozen=True)
class LoopState:
    """All that the rest of an assimilation depends on, besides the problem, the settings and the seed.

    ``comparison`` is there until the start is chosen; ``descent``, the other ``minima`` that descents ended in and from
    which members these started (``tried``) from then on; ``search`` while further descents look for another minimum,
    ``refinement`` once the Markov chain is under way.
    """

    forward_runs: int
    comparison: StartState | None = None
    descent: Descent | None = None
    minima: tuple[Minimum, ...] = ()
    tried: tuple[int, ...] = ()
    warnings: tuple[Caution, ...] = ()
    search: SearchState | None = None
    refinement: Refinement | None = None

    @property
    def reached(self) -> str:
        """How far it has got, in words."""
        if self.comparison is not None:
            return f"after {self.comparison.rounds} rounds of the start"
        return f"after {self.descent.iteration if self.descent else 0} iterations"


Keep = Callable[[Callable[[], LoopState]], None]


def assimilate(
    problem: InverseProblem,
    settings: AssimilationSettings,
    seed: int,
    executor: Executor | None = None,
    progress: Progress | None = None,
    resume: LoopState | None = None,
    keep: Keep | None = None,
) -> Analysis:
    """Estimate the parameters of one data set.

    Parameters
    ----------
    seed: of every random number; the same seed gives the same bits for any executor. In a run it is
        :func:`~en4dvar.prior.own_seed` of the run's seed and the data set's name.
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
        return _Assimilation(problem, settings, seed, executor or SerialExecutor(), progress, keep).run(resume)


class _Assimilation:
    """One data set: prior forecast, start, iterations, refinement, posterior forecast."""

    def __init__(
        self,
        problem: InverseProblem,
        settings: AssimilationSettings,
        seed: int,
        executor: Executor,
        progress: Progress | None,
        keep: Keep | None,
    ):
        self.fixed_parameters = check_problem(problem)
        self.problem, self.settings, self.seed = problem, settings, seed
        self.progress, self._keep = progress, keep
        self.scheme = window_scheme(settings)
        robust = np.isfinite(problem.observations.noise.counts_within)
        estimated = any(p.name in problem.prior.names for p in problem.discrepancy)
        if not self.scheme.searches and (problem.has_noise_scale or robust or estimated):
            raise ConfigError(
                f"{settings.scheme} takes Gaussian errors of known covariance: neither sigma nor a robust cost nor a "
                "discrepancy; use en4dvar"
            )
        self.space = WeightSpace(problem, settings, seed, executor)
        self.grid = np.linspace(*problem.observations.span, GRID_POINTS)

    def run(self, resume: LoopState | None) -> Analysis:
        problem, space, noise = self.problem, self.space, self.problem.observations.noise
        prior_run, start, descent = self.descend(resume)

        found, gaussian = self.searched(start, descent, prior_run)
        descent, counting = found.descent, that_count(found.minima, problem.prior)
        agree = len(found.tried) < 2 or found.agreed
        descents = self.descents(found)
        ends, sampled, shape = self.sampled(gaussian, counting, agree, start.refinement)
        posterior, mode, after, last = ends.members, ends.mode, ends.run, ends.central
        space.require_members(after.failures, "posterior forecast")
        costs = self.costs(posterior, after)
        centre_cost = float(self.costs(mode[None], last)[0])
        log_evidence_constant, prior = self.log_evidence_constant(), problem.prior
        observations = problem.observations
        response, std = self.response(descent, mode, last), posterior.std(axis=0, ddof=1)
        shifts = what_if(problem, response, std, centre_cost, space.executor) if self.settings.what_if else ()
        path = ledger(problem, response, std) if self.settings.what_if else None
        space.forward_runs += sum(shift.runs for shift in shifts) + (path.runs if path else 0)
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
            error_std=noise.total_std(last.predicted[0]),
            log_likelihood=observations.log_likelihood(after.predicted),
            trajectory_times=self.grid,
            prior_trajectories=prior_run.path[:-1],
            posterior_trajectories=after.path,
            prior_failures=prior_run.failures[:-1],
            posterior_failures=after.failures,
            iterations=descent.records,
            dfs_per_parameter=diag.dfs_per_parameter(space.prior_variance, posterior),
            converged=descent.converged,
            stop_reason=descent.stop,
            forward_runs=space.forward_runs,
            shape=shape,
            down_weights=observations.noise.down_weights(observations.values, last.predicted[0]),
            refinement=sampled.summary if sampled else {},
            log_evidence=self.log_evidence(descent, sampled),
            modes=self.modes(counting, sampled),
            log_evidence_constant=log_evidence_constant,
            extremes=after.extremes,
            beyond=after.beyond,
            residuals=self.residuals(descent),
            discrepancy=self.discrepancy(descent, last.predicted[0]),
            influence=self.influence(after, posterior, response, gaussian=sampled is None),
            descents=descents,
            what_if=shifts,
            ledger=path,
        )
        control = ControlEnsembles(space.members, posterior, mode, costs, centre_cost)
        cautions = (*start.warnings, *(sampled.warnings if sampled else ()))
        if len(found.tried) == 1:
            cautions = (*cautions, caution("one-descent", "one descent only: another minimum is not excluded"))
        if counting:
            weights = np.array([mode.weight for mode in analysis.modes])
            cautions = (*cautions, *mode_cautions(prior, counting, weights, agree, sampled))
        return replace(analysis, cautions=examine(analysis, control, descent.worst_loss, cautions))

    def descend(self, resume: LoopState | None = None) -> tuple[Forecast, LoopState, Descent]:
        """The prior forecast, where the iterations started, and their end."""
        space = self.space
        prior_run = space.forecast(np.vstack([space.members, space.mean]), self.grid)
        space.require_members(prior_run[:-1].failures, "prior forecast")
        if not self.settings.stochastic_model:
            space.check_repeats(prior_run, self.grid)
        start = self.start(prior_run, resume) if resume is None or resume.descent is None else resume
        return prior_run, start, self.iterate(start, prior_run)

    def log_evidence(self, descent: Descent, sampled: Refined | None = None) -> float:
        """ln p(y), by the draws where the posterior was sampled and they are enough, else by Laplace."""
        values, observations = descent.newton.hessian.singular_values, self.problem.observations
        if sampled and np.isfinite(sampled.log_evidence):
            return sampled.log_evidence - observations.log_normalisation()
        return diag.log_evidence(descent.iterate.cost, values, len(self.space.members), observations)

    def log_evidence_constant(self) -> float | None:
        """ln p(y) with constant parameters, NaN where these lose the ensemble; None where none varies.

        It is that of an assimilation of its own, searched and, in doubt, sampled like this one. The posterior at zero
        changes (Savage & Dickey) would spare the runs, but extrapolates the quadratic form of J from one minimum to the
        other, which may be far away.
        """
        if not self.problem.varying:
            return None
        settings = replace(self.settings, what_if=False)
        other = _Assimilation(self.problem.constant, settings, self.seed, self.space.executor, None, None)
        try:
            return other.run(None).log_evidence
        except TooFewMembersError:
            return np.nan
        finally:
            self.space.forward_runs += other.space.forward_runs

    def residuals(self, descent: Descent) -> Residuals | None:
        """Of the linearisation at the end."""
        observations, linear = self.problem.observations, descent.iterate.linear
        if linear is None:
            return None
        at = linear.prediction
        speed = np.abs(self.rates(at))
        white, sensitivity = observations.whiten(linear)
        if observations.parts:
            speed = speed / observations.std
        precision = len(self.space.members) - 1
        return Residuals.of(white, sensitivity, precision, speed, observations.used, self.in_a_row())

    def in_a_row(self) -> npt.NDArray[np.intp]:
        """(K,) a label for each series; for each reading, where it has several places."""
        labels = np.arange(len(self.problem.observations))
        for part in self.problem.parts:
            if part.has_path:
                labels[part.where] = part.begin
        return labels

    def rates(self, at: Predicted) -> Array:
        """How fast each observable changes at its readings (K,), by differences where the model does not say; zero of
        a series with several places, or fewer than two readings."""
        if at.rates is not None:
            return at.rates
        rates = np.zeros_like(at.values)
        for part in self.problem.parts:
            if part.has_path and part.end - part.begin > 1:
                rates[part.where] = np.gradient(at.values[part.where], self.problem.observations.times[part.where])
        return rates

    def influence(self, run: Forecast, members: Array, response: LinearResponse, gaussian: bool) -> Influence | None:
        """Of each reading on the posterior ``members`` (N, n), whose ``run`` it is; None where it cannot be told.

        ``gaussian``: they are draws of the Gaussian about the mode.
        """
        observations, prior = self.problem.observations, self.problem.prior
        conditional = observations.log_conditional(run.predicted)
        if conditional is None:
            return None
        alive = diag.active_members(run.failures) & np.isfinite(conditional).all(axis=1)
        if alive.sum() < members.shape[1] + 2:
            return None
        if gaussian and observations.noise.independent and response.defined:
            return Influence.by_tangent(prior, members[alive], response.tangent(members[alive]))
        ratios = -observations.weights * conditional[alive]
        return Influence.by_weights(prior.to_physical(members[alive]), ratios)

    def discrepancy(self, descent: Descent, central: Predicted) -> Discrepancy | None:
        """Of the model, where the observations allow for one."""
        observations, linear = self.problem.observations, descent.iterate.linear
        explained = observations.noise.explained(observations.values, central)
        if explained is None or linear is None:
            return None
        return Discrepancy(*explained, shares_of_variance(self.space, linear))

    def start(self, prior_run: Forecast, resume: LoopState | None) -> LoopState:
        """The state from which the iterations go on."""
        space = self.space
        if not isinstance(self.scheme, En4DVar):
            return LoopState(space.forward_runs, descent=Descent(Weights.prior(len(space.members))))
        if resume is not None:
            space.forward_runs = resume.forward_runs

        def keep(comparison: Callable[[], StartState]) -> None:
            self.keep(lambda: LoopState(space.forward_runs, comparison()))

        before = resume.comparison if resume else None
        begun = choose_start(space, self.scheme, prior_run, self.seed, before, keep, self.tell)
        for record in begun.descent.records:
            self.tell(record)
        return LoopState(space.forward_runs, None, begun.descent, begun.minima, begun.tried, begun.warnings)

    def iterate(self, state: LoopState, prior_run: Forecast) -> Descent:
        """The end of the iterations."""
        space = self.space
        space.forward_runs = state.forward_runs
        assert state.descent is not None
        descent = state.descent.kept

        def keep() -> None:
            kept = replace(state, forward_runs=space.forward_runs, descent=descent.kept)
            self.latest = kept
            self.keep(lambda: kept)

        window = DataWindow(space, self.seed, keep, self.tell, prior_run, self.grid)
        iterate(window, self.scheme, [descent])
        return descent

    def gaussian(self, descent: Descent) -> Ends:
        """The ensemble at the end of a descent, and its forecast."""
        space, problem = self.space, self.problem
        transform = descent.newton.hessian.economical_transform if self.scheme.searches else descent.weights.T
        ends = space.ensemble(descent.weights.w, transform)
        members, mode = ends[:-1], ends[-1]
        members = members + mean_beyond_mode(problem, mode, members, descent.records[-1].dfs)
        if not self.scheme.searches:  # the last ensemble that was run is the posterior
            return Ends(members, mode, descent.iterate.members, descent.iterate.central)
        if problem.discrepancy and descent.iterate.linear is not None:
            members = marginal_members(space, descent.iterate.linear, mode, members, self.seed)
        final = space.forecast(np.vstack([members, mode]), self.grid)
        return Ends(members, mode, final[:-1], final[-1:])

    def searched(self, start: LoopState, descent: Descent, prior_run: Forecast) -> tuple[Found, Ends]:
        """All minima, the lowest descent, and the ensemble about it.

        After the first descents one from a member far from the minimum looks for another. Of a cheap model, or for a
        chain, many are tried where there is one or where J of the posterior members is not that of a Gaussian; else
        some, where the lowest minimum is that of one descent alone.
        """
        space, scheme, before = self.space, self.scheme, self.latest.descent
        assert before is not None
        if not isinstance(scheme, En4DVar):
            return Found(descent, before, (), ()), self.gaussian(descent)
        begun, minima = start.search or SearchState(), start.minima
        if start.search is None:
            minima = merged([Minimum.of(space, descent), *minima])
        found = Found(descent, before, minima, start.tried, begun.runs)
        if self.settings.starts < 2 or not scheme.economical(space.basis):
            return found, self.gaussian(descent)
        if start.search is not None:
            space.forward_runs = start.forward_runs
        search = Search(space, scheme, prior_run, self.seed, begun, self.keep_search, self.tell)
        found = search.challenged(found)
        if not (self.settings.refine == "mcmc" or samples(space)):
            found = search.settled(found)
            return found, self.gaussian(found.descent)
        ends = self.gaussian(found.descent)
        if begun.over > 1 and not begun.lower:
            space.forward_runs = start.forward_runs  # they were counted before the second round
        fit = diag.gaussianity(ends.members, ends.mode, self.costs(ends.members, ends.run))["gaussian_fit"]
        rest = search.rest(found)
        if rest and (len(found.minima) > 1 or not fit >= CLEARED):
            earlier, found = found, search.round(found, rest)
            ends = ends if found.descent is earlier.descent else self.gaussian(found.descent)
        return found, ends

    def keep_search(self, state: Callable[[], tuple[Found, SearchState]]) -> None:
        runs = self.space.forward_runs

        def kept() -> LoopState:
            found, search = state()
            return replace(
                self.latest,
                forward_runs=runs,
                descent=found.before,
                minima=found.minima,
                tried=found.tried,
                search=search,
            )

        self.latest = kept()
        self.keep(lambda: self.latest)

    def descents(self, found: Found) -> Descents | None:
        """Where they ended, which is told."""
        if not found.minima:
            return None
        ended = {member: number for number, minimum in enumerate(found.minima) for member in minimum.members}
        descents = Descents(
            members=tuple(i if i < len(self.space.members) else -1 for i in found.tried),
            minimum=tuple(ended.get(i, -1) for i in found.tried),
            costs=tuple(minimum.cost for minimum in found.minima),
            spread=found.minima[0].spread,
            runs=found.runs,
        )
        self.tell(descents)
        return descents

    def modes(self, minima: Sequence[Minimum], sampled: Refined | None) -> tuple[Mode, ...]:
        """The minima that count, with their weights; by Laplace where the posterior was not sampled."""
        prior = self.problem.prior
        logs = np.array([m.log_evidence(prior) - minima[0].log_evidence(prior) for m in minima[1:]])
        relative = np.append(1.0, np.exp(logs))[: len(minima)]
        weights = sampled.weights if sampled and minima else relative / relative.sum()
        return tuple(
            Mode(prior.to_physical(m.x), m.cost, m.descents, m.spread, float(weight))
            for m, weight in zip(minima, weights, strict=True)
        )

    def sampled(
        self, ends: Ends, minima: Sequence[Minimum], agree: bool, earlier: Refinement | None
    ) -> tuple[Ends, Refined | None, dict[str, float]]:
        """The ensemble, sampled where that is asked for or there is a doubt, and the shape of one that is not.

        ``agree``: descents from different members ended in the lowest of the minima that count.
        """
        space, shape = self.space, dict[str, float]()
        if self.settings.refine != "mcmc":
            shape = examine_shape(space, ends.members, ends.mode, self.costs(ends.members, ends.run), self.seed)
            if not (samples(space) and minima and in_doubt(minima, agree, shape)):
                return ends, None, shape
        sampled = self.refine(ends.members, minima, earlier)
        run = space.forecast(sampled.members, self.grid)
        central = ends.central if self.scheme.searches else space.forecast(ends.mode[None], self.grid)
        return Ends(sampled.members, ends.mode, run, central), sampled, {}

    def refine(self, posterior: Array, minima: Sequence[Minimum], earlier: Refinement | None) -> Refined:
        """What takes the place of the posterior ensemble (N, n). ``earlier``: where a chain was interrupted."""
        space = self.space

        def cost(x: Array) -> Array:
            return self.costs(x, space.forecast(x))

        def keep(state: mcmc.ChainState) -> None:
            self.keep(lambda: replace(self.latest, refinement=Refinement(state, space.forward_runs)))

        def resume() -> mcmc.ChainState | None:
            """What came before the chain is made again after an interruption, from the same runs."""
            if earlier is None:
                return None
            space.forward_runs = earlier.forward_runs
            return earlier.chain

        return refined(space, cost, posterior, minima, self.seed, resume=resume, keep=keep, look=self.tell)

    def response(self, descent: Descent, mode: Array, central: Forecast) -> LinearResponse:
        """How the mode (n,), whose run is ``central``, follows what it was inferred from."""
        space, linear = self.space, descent.iterate.linear
        assert linear is not None
        linear = replace(linear, prediction=central.predicted[0])
        directions = space.basis.T @ space.anomalies
        return LinearResponse(mode, linear, directions, len(space.members) - 1.0, self.problem.observations)

    def costs(self, members: Array, run: Forecast) -> Array:
        """J (B,) of control vectors (B, n), from their forecast and the prior's own mean and covariance."""
        z = (members - self.problem.prior.mean) / self.problem.prior.std
        return np.where(run.active, 0.5 * np.sum(z**2, axis=1) + self.space.observation_cost(run), np.inf)

    def keep(self, state: Callable[[], LoopState]) -> None:
        if self._keep is not None:
            self._keep(state)

    def tell(self, record: Record) -> None:
        if self.progress is not None:
            self.progress(self.problem.observations.name, record)
