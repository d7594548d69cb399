"""The stages of an assimilation: prior forecast, start, iterations, search for other minima, refinement.

Where one can be interrupted, and all that it needs to go on to the same bits, is a :class:`LoopState`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from en4dvar.descent.beyond_gaussian import bounded_members, marginal_members, mean_beyond_mode
from en4dvar.descent.loop import minimise
from en4dvar.descent.minima import Minimum, merged
from en4dvar.descent.search import Outcome, Search, SearchState, from_draw
from en4dvar.descent.start import StartState, choose_start
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import Progress, Record
from en4dvar.diagnosis.withheld import Withheld, predict_withheld
from en4dvar.ensemble.forecast import Forecast, check_problem, plotting_times
from en4dvar.ensemble.repeat import check_forecast_repeats
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution
from en4dvar.plumbing.errors import ConfigError
from en4dvar.problem import InverseProblem
from en4dvar.sampling.mcmc import ChainState
from en4dvar.sampling.refine import CLEARED, Refined, examine_shape, examine_tails, in_doubt, refined, samples
from en4dvar.schemes import MINIMISERS
from en4dvar.schemes.base import Weights
from en4dvar.schemes.settings import AssimilationSettings


@dataclass(frozen=True)
class Refinement:
    """A Markov chain under way, and the forward runs up to there."""

    chain: ChainState
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


@dataclass(frozen=True)
class Ends:
    """An ensemble (N, n), transformed, about the ``mode`` (n,) of J, and what came of running both."""

    members: Array
    mode: Array
    run: Forecast
    central: Forecast


@dataclass(frozen=True)
class Sampled:
    """The posterior's ensemble; how it was sampled, or the ``shape`` of one that was not."""

    ends: Ends
    refined: Refined | None
    shape: Mapping[str, float]


