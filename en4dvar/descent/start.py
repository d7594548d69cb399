"""Where the iterations start: the prior forecast ranks its members, and a few descents tell which basin is lowest.

J of a strongly nonlinear model has several minima. The descents go side by side, so each costs r + 5 or so runs an
iteration (see :mod:`en4dvar.descent.weight_space`), and stop as soon as they tell: converged roughly, or close to
another one. The lowest is not descended again: its moves are the first iterations of the assimilation. Where even that
J is higher than noise and prior explain, other members are tried, as many again and again while there are some left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from en4dvar import diagnostics as diag
from en4dvar.analysis import StartRecord
from en4dvar.caution import Caution, caution
from en4dvar.descent.record import History
from en4dvar.descent.step_control import Move
from en4dvar.descent.weight_space import Local, WeightSpace
from en4dvar.ensemble.forecast import Forecast
from en4dvar.schemes import Step, Weights
from en4dvar.state import Array

ROUGH = 1e-2  # relative decrease of J at which a scout stops: it only has to tell basins apart
SAME = 1.0  # posterior standard deviations between scouts that have met


@dataclass(frozen=True)
class Start:
    """Weights (N,) from which the iterations go on, the moves that led there from a member, and warnings."""

    w: Array
    history: History
    warnings: tuple[Caution, ...] = ()


@dataclass(frozen=True)
class Descent:
    """A descent as it is kept: weights (N,), J there, whether it goes on, and its moves."""

    w: Array
    cost: float
    active: bool
    history: History


@dataclass(frozen=True)
class Comparison:
    """All that the rest of a comparison depends on: the descents under way, the rank by J of the member where the first
    of them started, the rounds of moves so far, and the lowest of the descents before.
    """

    descents: tuple[Descent, ...]
    first: int
    rounds: int
    lowest: Descent


Keep = Callable[[Callable[[], Comparison]], None]
Tell = Callable[[StartRecord], None]


def choose_start(space: WeightSpace, run: Forecast, resume: Comparison | None, keep: Keep, tell: Tell) -> Start:
    """Where to start. ``run`` is the forecast of the prior members and, last, of their mean.

    ``start: best-member`` compares descents from the ``starts`` members of lowest J, where a linearisation takes so
    few runs that all of them cost no more than one bundle of N members; else it takes the member of lowest J.
    ``resume``: where the comparison was interrupted. ``keep`` is called before each round of moves with what gives the
    state to resume from, ``tell`` after it.
    """
    n_members = len(space.members)
    untouched = History(space.scheme.init(n_members).T)
    candidates = space.drawn.at_members
    costs = space.drawn.background_at_members + space.observation_cost(run)
    warnings: tuple[Caution, ...] = ()
    if space.settings.start == "prior-mean":
        if np.isfinite(costs[-1]):
            return Start(candidates[-1], untouched)
        words = f"the prior mean cannot be run ({run.failures[-1]}); started from the best prior member"
        warnings = (caution("start-moved", words),)
    best = np.argsort(costs, kind="stable")
    affordable = n_members // (space.basis.shape[1] + 1) if space.economical else 1
    starts = [candidates[i] for i in best[:affordable] if np.isfinite(costs[i])]
    together = min(space.settings.starts, len(starts))
    if together < 2:
        return Start(candidates[best[0]], untouched, warnings)
    plausible = highest_plausible(space)
    if resume is None:
        rounds = Rounds(space, keep, tell, [], lowest=Scout(starts[0], untouched))
    else:
        descents = [Scout.of(descent) for descent in resume.descents]
        rounds = Rounds(space, keep, tell, descents, resume.first, resume.rounds, lowest=Scout.of(resume.lowest))
    while rounds.first < len(starts):
        if not rounds.scouts:
            rounds.scouts = [Scout(w, untouched) for w in starts[rounds.first : rounds.first + together]]
        rounds.lowest = min(rounds.lowest, lowest_basin(rounds, plausible), key=lambda scout: scout.cost)
        if rounds.lowest.cost <= plausible:
            break
        rounds.first, rounds.scouts = rounds.first + together, []
    return Start(rounds.lowest.w, rounds.lowest.history.after(space, rounds.lowest.path), warnings)


def highest_plausible(space: WeightSpace) -> float:
    """The 99.95 % point of J at its minimum where model, prior and R are right: 2 J is χ²_K then (Talagrand 1999).

    To first order: with a noise scale or timing errors J also holds Σ β ln(s/std), and other members are tried earlier.
    """
    observations = space.problem.observations
    used = observations.weights[observations.used]
    return 0.5 * float(used.mean()) * diag.chi2_interval(float(len(used)))[1] if len(used) else np.inf


@dataclass
class Scout:
    """A descent as far as it has gone: weights (N,), J there, its moves until it was kept, and those since."""

    w: Array
    history: History
    cost: float = np.inf
    active: bool = True
    path: list[tuple[Local, Step, Move]] = field(default_factory=list)

    @classmethod
    def of(cls, descent: Descent) -> Scout:
        return cls(descent.w, descent.history, descent.cost, descent.active)

    @property
    def moves(self) -> int:
        return len(self.history.records) + len(self.path)

    def kept(self, space: WeightSpace) -> Descent:
        return Descent(self.w, self.cost, self.active, self.history.after(space, self.path))


@dataclass
class Rounds:
    """The rounds of moves of a comparison: of ``scouts``, the first of which started from the member of rank ``first``.

    ``done`` counts them; ``lowest`` is the lowest scout of those before.
    """

    space: WeightSpace
    keep: Keep
    tell: Tell
    scouts: list[Scout]
    first: int = 0
    done: int = 0
    lowest: Scout = field(kw_only=True)

    def begin(self) -> None:
        self.keep(self.comparison)

    def end(self) -> None:
        self.done += 1
        costs, active = tuple(scout.cost for scout in self.scouts), sum(scout.active for scout in self.scouts)
        self.tell(StartRecord(self.done, costs, active))

    def comparison(self) -> Comparison:
        descents = tuple(scout.kept(self.space) for scout in self.scouts)
        return Comparison(descents, self.first, self.done, self.lowest.kept(self.space))


def lowest_basin(rounds: Rounds, plausible: float) -> Scout:
    """The scout that gets to the lowest J; the last one goes on while J is above ``plausible``."""
    space, scouts = rounds.space, rounds.scouts
    transform = np.eye(len(space.members))
    while going := [scout for scout in scouts if scout.active]:
        if going[0].moves == space.settings.max_iterations:
            break
        rounds.begin()
        locals_ = space.linearise([Weights(scout.w, transform) for scout in going])
        for scout, at in zip(going, locals_, strict=True):
            scout.cost = at.cost
        _stop_those_that_met(going, locals_)
        going, locals_ = _still_active(going, locals_)
        for scout, at, move in zip(going, locals_, space.search(locals_), strict=True):
            if move is None or at.step is None:
                scout.active = False
                continue
            small = ROUGH * max(1.0, move.cost)
            scout.active = max(at.cost - move.cost, at.step.predicted_decrease) > small
            scout.w, scout.cost = move.w, move.cost
            scout.path.append((at, at.step, move))
        rounds.end()
        if len(going) == 1 and going[0].cost <= min(*(scout.cost for scout in scouts), plausible):
            break  # it can only go lower: the comparison is decided
    return min(scouts, key=lambda scout: scout.cost)


def _still_active(scouts: list[Scout], locals_: list[Local]) -> tuple[list[Scout], list[Local]]:
    pairs = [(scout, at) for scout, at in zip(scouts, locals_, strict=True) if scout.active]
    return [scout for scout, _ in pairs], [at for _, at in pairs]


def _stop_those_that_met(scouts: list[Scout], locals_: list[Local]) -> None:
    """Of scouts within ``SAME`` of each other, in the metric of the lower one's Hessian, keep the lower one."""
    order = sorted(range(len(scouts)), key=lambda i: scouts[i].cost)
    for position, i in enumerate(order):
        step = locals_[i].step
        if step is None or not scouts[i].active:
            continue
        for j in order[position + 1 :]:
            if step.hessian.norm(scouts[j].w - scouts[i].w) < SAME:
                scouts[j].active = False
