"""The stages of an assimilation: prior forecast, start, iterations, search for other minima, refinement."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from en4dvar.descent.beyond_gaussian import Drawn, beside_bounds, over_errors
from en4dvar.descent.loop import minimise
from en4dvar.descent.minima import Minimum, Outcome, merged
from en4dvar.descent.search import Search
from en4dvar.descent.start import choose_start
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import Progress, Record
from en4dvar.diagnosis.withheld import Withheld, predict_withheld
from en4dvar.ensemble.forecast import Forecast, check_problem, plotting_times
from en4dvar.ensemble.repeat import check_forecast_repeats
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.sampling.near_bounds import near_bounds
from en4dvar.sampling.refine import (
    CLEARED,
    SEEN,
    Refined,
    examine_shape,
    examine_tails,
    in_doubt,
    refined,
    samples,
    that_count,
    weighs,
)
from en4dvar.schemes import MINIMISERS
from en4dvar.schemes.base import Weights
from en4dvar.schemes.settings import AssimilationSettings


@dataclass(frozen=True)
class Ends:
    """An ensemble (N, n), transformed, about the ``mode`` (n,) of J, and what came of running both; how it was drawn
    where that is no Gaussian: beside bounds, or parameters of the errors.
    """

    members: Array
    mode: Array
    run: Forecast
    central: Forecast
    drawn: Drawn | None = None

    def fit(self, space: WeightSpace) -> float:
        """The effective share of members that stand for the posterior: how well J agrees with what they are drawn from,
        which is a Gaussian unless they were drawn otherwise.
        """
        costs = space.costs(self.members, self.run)
        if self.drawn is None:
            return diag.gaussianity(self.members, self.mode, costs)
        return diag.effective_share(self.drawn.cost(self.members) - costs)


@dataclass(frozen=True)
class Sampled:
    """The posterior's ensemble; how it was sampled, or the ``shape`` of one that was not."""

    ends: Ends
    refined: Refined | None
    shape: Mapping[str, float]