@dataclass
class Stages:
    """One data set, in the order of the methods; each keeps a state to resume from as it goes on.

    ``compares``: whether what varies is compared with constant values and with knots beside its own, each fitted anew.
    """

    problem: InverseProblem
    settings: AssimilationSettings
    seed: int
    executor: Executor
    progress: Progress | None = None
    keeper: Keep | None = None
    compares: bool = True

    def __post_init__(self) -> None:
        problem, settings = self.problem, self.settings
        self.fixed_parameters = check_problem(problem)
        self.minimiser = settings.own.minimiser
        plain = problem.observations.noise.quadratic and not problem.has_noise_scale
        if self.minimiser is None and (problem.estimates_discrepancy or not plain):
            raise ConfigError(
                f"{settings.scheme} takes Gaussian errors of known covariance: no sigma, robust cost, bounds or "
                f"discrepancy; use {' or '.join(MINIMISERS)}"
            )
        self.space = WeightSpace(problem, settings, self.seed, self.executor)
        self.grid = plotting_times(problem)
        self._foreseen: tuple[Array, Withheld | None] | None = None

    def descend(self, resume: LoopState | None = None) -> tuple[Forecast, LoopState, Descent]:
        """The prior forecast, where the iterations started, and their end."""
        space = self.space
        prior_run = space.whole(np.vstack([space.members, space.mean]), self.grid)
        space.require_members(prior_run[:-1].failures, "prior forecast")
        if not self.settings.stochastic_model:
            again = partial(space.forecast, extra_times=self.grid)
            check_forecast_repeats(self.problem, prior_run[:-1], lambda some: again(space.members[some]))
        space.check_derivatives(prior_run)
        start = self.start(prior_run, resume) if resume is None or resume.descent is None else resume
        return prior_run, start, self.iterate(start, prior_run)

    def start(self, prior_run: Forecast, resume: LoopState | None) -> LoopState:
        """The state from which the iterations go on."""
        space = self.space
        if self.minimiser is None:
            return LoopState(space.forward_runs, descent=Descent(Weights.prior(len(space.members))))
        if resume is not None:
            space.forward_runs = resume.forward_runs

        def keep(comparison: Callable[[], StartState]) -> None:
            self.keep(lambda: LoopState(space.forward_runs, comparison()))

        before = resume.comparison if resume else None
        begun = choose_start(space, prior_run, before, keep, self.tell)
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

        window = DataWindow(space, keep, self.tell, prior_run, self.grid)
        minimise(window, [descent])
        return descent

    def searched(self, start: LoopState, descent: Descent, prior_run: Forecast) -> tuple[Outcome, Ends]:
        """All minima, the lowest descent, and the ensemble about it.

        After the first descents one from a member far from the minimum looks for another. Of a cheap model, or for a
        chain, many are tried where there is one or where J of the posterior members is not that of a Gaussian, and
        draws beyond the ensemble where the lowest J is higher than noise and prior explain; of another model some,
        where the lowest minimum is that of one descent alone. Of any, one from where all readings lead, where those
        after the window are not what is expected.
        """
        space, scheme, before = self.space, self.minimiser, self.latest.descent
        assert before is not None
        if scheme is None:
            return Outcome(descent, before, (), ()), self.gaussian(descent)
        begun, minima = start.search or SearchState(), start.minima
        if start.search is None:
            minima = merged([Minimum.of(space, descent), *minima])
        outcome = Outcome(descent, before, minima, start.tried, begun.runs, begun.over)
        if not scheme.searches or not scheme.economical(space.basis):
            return outcome, self.gaussian(descent)
        if start.search is not None:
            space.forward_runs = start.forward_runs
        search = Search(space, prior_run, begun, self.keep_search, self.tell)
        outcome = search.unchanging(search.challenged(outcome))
        sampling = self.settings.refine == "mcmc" or samples(space)
        if not sampling:
            outcome = search.settled(outcome)
        ends = self.gaussian(outcome.descent)
        over = search.last in start.tried
        if (over or (sampling and begun.over > search.over)) and not begun.lower:
            if over:
                self.expected(ends.members)
            space.forward_runs = start.forward_runs  # they were counted before the rounds that follow
        if sampling:
            fit = diag.gaussianity(ends.members, ends.mode, space.costs(ends.members, ends.run))["gaussian_fit"]
            rest = search.rest(outcome)
            if rest and (len(outcome.minima) > 1 or not fit >= CLEARED):
                outcome, ends = self.rather(search.round(outcome, rest), outcome, ends)
            outcome, ends = self.rather(search.widened(outcome), outcome, ends)
        return self.rather(search.foretold(outcome, lambda: self.missed(ends.members)), outcome, ends)

    def expected(self, members: Array) -> Withheld | None:
        """What members (N, n) expect of the readings after the window, which is run once for each ensemble."""
        if self._foreseen is None or self._foreseen[0] is not members:
            withheld = predict_withheld(self.problem, members, self.space.executor)
            self.space.forward_runs += withheld.runs if withheld else 0
            self._foreseen = members, withheld
        return self._foreseen[1]

    def missed(self, members: Array) -> bool:
        """Whether the readings after the window put the estimate in doubt."""
        withheld = self.expected(members)
        return withheld is not None and withheld.missed

    def rather(self, after: Outcome, outcome: Outcome, ends: Ends) -> tuple[Outcome, Ends]:
        """What was found ``after`` a round, and the ensemble about it: that of before where it is no lower descent."""
        return after, ends if after.descent is outcome.descent else self.gaussian(after.descent)

    def searched_from(self, outcome: Outcome, ends: Ends, x: Array) -> tuple[Outcome, Ends]:
        """The same, after a descent from a draw x (n,) of the posterior that lies lower than all minima."""
        after = from_draw(self.space, outcome, x, self.tell)
        return self.rather(after, outcome, ends)

    def keep_search(self, state: Callable[[], tuple[Outcome, SearchState]]) -> None:
        outcome, search = state()
        runs, minima, tried = self.space.forward_runs, outcome.minima, outcome.tried
        self.latest = replace(
            self.latest, forward_runs=runs, descent=outcome.before, minima=minima, tried=tried, search=search
        )
        self.keep(lambda: self.latest)

    def gaussian(self, descent: Descent) -> Ends:
        """The ensemble at the end of a descent, and its forecast."""
        space, problem = self.space, self.problem
        transform = descent.newton.hessian.economical_transform if self.minimiser else descent.weights.T
        ends = space.ensemble(descent.weights.w, transform)
        members, mode = ends[:-1], ends[-1]
        members = members + mean_beyond_mode(problem, mode, members, descent.records[-1].dfs)
        if self.minimiser is None:  # the last ensemble that was run is the posterior
            return Ends(members, mode, descent.iterate.members, descent.iterate.central)
        if problem.discrepancy and descent.iterate.linear is not None:
            members = marginal_members(space, descent.iterate.linear, mode, members)
        if descent.iterate.linear is not None:
            members = bounded_members(space, descent.iterate.linear, descent.weights.w, members)
        final = space.whole(np.vstack([members, mode]), self.grid)
        return Ends(members, mode, final[:-1], final[-1:])

    def sampled(
        self, ends: Ends, minima: Sequence[Minimum], agree: bool, earlier: Refinement | None, looking: bool
    ) -> Sampled:
        """The ensemble, sampled where that is asked for or there is a doubt.

        ``agree``: descents from different members ended in the lowest of the ``minima`` that count. ``earlier``: where
        a chain was interrupted. ``looking``: end at a draw that lies lower than all minima. Where members lack readings
        nothing is sampled: draws without one would count as impossible.
        """
        space = self.space
        if ends.run.filled:
            return Sampled(ends, None, {})
        if self.settings.refine != "mcmc":
            cheap = samples(space)
            # with a discrepancy emulated J costs as much as true J: where that may be sampled, it tells
            settle = not (cheap and self.problem.discrepancy)
            costs = space.costs(ends.members, ends.run)
            shape = examine_shape(space, ends.members, ends.mode, costs, self.seed, settle)
            settles = cheap and bool(minima)
            if settles and not in_doubt(minima, agree, shape):
                shape |= examine_tails(space, ends.members, costs)
            if not (settles and in_doubt(minima, agree, shape)):
                return Sampled(ends, None, shape)
        sampled = self.refine(ends.members, minima, earlier, looking)
        if sampled.lower is not None:
            return Sampled(ends, sampled, {})
        run = space.whole(sampled.members, self.grid)
        central = ends.central if self.minimiser else space.forecast(ends.mode[None], self.grid)
        return Sampled(Ends(sampled.members, ends.mode, run, central), sampled, {})

    def refine(self, posterior: Array, minima: Sequence[Minimum], earlier: Refinement | None, looking: bool) -> Refined:
        """What takes the place of the posterior ensemble (N, n); for the rest see :meth:`sampled`."""
        space = self.space

        def keep(state: ChainState) -> None:
            self.keep(lambda: replace(self.latest, refinement=Refinement(state, space.forward_runs)))

        def resume() -> ChainState | None:
            """What came before the chain is made again after an interruption, from the same runs."""
            if earlier is None:
                return None
            space.forward_runs = earlier.forward_runs
            return earlier.chain

        return refined(space, posterior, minima, self.seed, looking=looking, resume=resume, keep=keep, look=self.tell)

    def keep(self, state: Callable[[], LoopState]) -> None:
        if self.keeper is not None:
            self.keeper(state)

    def tell(self, record: Record) -> None:
        if self.progress is not None:
            self.progress(self.problem.observations.name, record)
