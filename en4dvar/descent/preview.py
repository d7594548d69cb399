"""What the prior says before any assimilation: its forecast, and what an estimate will cost."""

import time
from dataclasses import dataclass

import numpy as np

from en4dvar.descent.field_data import prior_members
from en4dvar.descent.search import SURVEY
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.ensemble.forecast import Forecast, forecast, plotting_times
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.model.state import Array
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

ENOUGH = 0.3  # seconds of forward runs that the time of one is taken from
LONGEST = 20.0  # seconds that the forecast of the prior ensemble may take unasked
ITERATIONS = 5  # of a descent, typically
SEARCH = 3  # runs of a step control, typically
CHALLENGER = 0.5  # of a descent, until one from a far member has come to the same minimum


@dataclass(frozen=True)
class Preview:
    """The prior ensemble of one data set before any assimilation.

    ``run`` is the forecast of its ``members`` (N, n), physical and without whole fields: predictions (N, K) and, along
    ``grid`` (M,), paths (N, M); of the first ones only where all would take long. ``seconds`` is the time of one
    forward run on one thread, ``runs`` how many an estimate takes, typically.
    """

    problem: InverseProblem
    grid: Array
    members: Array
    run: Forecast
    seconds: float
    runs: int

    @property
    def outside(self) -> float:
        """Share of the observations that no member's prediction comes near: outside the ensemble's range by > 2 std."""
        observations = self.problem.observations
        alive = self.run.predictions[self.run.active]
        if not len(alive):
            return 0.0  # nothing is expected
        low, high = alive.min(axis=0) - 2 * observations.std, alive.max(axis=0) + 2 * observations.std
        return float(np.mean((observations.values < low) | (observations.values > high)))


def preview(problem: InverseProblem, settings: AssimilationSettings, seed: int, whole: bool = False) -> Preview:
    """Run the prior ensemble of a data set on one thread and take the time.

    The first run is not counted: it may compile the model. ``whole``: every member, however long it takes. Members
    that fail are told by ``run.failures``, not raised.
    """
    grid = plotting_times(problem)
    executor = SerialExecutor()
    with one_blas_thread():
        if problem.fields or settings.localisation:
            every, runs = prior_members(problem, settings, seed), localised_runs(settings)
        else:
            space = WeightSpace(problem, settings, seed, executor)
            every, runs = space.members, expected_runs(space)
        if problem.in_question and not settings.localisation:  # its evidence takes a second fit
            runs += expected_runs(WeightSpace(problem.constant, settings, seed, executor))
        forecast(problem, every[:1], executor, grid)
        seconds, count = _seconds_per_run(problem, every, executor)
        members = every if whole or seconds * len(every) < LONGEST else every[:count]
        run = forecast(problem, members, executor, grid)
    named = problem.prior.to_physical(members[:, : len(problem.prior.terms)])
    return Preview(problem, grid, named, run, seconds, runs)


def _seconds_per_run(problem: InverseProblem, members: Array, executor: Executor) -> tuple[float, int]:
    """Seconds of one run, from as many members as take a third of a second, at most all; and how many these are."""
    count = min(len(members), max(1, problem.model.batch))
    while True:
        begin = time.perf_counter()
        forecast(problem, members[:count], executor)
        elapsed = time.perf_counter() - begin
        if elapsed > ENOUGH or count == len(members):
            return elapsed / count, count
        count = min(len(members), 2 * count)


def localised_runs(settings: AssimilationSettings) -> int:
    """Forward runs of a localised estimate, with a typical number of iterations."""
    n_members, scheme = settings.members, settings.own
    if scheme.minimiser:
        return 2 * n_members + 2 + min(ITERATIONS, scheme.minimiser.max_iterations) * (n_members + SEARCH)
    return (scheme.passes + 1) * n_members + 1


def expected_runs(space: WeightSpace) -> int:
    """Forward runs of an estimate with typical numbers of iterations and trials; without a Markov chain.

    A scheme that runs its whole ensemble does so once for each assimilation and once at the end, with the mean. A
    search takes prior and posterior forecast, and for each iteration a tangent (1, n or N runs) and the trials of the
    step control, ``starts`` descents side by side, one for each shorter window, and a part of one from a far member;
    of a model that is said to be cheap, those of a survey.
    Where a discrepancy is estimated and nothing is sampled, it takes another search, and one descent from there; where
    something changes along the path, the descents of a constant one, and a part of one from there.
    """
    n_members, scheme, problem = len(space.members), space.scheme.minimiser, space.problem
    if scheme is None:
        return (space.scheme.passes + 1) * (n_members + 1)
    economical = scheme.economical(space.basis)
    tangent = 1 if space.derivatives else 1 + (space.basis.shape[1] if economical else n_members)
    starts = scheme.starts if scheme.start == "best-member" and economical else 1
    challenger = CHALLENGER if scheme.searches and economical else 0.0
    if challenger and problem.model.cheap and not problem.model.compiled and space.settings.refine != "none":
        challenger += min(SURVEY, n_members - starts)
    held = 1 + starts + challenger if challenger and problem.estimates_discrepancy and not problem.model.cheap else 0.0
    steady = starts + challenger if challenger and problem.has_constant else 0.0
    iterations = (starts + challenger + held + steady + scheme.lengthen - 1) * min(ITERATIONS, scheme.max_iterations)
    return 2 * (n_members + 1) + round(iterations * (tangent + SEARCH))
