"""How far to go along a direction. Every rule judges by J of the central trajectory and none accepts a rise; but a
regression over the ensemble ends by :class:`Settling`.

A rule is a generator: it yields candidate weights (B, N), receives their :class:`Trials`, and returns a :class:`Move`
or None. So the loop can run the candidates of several descents in one call of the model (:func:`run_searches`), and a
model that integrates many members at once pays for one run.
"""

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from en4dvar.model.state import Array
from en4dvar.schemes.base import GaussNewtonStep

NEAR = 0.5  # posterior standard deviations: a regression whose steps are shorter settles; longer ones are searched by J
LEAST = 1 / 32  # share of a step


@dataclass(frozen=True)
class Settling:
    """How a regression over the ensemble ends: where its own gradient vanishes, by damped steps.

    That gradient is the one of J averaged over the ensemble, as Stein's identity has it of Gaussian members. It need
    not vanish where J of the central run is smallest, so that close to there J cannot judge the steps any more: a
    search by J stops with steps left. The length of the next step, in posterior standard deviations, can. Steps and
    ensemble may also drive each other to and fro; then the transform of the ensemble is held, and the steps are damped.

    ``share`` of the next step that is taken, and length of the step ``before``; ``held``: the transform stays.
    """

    share: float = 1.0
    before: float = math.inf
    held: bool = False

    def after(self, norm: float) -> "Settling":
        """With a next step of length ``norm``.

        Where a share s of the steps is taken, these should shrink by s of their length; half as much is asked for. At
        the first step that does not shrink like that the transform is held, at each later one the share is halved.
        """
        if norm <= (1 - 0.5 * self.share) * self.before:
            return Settling(self.share, norm, self.held)
        return Settling(max(0.5 * self.share, LEAST) if self.held else self.share, norm, held=True)


SUFFICIENT = 1e-4  # Armijo's constant: the fraction of the predicted decrease that must be realised
LENGTHS = np.array([1.0, 0.5, 0.25, 0.125])
MOST_BENT = 2.0  # the acceleration is cut to this multiple of the direction
BATCH = len(LENGTHS)  # trials per call of the model
LONGEST = 6.0  # norm of a step in the coordinates of the tangent: 40 prior standard deviations of an ensemble of 48
KEPT = 0.75  # of the predicted decrease: what half of a step promises


@dataclass(frozen=True)
class Trials:
    """What the model says about candidates: ``costs`` J (B,), +inf where it fails, and ``predictions`` (B, K)."""

    costs: Array
    predictions: Array

    def __getitem__(self, part: slice) -> "Trials":
        return Trials(self.costs[part], self.predictions[part])


@dataclass(frozen=True)
class Tangent:
    """The observations' part of a tangent linearisation, for rules that look at curvature.

    ``prediction`` (K,) at the centre, ``anomalies`` C (r, K) of the predictions per unit of the coordinates of
    ``basis`` U (N, r), ``precision`` what applies βR⁻¹ to a vector (K,).
    """

    prediction: Array
    anomalies: Array
    precision: Callable[[Array], Array]
    basis: Array


@dataclass(frozen=True)
class Point:
    """Where a search starts: weights ``w`` (N,), J there, the undamped step, and the tangent where there is one.

    ``sparing``: derivatives cost a run, so that trials decide how many there are; the whole step is tried alone first.
    """

    w: Array
    cost: float
    step: GaussNewtonStep
    tangent: Tangent | None = None
    sparing: bool = False


@dataclass(frozen=True)
class Move:
    """An accepted move: new weights ``w`` (N,), or what else a place is, J there, and the share of the full step."""

    w: Any
    cost: float
    step_length: float


Search = Generator[Any, Any, Move | None]
StepControl = Callable[[Point], Search]


def full_step(at: Point) -> Search:
    """The whole step, or None where it raises J."""
    trials = yield (at.w + at.step.direction)[None]
    return _lowest(at, at.step.direction[None], np.ones(1), trials, sufficient=0.0)


def line_search(at: Point) -> Search:
    """Backtracking: the lowest J among 1, ½, ¼, ⅛ of the step that satisfies Armijo's condition, then shorter ones.

    Of a step longer than :data:`LONGEST` these are shares of one that long: readings whose errors are small beside
    their misfit ask for hundreds of prior standard deviations, where a model is absurd and a run of it slow.
    A ``sparing`` point tries the others only where the whole step lowers J by less than half of it promised. Where the
    full step is not the best of the first four, the predictions along the step tell how the model curves,
    and four points of the parabola a δw + ½ a² δ²w are tried as well: the second-order correction of the step,
    without which a descent creeps along a curved valley. Returns None when none of 12 halvings lowers J.
    Sources: Nocedal & Wright (2006), Numerical Optimization, § 3.1; geodesic acceleration: Transtrum & Sethna (2012),
    arXiv:1201.5885.
    """
    direction = at.step.direction
    far = float(np.linalg.norm(direction @ at.tangent.basis)) if at.tangent else 0.0
    most = LENGTHS * (LONGEST / max(far, LONGEST))
    if at.sparing and most[0] == 1 and (move := (yield from _whole_step(at))):
        return move
    for first in range(3):
        lengths = most * 0.5 ** (BATCH * first)
        straight = lengths[:, None] * direction
        trials = yield at.w + straight
        move = _lowest(at, straight, lengths, trials)
        if first == 0 and at.tangent is not None and (move is None or move.step_length < most[0]):
            bend = acceleration(at.step, at.tangent, lengths, trials.predictions)
            bent = straight + 0.5 * lengths[:, None] ** 2 * bend
            curved = _lowest(at, bent, lengths, (yield at.w + bent))
            if curved is not None and (move is None or curved.cost < move.cost):
                move = curved
        if move is not None:
            return move
    return None


