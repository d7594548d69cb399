"""Where the iterations start: the prior forecast ranks its members, and a few descents tell which basin is lowest.

J of a strongly nonlinear model has several minima. The descents go side by side, so each costs r + 5 or so runs an
iteration, and stop as soon as they tell: converged roughly, or close to another one. The lowest is not descended again:
its iterations are the first of the assimilation. Where even that J is higher than noise and prior explain, other
members are tried, as many again and again while there are some left.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.analysis import Record, StartRecord
from en4dvar.caution import Caution, caution
from en4dvar.descent.loop import iterate
from en4dvar.descent.step_control import Move
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.ensemble.forecast import Forecast
from en4dvar.schemes.base import Scheme
from en4dvar.schemes.en4dvar import En4DVar

ROUGH = 1e-2  # relative decrease of J at which a descent stops that only has to tell basins apart
SAME = 1.0  # posterior standard deviations between descents that have met


@dataclass(frozen=True)
class StartState:
    """All that the rest of a comparison depends on: the descents of this round, the rank by J of the member where the
    first of them started, the rounds of moves so far, and the lowest of the descents before.
    """

    descents: tuple[Descent, ...] = ()
    first: int = 0
    rounds: int = 0
    lowest: Descent | None = None


Keep = Callable[[Callable[[], StartState]], None]


def choose_start(
    space: WeightSpace, scheme: En4DVar, run: Forecast, seed: int, resume: StartState | None, keep: Keep,
    tell: Callable[[Record], None],
) -> tuple[Descent, tuple[Caution, ...]]:  # fmt: skip
    """The descent to go on with, and warnings. ``run``: forecast of the prior members and, last, of their mean.

    ``start: best-member`` compares descents from the ``starts`` members of lowest J, where a linearisation takes so
    few runs that all of them cost no more than one bundle of N members; else it takes the member of lowest J.
    ``resume``: where the comparison was interrupted. ``keep`` is called before each round of moves with the state to
    resume from, ``tell`` after it.
    """
    n_members, drawn = len(space.members), space.drawn

    def descent_from(member: int) -> Descent:
        return Descent(space.start(drawn.at_member(member)))

    costs = drawn.background_costs + space.observation_cost(run)
    warnings: tuple[Caution, ...] = ()
    if space.settings.start == "prior-mean":
        if np.isfinite(costs[-1]):
            return descent_from(n_members), ()
        words = f"the prior mean cannot be run ({run.failures[-1]}); started from the best prior member"
        warnings = (caution("start-moved", words),)
    best = np.argsort(costs, kind="stable")
    affordable = n_members // (space.basis.shape[1] + 1) if scheme.economical(space.basis) else 1
    starts = [i for i in best[:affordable].tolist() if np.isfinite(costs[i])]
    together = min(space.settings.starts, len(starts))
    if together < 2:
        return descent_from(int(best[0])), warnings
    comparison = resume or StartState(lowest=descent_from(starts[0]))
    window = Rounds(space, seed, comparison, keep, tell)
    while window.rank < len(starts):
        if not window.descents:
            window.descents = [descent_from(i) for i in starts[window.rank : window.rank + together]]
        iterate(window, scheme, window.descents)
        window.lowest = min(window.lowest, *window.descents, key=lambda descent: descent.cost)
        if window.lowest.cost <= window.plausible:
            break
        window.rank, window.descents = window.rank + together, []
    window.lowest.ended = False  # it goes on, as the first iterations of the assimilation
    return window.lowest, warnings


def highest_plausible(space: WeightSpace) -> float:
    """The 99.95 % point of J at its minimum where model, prior and R are right: 2 J is χ²_K then (Talagrand 1999).

    To first order: with a noise scale or timing errors J also holds Σ β ln(s/std), and other members are tried earlier.
    """
    observations = space.problem.observations
    used = observations.weights[observations.used]
    return 0.5 * float(used.mean()) * diag.chi2_interval(float(len(used)))[1] if len(used) else np.inf


class Rounds(DataWindow):
    """Descents side by side that only have to tell which gets lowest."""

    def __init__(self, space: WeightSpace, seed: int, before: StartState, keep: Keep, tell: Callable[[Record], None]):
        super().__init__(space, seed, lambda: keep(self.comparison), tell)
        self.descents, self.rank, self.rounds = [d.kept for d in before.descents], before.first, before.rounds
        self.lowest = before.lowest.kept if before.lowest else Descent(space.start(np.zeros(len(space.members))))
        self.plausible = highest_plausible(space)

    def comparison(self) -> StartState:
        """As it is kept."""
        return StartState(tuple(d.kept for d in self.descents), self.rank, self.rounds, self.lowest.kept)

    def move(self, scheme: Scheme, going: Sequence[Descent]) -> None:
        for descent in going:
            descent.ended = descent.step is None
        _end_those_that_met(going)
        going = [descent for descent in going if not descent.ended]
        for descent, move in zip(going, self.search(going), strict=True):
            self._follow(descent, move)
        self.rounds += 1
        costs = tuple(descent.cost for descent in self.descents)
        self.tell(StartRecord(self.rounds, costs, sum(not descent.ended for descent in self.descents)))
        if len(going) == 1 and going[0].cost <= min(*costs, self.plausible):
            going[0].ended = True  # it can only go lower: the comparison is decided

    def _follow(self, descent: Descent, move: Move | None) -> None:
        if move is None:
            descent.ended = True
            return
        step, before = descent.newton, descent.cost
        self.record(descent, step.hessian.economical_transform, move.step_length)
        descent.weights, descent.cost = self.space.onwards(move.w, step.hessian), move.cost
        rough = max(before - move.cost, step.predicted_decrease) <= ROUGH * max(1.0, move.cost)
        descent.ended = rough or descent.iteration == self.settings.max_iterations


def _end_those_that_met(descents: Sequence[Descent]) -> None:
    """Of descents within ``SAME`` of each other, in the metric of the lower one's Hessian, keep the lower one."""
    order = sorted(descents, key=lambda descent: descent.cost)
    for position, lower in enumerate(order):
        if lower.ended:
            continue
        for higher in order[position + 1 :]:
            if lower.newton.hessian.norm(higher.weights.w - lower.weights.w) < SAME:
                higher.ended = True
