"""Whether there is another minimum than the one that the first descents ended in.

Members of low J may all lie in the basin of a wrong minimum. A challenger starts from the member farthest from the
minimum, chosen by the forecast of the prior ensemble that is there anyway; where it ends elsewhere, others follow.
Where noise and prior do not explain the lowest J, or too many descents ended each at a place of its own, no member may
lie in the right basin: many more draws of the prior are run, and the lowest of them start descents, until these settle
it or there are none left. Where something changes along the path, a descent starts where the fit without any change
ends. Where readings after the window, which nothing was fitted to, come out otherwise than expected, a descent starts
where all readings together lead.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np

from en4dvar.descent.loop import minimise
from en4dvar.descent.minima import Minimum, Outcome, merged
from en4dvar.descent.start import Rounds, choose_start, descent_at, descent_from, highest_plausible
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.diagnosis.analysis import Record, StartRecord
from en4dvar.diagnosis.withheld import Withheld, unforeseen
from en4dvar.ensemble.forecast import Forecast
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.problem import InverseProblem
from en4dvar.schemes.base import GaussNewtonStep

SAME_COST = 0.01  # of J, by which a descent must end lower to be another one
WIDER = 20  # times the ensemble: draws of the prior beyond it
TOGETHER = 6  # descents from these in a round, at least: by 9 % they all miss a basin of a third of such draws
ROUNDS = 3  # of descents from them, at most
SURVEY = 24  # descents that a model takes that is said to be cheap: of 12, 1 in 8 missed a mode of 30 % of a posterior


class Search:
    """Descents from further members of the prior ensemble, whose forecast is ``run``, round after round.

    ``tell``: see :func:`~en4dvar.descent.start.choose_start`.
    """

    def __init__(self, space: WeightSpace, run: Forecast, tell: Callable[[Record], None]):
        self.space, self.run, self.over = space, run, 0
        self.tell = lambda r: tell(replace(r, further=self.over) if isinstance(r, StartRecord) else r)

    def challenged(self, outcome: Outcome) -> Outcome:
        """After a descent from the member farthest from the lowest minimum, in standard deviations of the Gaussian
        about it, of those in the half of lower J that were not tried.
        """
        costs = self.space.member_costs(self.run)[:-1]
        order: list[int] = np.argsort(costs, kind="stable").tolist()
        better = order[: max(len(outcome.tried) + 1, int(np.isfinite(costs).sum()) // 2)]
        far, lowest = [i for i in better if i not in outcome.tried], outcome.minima[0]
        return self.round(outcome, [max(far, key=lambda i: lowest.distance(self.space.members[i]))])

    def settled(self, outcome: Outcome) -> Outcome:
        """After ``starts`` members more, and again while descents do not agree and the budget lasts."""
        together = self.space.minimiser.starts
        while not outcome.agreed and (rest := self.rest(outcome)):
            outcome = self.round(outcome, rest[:together])
        return outcome

    def surveyed(self, outcome: Outcome) -> Outcome:
        """After :data:`SURVEY` members more, of whatever J, where the model is said to be cheap: that a few descents
        agree excludes no other mode. Of a compiled model, whose data sets may be thousands, it is as before.
        """
        model, costs = self.space.problem.model, self.space.member_costs(self.run)[:-1]
        rest = [i for i in np.flatnonzero(np.isfinite(costs)).tolist() if i not in outcome.tried]
        return self.round(outcome, rest[:SURVEY]) if rest and model.cheap and not model.compiled else outcome

    def widened(self, outcome: Outcome) -> Outcome:
        """After descents from the lowest of many draws beyond the ensemble, where J is higher than noise and prior
        explain, and round after round while descents do not agree.
        """
        first = len(self.space.members) + 1
        while rest := [i for i in range(first, self.last) if i not in outcome.tried]:
            explained = len(rest) < self.last - first or outcome.descent.cost <= highest_plausible(self.space)
            if explained and outcome.agreed:
                break
            outcome = self.round(outcome, rest[: self.together])
        return outcome

    def foretold(self, outcome: Outcome, expected: Callable[[], Withheld | None]) -> Outcome:
        """After a descent from :attr:`led`, where readings after the window miss what is ``expected`` of them."""
        doubtful = self.last not in outcome.tried and (withheld := expected()) is not None and withheld.missed
        return self._from(outcome, self.last) if doubtful else outcome

    def unchanging(self, outcome: Outcome) -> Outcome:
        """After a descent from :attr:`steady`, where something changes along the path."""
        return self._from(outcome, self.last + 1) if self.space.problem.has_constant else outcome

    def _from(self, outcome: Outcome, number: int) -> Outcome:
        """After a descent from the minimum of another problem."""
        try:
            return self.round(outcome, [number])
        except TooFewMembersError:  # the model does not run there
            return outcome

    @property
    def last(self) -> int:
        """The number of :attr:`led` in :attr:`Outcome.tried`; where it is there, the search is over."""
        return len(self.space.members) + 1 + ROUNDS * self.together

    @property
    def together(self) -> int:
        """Descents in a round of those from draws."""
        return max(TOGETHER, self.space.side_by_side)

    @cached_property
    def led(self) -> Array:
        """Where a descent (n,) ends in which the readings after the window take part, with what is unforeseen."""
        more = self.space.problem.observations.continued
        assert more is not None
        return self._minimum(replace(unforeseen(self.space.problem), observations=more))

    @cached_property
    def steady(self) -> Array:
        """Where a descent (n,) ends in which all parameters are constant and the model has no error."""
        return self._minimum(self.space.problem.constant)

    def _minimum(self, problem: InverseProblem) -> Array:
        """That of another problem, with what it does not estimate at the prior's mean."""
        space = self.space
        settings = replace(space.settings, own=replace(space.minimiser, start="best-member"))
        whole = WeightSpace(problem, settings, space.seed, space.executor)
        run = whole.whole(np.vstack([whole.members, whole.mean]))
        begun = choose_start(whole, run).descent
        minimise(DataWindow(whole), [begun])
        space.forward_runs += whole.forward_runs
        prior = space.problem.prior
        named = dict(zip(prior.names, prior.mean, strict=True))
        named |= dict(zip(problem.prior.names, whole.control(begun.weights.w), strict=True))
        return np.array([named[name] for name in prior.names])

    @cached_property
    def lowest_draws(self) -> Array:
        """(B, n) of the draws that an ensemble :data:`WIDER` times as large would add, as many as descents may take."""
        space, n_members = self.space, len(self.space.members)
        draws = space.problem.prior.sample((1 + WIDER) * n_members, space.seed, "random")[n_members:]
        costs = np.concatenate([space.costs(x, space.forecast(x)) for x in np.split(draws, WIDER)])
        return np.asarray(draws[np.argsort(costs, kind="stable")[: self.last - n_members - 1]])

    def begin(self, number: int) -> Descent:
        """From a member, the mean, a draw, :attr:`led` or :attr:`steady`; numbers as in :attr:`Outcome.tried`."""
        first = len(self.space.members) + 1
        if number < first:
            return descent_from(self.space, number)
        drawn = number < self.last
        x = self.lowest_draws[number - first] if drawn else self.led if number == self.last else self.steady
        return descent_at(self.space, x, number)

    def rest(self, outcome: Outcome) -> list[int]:
        """The members for which a descent can be afforded and that were not tried; none once the search is over."""
        if self.last in outcome.tried:
            return []
        return [i for i in self.space.affordable(self.run) if i not in outcome.tried]

    def round(self, outcome: Outcome, members: Sequence[int]) -> Outcome:
        self.over, began = self.over + 1, self.space.forward_runs
        rival, minima = self._compared(outcome, members)
        after = replace(outcome, minima=merged([*outcome.minima, *minima]), tried=(*outcome.tried, *members))
        if rival.cost < outcome.descent.cost:
            after = lower(DataWindow(self.space, self.tell), rival, after)
        return replace(after, runs=outcome.runs + self.space.forward_runs - began, rounds=self.over)

    def _compared(self, outcome: Outcome, members: Sequence[int]) -> tuple[Descent, tuple[Minimum, ...]]:
        """The lowest of the descents, and where they ended: at the latest where they reach a known minimum."""
        window = Rounds(self.space, self.tell, outcome.minima)
        window.begin_round(list(map(self.begin, members)))
        minimise(window, window.descents)
        window.end_round()
        lowest = window.lowest
        if lowest.members and isinstance(lowest.step, GaussNewtonStep):
            window.end_here(lowest)
        lowest.ended = False
        return lowest, tuple(window.minima)


