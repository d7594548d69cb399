"""The only loop: linearise → step → judge → search along the step → move on, until every descent has ended.

What is minimised is an *objective*: J of one data set (:mod:`en4dvar.descent.window`), of one cycle of a series
(:mod:`en4dvar.series.window`), of several data sets that share parameters (:mod:`en4dvar.estimation.joint.descent`), or
of whole fields (:mod:`en4dvar.descent.field`). It makes a *step* of the runs at each iterate, linearised: that of a
scheme, of an ensemble; one of what is shared and what is own; or a dual one, in the space of the observations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from en4dvar.descent.step_control import Move, Search, run_searches


@dataclass(kw_only=True)
class Descends:
    """What the loop needs of a descent: the ``step`` from where it stands, of the iteration under way, why it stops,
    and whether it has ended; and whether it has ``converged``."""

    step: Any = None
    stop: str = ""
    converged: bool = False
    ended: bool = False


D = TypeVar("D", bound=Descends)


class Objective(Generic[D]):
    """What the loop needs of what it minimises; without a search each step is taken as it is."""

    def linearise(self, going: Sequence[D]) -> Sequence[Any]:
        """Run the members, of all descents in one call, and make a step of each; None where too few survive."""
        raise NotImplementedError

    def judge(self, going: Sequence[D]) -> None:
        """Say of which descents the step is not to be searched along: they ``stop``, or have ``ended``."""

    def search(self, descent: D) -> Search | None:
        """How far to go along the step; None: take it as it is, or not at all."""

    def try_out(self, candidates: Any) -> Any:
        """What the model says of the candidates of all searches."""

    def move(self, going: Sequence[D], moves: Sequence[Move | None]) -> None:
        """Record and tell where the descents stand, move them on, and end those that are done."""
        raise NotImplementedError


def minimise(objective: Objective[D], descents: Sequence[D]) -> None:
    """Iterate descents side by side, usually one, until each has ended."""
    while going := [descent for descent in descents if not descent.ended]:
        for descent, step in zip(going, objective.linearise(going), strict=True):
            descent.step = step
        objective.judge(going)
        going = [descent for descent in going if not descent.ended]
        searches = [None if descent.stop else objective.search(descent) for descent in going]
        objective.move(going, run_searches(searches, objective.try_out))