@dataclass
class Stages:
    """One data set, in the order of the methods.

    ``compares``: whether what varies is compared with constant values and with knots beside its own, each fitted anew.
    """

    problem: InverseProblem
    settings: AssimilationSettings
    seed: int
    executor: Executor
    progress: Progress | None = None
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

    def descend(self) -> tuple[Forecast, Outcome]:
        """The prior forecast, and where the iterations started; its descent has ended."""
        space = self.space
        prior_run = space.whole(np.vstack([space.members, space.mean]), self.grid)
        space.require_members(prior_run[:-1], "prior forecast")
        if not self.settings.stochastic_model:
            again = partial(space.forecast, extra_times=self.grid)
            check_forecast_repeats(self.problem, prior_run[:-1], lambda some: again(space.members[some]))
        space.check_derivatives(prior_run)
        if self.minimiser is None:
            start = Outcome(Descent(Weights.prior(len(space.members))))
        else:
            start = choose_start(space, prior_run, self.tell)
        for record in start.descent.records:
            self.tell(record)
        minimise(DataWindow(space, self.tell, prior_run, self.grid), [start.descent])
        return prior_run, start

    def searched(self, start: Outcome, prior_run: Forecast) -> tuple[Outcome, Ends]:
        """All minima, the lowest descent, and the ensemble about it.

        After the first descents one from a member far from the minimum looks for another. Of a cheap model, or for a
        chain, many are tried where there is one or where J of the posterior members is not that of a Gaussian, and
        draws beyond the ensemble where the lowest J is higher than noise and prior explain or descents do not agree; of
        another model some, where they do not. Of any, one from where all readings lead, where those after the window
        are not what is expected.
        """
        space, scheme, descent = self.space, self.minimiser, start.descent
        if scheme is None:
            return start, self.gaussian(descent)
        outcome = replace(start, minima=merged([Minimum.of(space, descent), *start.minima]))
        if not scheme.searches or not scheme.economical(space.basis):
            return outcome, self.gaussian(descent)
        search = Search(space, prior_run, self.tell)
        outcome = search.unchanging(search.challenged(outcome))
        sampling = self.settings.refine == "mcmc" or samples(space)
        if not sampling:
            outcome = search.settled(outcome)
        ends = self.gaussian(outcome.descent)
        if sampling:
            rest = search.rest(outcome)
            if rest and (len(outcome.minima) > 1 or not ends.fit(space) >= CLEARED):
                outcome, ends = self.rather(search.round(outcome, rest), outcome, ends)
            outcome, ends = self.rather(search.surveyed(outcome), outcome, ends)
            outcome, ends = self.rather(search.widened(outcome), outcome, ends)
        return self.rather(search.foretold(outcome, lambda: self.expected(ends.members)), outcome, ends)

    def expected(self, members: Array) -> Withheld | None:
        """What members (N, n) expect of the readings after the window, which is run once for each ensemble."""
        if self._foreseen is None or self._foreseen[0] is not members:
            withheld = predict_withheld(self.problem, members, self.space.executor)
            self.space.forward_runs += withheld.runs if withheld else 0
            self._foreseen = members, withheld
        return self._foreseen[1]

    def rather(self, after: Outcome, outcome: Outcome, ends: Ends) -> tuple[Outcome, Ends]:
        """What was found ``after`` a round, and the ensemble about it: that of before where it is no lower descent."""
        return after, ends if after.descent is outcome.descent else self.gaussian(after.descent)

    def gaussian(self, descent: Descent) -> Ends:
        """The ensemble at the end of a descent, and its forecast."""
        space = self.space
        transform = descent.newton.hessian.economical_transform if self.minimiser else descent.weights.T
        ends = space.ensemble(descent.weights.w, transform)
        members, mode = ends[:-1], ends[-1]
        if self.minimiser is None:  # the last ensemble that was run is the posterior
            return Ends(members, mode, descent.iterate.members, descent.iterate.central)
        near, drawn, linear = None, None, descent.iterate.linear
        if linear is not None:
            if leaning := near_bounds(space, linear, mode, members):
                near = self.about(mode, leaning.members, leaning)
                if near.fit(space) >= CLEARED:
                    return near
            drawn = beside_bounds(space, linear, descent.weights.w, descent.iterate.cost)
            drawn = drawn or over_errors(space, linear, mode, members)
            members = drawn.members if drawn else members
        other = self.about(mode, members, drawn)
        return near if near and near.fit(space) > other.fit(space) else other

    def about(self, mode: Array, members: Array, drawn: Drawn | None = None) -> Ends:
        """Members (N, n) about a mode (n,), run."""
        final = self.space.whole(np.vstack([members, mode]), self.grid)
        return Ends(members, mode, final[:-1], final[-1:], drawn)

    def sampled(
        self, descent: Descent, ends: Ends, prior_run: Forecast, minima: Sequence[Minimum], agree: bool, looking: bool
    ) -> Sampled:
        """The ensemble, sampled where that is asked for or there is a doubt.

        ``agree``: descents from different members ended in the lowest of the ``minima`` that count. ``looking``: end at
        a draw that lies lower than all minima. The ``descent`` of a scheme that minimises nothing moves to the draw of
        lowest J and the linearisation that the draws give, so that what is told is told of them. Where members lack
        readings nothing is sampled: draws without one would count as impossible.
        """
        space = self.space
        if ends.run.filled:
            return Sampled(ends, None, {})
        if self.settings.refine != "mcmc":
            cheap = samples(space)
            # with a discrepancy emulated J costs as much as true J: where that may be sampled, it tells
            settle = not (cheap and self.problem.discrepancy)
            shape = examine_shape(space, ends.members, ends.fit(space), self.seed, settle)
            settles = cheap and bool(minima)
            modes = that_count(minima, self.problem.prior, math.log(SEEN))  # of which a warning is given in any case
            told = in_doubt(minima, agree, shape) if settles else "mean_shift" in shape or len(modes) > 1
            if minima and weighs(space) and not told and not shape["non_gaussian"] and not prior_run.filled:
                shape |= examine_tails(space, minima[0], ends.members, prior_run[:-1], ends.run, settles, ends.drawn)
                shape["non_gaussian"] = diag.is_non_gaussian(shape)
            if not (settles and in_doubt(minima, agree, shape)):
                return Sampled(ends, None, shape)
        sampled = refined(space, ends.members, minima, self.seed, looking=looking, look=self.tell)
        if sampled.lower is not None:
            return Sampled(ends, sampled, {})
        if self.minimiser:
            run, mode, central = space.whole(sampled.members, self.grid), ends.mode, ends.central
        else:
            mode = sampled.best
            whole = space.whole(np.vstack([sampled.members, mode]), self.grid)
            run, central = whole[:-1], whole[-1:]
            self._moved(descent, sampled.members, mode, whole)
        return Sampled(Ends(sampled.members, mode, run, central, ends.drawn), sampled, {})

    def _moved(self, descent: Descent, members: Array, mode: Array, run: Forecast) -> None:
        """Set a descent that minimised nothing to draws (N, n) about the ``mode`` (n,), whose ``run`` is there."""
        rows = self.space.weights_of(np.vstack([members, mode]))
        descent.weights, descent.ended = Weights(rows[-1], rows[:-1] - rows[-1]), False
        minimise(DataWindow(self.space, self.tell, run, self.grid), [descent])

    def tell(self, record: Record) -> None:
        if self.progress is not None:
            self.progress(self.problem.observations.name, record)


def values_of(prior: Prior, x: Array) -> dict[str, float]:
    """Physical values, by name, of a control vector (n,)."""
    return dict(zip(prior.names, prior.to_physical(x).tolist(), strict=True))


def control_of(prior: Prior, values: Mapping[str, float]) -> Array:
    """The control vector (n,) of physical values by name, which may hold others."""
    return prior.from_physical(np.array([values[name] for name in prior.names]))