def lower(window: DataWindow, rival: Descent, outcome: Outcome) -> Outcome:
    """After the rest of the ``rival``, if it ends lower than the lowest minimum; else as before.

    What the window tells last are the iterations of the lowest descent, from the first on.
    """
    for record in rival.records:
        window.tell(record)
    with suppress(TooFewMembersError):  # the model does not run about it
        minimise(window, [rival])
        if rival.cost <= outcome.descent.cost - SAME_COST:
            return replace(outcome, descent=rival, minima=merged([Minimum.of(window.space, rival), *outcome.minima]))
    for record in outcome.descent.records:
        window.tell(record)
    return outcome


def from_draw(space: WeightSpace, outcome: Outcome, x: Array, tell: Callable[[Record], None]) -> Outcome:
    """After a descent from a draw x (n,) of the posterior, if it ends lower than the lowest minimum; else as before.

    ``tell``: see :func:`~en4dvar.descent.start.choose_start`.
    """
    before, rounds = space.forward_runs, outcome.rounds + 1
    draw = max(*outcome.tried, len(space.members)) + 1
    rival = descent_at(space, x, draw)
    tell(StartRecord(1, (float(space.try_out(rival.weights.w[None]).costs[0]),), 1, rounds))
    after = lower(DataWindow(space, tell), rival, outcome)
    if after is outcome:
        return outcome
    runs = outcome.runs + space.forward_runs - before
    return replace(after, tried=(*outcome.tried, draw), runs=runs, rounds=rounds)