def _whole_step(at: Point) -> Search:
    """Straight, else bent by the shortest trial: the first that lowers J by as much as half of it promised."""
    step, direction = at.step, at.step.direction
    enough = at.cost - KEPT * step.predicted_decrease
    trials = yield at.w + LENGTHS[:1, None] * direction
    if trials.costs[0] > enough and at.tangent is not None:
        trials = yield at.w + LENGTHS[-1:, None] * direction
        bend = acceleration(step, at.tangent, LENGTHS[-1:], trials.predictions)
        direction = direction + 0.5 * LENGTHS[0] ** 2 * bend
        trials = yield at.w + LENGTHS[:1, None] * direction
    return Move(at.w + direction, float(trials.costs[0]), 1.0) if trials.costs[0] <= enough else None


def each_once(search: Search) -> Search:
    """The same search; a candidate that it had before is not tried again."""
    known: dict[bytes, tuple[float, Array]] = {}
    candidates = next(search)
    while True:
        own = [candidate.tobytes() for candidate in candidates]
        new = [i for i, key in enumerate(own) if key not in known]
        if new:
            trials = yield candidates[new]
            known |= {own[i]: (cost, row) for i, cost, row in zip(new, trials.costs, trials.predictions, strict=True)}
        costs, predictions = zip(*(known[key] for key in own), strict=True)
        try:
            candidates = search.send(Trials(np.array(costs), np.array(predictions)))
        except StopIteration as end:
            move: Move | None = end.value
            return move


def acceleration(step: GaussNewtonStep, tangent: Tangent, lengths: Array, predictions: Array) -> Array:
    """Second-order correction δ²w (N,) of the step from predictions (B, K) at ``lengths`` (B,) of it.

    With m'' the second derivative of the whitened predictions along the step, from the shortest trial that the model
    could run, δ²w = −A⁻¹ Sᵀ m'', the increment that undoes the curvature as far as the linearisation can. Zero where
    no trial could be run.
    """
    runnable = np.flatnonzero(np.all(np.isfinite(predictions), axis=1))
    if not len(runnable):
        return np.zeros_like(step.direction)
    shortest = runnable[np.argmin(lengths[runnable])]
    a = lengths[shortest]
    departure = predictions[shortest] - tangent.prediction - a * (step.direction @ tangent.basis) @ tangent.anomalies
    bend = -step.hessian.solve(tangent.basis @ (tangent.anomalies @ tangent.precision(departure * 2 / a**2)))
    longest = MOST_BENT * float(np.linalg.norm(step.direction))
    return np.asarray(bend * min(1.0, longest / (float(np.linalg.norm(bend)) or 1.0)))


def levenberg_marquardt(at: Point) -> Search:
    """−(A + λ(N−1)I)⁻¹ g: the lowest J over λ = 0, 1, 10, 100 that decreases J enough, then over λ = 10³…10¹⁰.

    λ is relative to the prior precision. ``step_length`` is the length of the damped step relative to the undamped one.
    """
    full = float(np.linalg.norm(at.step.direction)) or 1.0
    for exponents in ((-np.inf, 0, 1, 2), (3, 4, 5, 6), (7, 8, 9, 10)):
        damped = np.stack([-at.step.hessian.solve(at.step.gradient, damping=10.0**e) for e in exponents])
        trials = yield at.w + damped
        move = _lowest(at, damped, np.linalg.norm(damped, axis=1) / full, trials)
        if move is not None:
            return move
    return None


STEP_CONTROLS: dict[str, StepControl] = {
    "full": full_step,
    "line-search": line_search,
    "levenberg-marquardt": levenberg_marquardt,
}


def run_searches(searches: Sequence[Search | None], try_out: Callable[[Any], Any]) -> list[Move | None]:
    """Run searches side by side: ``try_out`` (B, N) → trials is called with the candidates of all at once."""
    moves: list[Move | None] = [None] * len(searches)
    waiting = {i: (search, next(search)) for i, search in enumerate(searches) if search is not None}
    while waiting:
        every = [candidates for _, candidates in waiting.values()]
        trials = try_out(every[0] if len(every) == 1 else np.concatenate(every))
        first, answered = 0, waiting
        waiting = {}
        for i, (search, candidates) in answered.items():
            part = slice(first, first + len(candidates))
            first = part.stop
            try:
                waiting[i] = search, search.send(trials if len(answered) == 1 else trials[part])
            except StopIteration as end:
                moves[i] = end.value
    return moves


def _lowest(at: Point, moves: Array, lengths: Array, trials: Trials, sufficient: float = SUFFICIENT) -> Move | None:
    """The trial of lowest J among those that decrease it enough, of ``moves`` (B, N)."""
    slopes = (moves @ at.step.gradient).tolist()
    costs = trials.costs.tolist()  # of a few trials, which Python compares faster than numpy
    passed = [i for i, slope in enumerate(slopes) if costs[i] <= at.cost + sufficient * min(0.0, slope)]
    if not passed:
        return None
    best = min(passed, key=costs.__getitem__)
    return Move(at.w + moves[best], costs[best], float(lengths[best]))
