"""Where the iterations start: the prior forecast ranks its members, and a few descents tell which basin is lowest.

J of a strongly nonlinear model has several minima. The descents go side by side, so each costs r + 5 or so runs an
iteration, and stop as soon as they tell: converged roughly, or close to another one. The lowest is not descended
again: its iterations are the first of the assimilation. Where no other descent ended where the lowest did, or even that
J is higher than noise and prior explain, other members are tried, as many again while there are some left.

Where J of the whole window has too many minima, windows are lengthened step by step. A chaotic model has about as many
minima as its trajectories part within the window. J of its beginning has one, and the minimum of a window lies near
that of the window a little shorter: each descent starts where the one before it ended (quasi-static variational
assimilation: Pires, Vautard & Talagrand 1996, Tellus A 48, 96; Swanson, Vautard & Pires 1998, Tellus A 50, 369).
Readings after the end of a window have the weight zero, and on the way there, where windows only lead on, correlated
errors count as independent and a discrepancy as nothing; the whole window has R as it is.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from en4dvar.data.noise import noise_of, sides_of
from en4dvar.descent.loop import minimise
from en4dvar.descent.minima import AGREE, REACHED, Minimum, Outcome, merged
from en4dvar.descent.step_control import Move, Search
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import Record, StartRecord
from en4dvar.ensemble.forecast import Forecast
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.errors import ConfigError, Fault
from en4dvar.plumbing.hints import nearest
from en4dvar.problem import InverseProblem

ROUGH = 1e-2  # relative decrease of J at which a descent stops that only has to tell basins apart, or to lead on
SAME = 1.0  # posterior standard deviations between descents that have met


def choose_start(space: WeightSpace, run: Forecast, tell: Callable[[Record], None] = lambda record: None) -> Outcome:
    """The descent to go on with, and the other minima that descents ended in.

    ``run``: forecast of the prior members and, last, of their mean.

    ``start: best-member`` compares descents from the ``starts`` members of lowest J, where a linearisation takes so
    few runs that all of them cost no more than one bundle of N members; else it takes the member of lowest J.
    ``tell`` is called after each round of moves.
    """
    scheme, beyond = space.minimiser, len(space.members) + 1  # the latter numbers what is no member
    if scheme.lengthen > 1:
        led = lengthened(space, run, tell)
        return Outcome(Descent(space.weights_at(led), members=(beyond,)), tried=(beyond,))
    warnings: tuple[Caution, ...] = ()
    begin = scheme.start
    if not isinstance(begin, str):
        return Outcome(descent_at(space, given(space.problem, begin), beyond), tried=(beyond,))
    if begin == "prior-mean":
        if np.isfinite(space.problem.observations.cost(run.predicted)[-1]):
            mean = len(space.members)
            return Outcome(descent_from(space, mean), tried=(mean,))
        words = f"the prior mean cannot be run ({run.failures[-1]}); started from the best prior member"
        warnings = (caution("start-moved", words),)
    starts = space.affordable(run)
    together = min(scheme.starts, len(starts))
    first = descent_from(space, starts[0])
    if together < 2:
        return Outcome(first, tried=(starts[0],), warnings=warnings)
    window, rank = Rounds(space, tell, lowest=first), 0
    while rank < len(starts):
        window.begin_round([descent_from(space, i) for i in starts[rank : rank + together]])
        minimise(window, window.descents)
        rank += together
        if window.end_round():
            break
    window.lowest.ended = False  # it goes on, as the first iterations of the assimilation
    return Outcome(window.lowest, window.others(), tuple(starts[:rank]), warnings=warnings)


def shortened(space: WeightSpace) -> Iterator[WeightSpace]:
    """The data set in the first 1/L, 2/L, … of the time of its readings, L = ``lengthen``, the whole left out.

    A window that holds no more readings than the one before is left out, too.
    """
    observations, scheme = space.problem.observations, space.minimiser
    noise = observations.noise
    if not noise.independent:
        noise = noise_of(noise.std, noise.time_std)
    own = replace(scheme, lengthen=1, cost_tolerance=max(ROUGH, scheme.cost_tolerance))
    settings = replace(space.settings, own=own)
    (begin, end), counted, of_all = observations.span, 0, int(np.sum(observations.weights > 0))
    for j in range(1, scheme.lengthen):
        inside = observations.times <= begin + (end - begin) * j / scheme.lengthen
        weights = np.where(inside, observations.weights, 0.0)
        if counted < (counted := int(np.sum(weights > 0))) < of_all:
            problem = replace(space.problem, observations=replace(observations, weights=weights, noise=noise))
            yield WeightSpace(problem, settings, space.seed, space.executor)


def lengthened(space: WeightSpace, run: Forecast, tell: Callable[[Record], None]) -> Array:
    """Weights (N,) at the end of the last but one window. ``run``: see :func:`choose_start`.

    Raises :class:`ConfigError` where all readings are at one time.
    """
    w: Array | None = None
    for number, short in enumerate(shortened(space)):
        descent = choose_start(short, run, tell=tell).descent if w is None else Descent(short.weights_at(w))
        descent.ended = False
        minimise(DataWindow(short), [descent])
        w = descent.weights.w
        space.forward_runs += short.forward_runs
        tell(StartRecord(number + 1, (descent.cost,), 1))
    if w is None:
        raise ConfigError("all readings are at one time; there is no window to lengthen", "assimilation.lengthen")
    return w


def descent_from(space: WeightSpace, member: int) -> Descent:
    """One that starts from a member of the prior ensemble, or, of number N, from the mean.

    Its weights are the shortest of that member, so that J_b is ½‖x − x̄0‖² in the prior covariance.
    """
    count = len(space.members)
    w = np.zeros(count) if member == count else np.asarray(space.basis @ space.basis[member])
    return Descent(space.weights_at(w), members=(member,))


def descent_at(space: WeightSpace, x: Array, number: int) -> Descent:
    """One that starts at a control vector x (n,) that is no member."""
    return Descent(space.weights_at(space.weights_of(x)), members=(number,))


def given(problem: InverseProblem, start: Mapping[str, float | Mapping[str, float]]) -> Array:
    """The control vector (n,) of values of parameters, in their units; the others are at the prior's mean.

    ``start`` holds them, or those of data sets by name, of which the nearest by name is taken. Raises
    :class:`ConfigError`: a parameter that is not estimated, or a value where the prior has none.
    """
    prior, own = problem.prior, start
    if of_sets := {name: values for name, values in start.items() if isinstance(values, Mapping)}:
        own = of_sets[nearest(problem.observations.name, of_sets)]
    x, faults = np.array(prior.mean, dtype=float), []
    for name, value in own.items():
        try:
            j = prior.names.index(name)
            x[j] = prior.terms[j].from_physical(np.array(value))
        except ValueError as error:
            faults.append(Fault(str(error) if name in prior.names else f"{name}: not estimated", f"from.{name}"))
    if faults:
        raise ConfigError(faults)
    return x


def highest_plausible(space: WeightSpace) -> float:
    """The 99.95 % point of J at its minimum where model, prior and R are right: 2 J is χ²_K then (Talagrand 1999).

    To first order: with a noise scale or timing errors J also holds Σ β ln(s/std), and other members are tried earlier.
    """
    observations = space.problem.observations
    used = observations.weights[observations.used]
    return 0.5 * float(used.mean()) * diag.chi2_interval(float(len(used)))[1] if len(used) else np.inf


class Rounds(DataWindow):
    """Descents side by side that only have to tell which gets lowest, and where they end."""

    def __init__(
        self, space: WeightSpace, tell: Callable[[Record], None], known: tuple[Minimum, ...] = (),
        lowest: Descent | None = None,
    ):  # fmt: skip
        super().__init__(space, tell)
        self.known, self.rounds, self.plausible = known, 0, highest_plausible(space)
        bounded = np.any(sides_of(self.observations.noise))  # of flat J a rough end is anywhere
        self.rough = space.minimiser.cost_tolerance if bounded else ROUGH
        self.lowest = lowest or Descent(space.weights_at(np.zeros(len(space.members))))
        self.descents, self.minima = list[Descent](), list[Minimum]()

    def begin_round(self, descents: list[Descent]) -> None:
        """Beside the lowest so far, where that has not ended in a minimum."""
        unfinished = [self.lowest] if self.lowest.members and np.isfinite(self.lowest.cost) else []
        for descent in unfinished:
            descent.ended = False
        self.descents = [*unfinished, *descents]

    def end_round(self) -> bool:
        """Whether the comparison is over: enough descents agree on the lowest J, which noise and prior explain."""
        self.lowest = min(*self.descents, self.lowest, key=lambda descent: descent.cost)
        agreeing = len(self.lowest.members) or max((m.descents for m in merged(self.minima)[:1]), default=0)
        return agreeing >= AGREE and self.lowest.cost <= self.plausible

    def others(self) -> tuple[Minimum, ...]:
        """The minima but that of the lowest, which takes the members along."""
        minima = merged(self.minima)
        if self.lowest.members or not minima:
            return minima
        self.lowest.members, self.lowest.highest = minima[0].members, minima[0].cost + minima[0].spread
        return minima[1:]

    def judge(self, going: Sequence[Descent]) -> None:
        for descent in going:
            descent.ended = descent.step is None
        _end_those_that_met(going)
        for descent in going:
            x = self.space.control(descent.weights.w)
            if not descent.ended and any(minimum.distance(x) < REACHED for minimum in self.known):
                descent.ended = True
                self.end_here(descent)

    def search(self, descent: Descent) -> Search:
        return self.searched(descent)

    def move(self, going: Sequence[Descent], moves: Sequence[Move | None]) -> None:
        for descent, move in zip(going, moves, strict=True):
            step, before = descent.newton, descent.cost
            if move is not None:
                self.record(descent, step.hessian.economical_transform, move.step_length)
                descent.passed += ((step, before - step.predicted_decrease),)
                descent.weights, descent.cost = self.space.weights_at(move.w, step.hessian), move.cost
                rough = max(before - move.cost, step.predicted_decrease) <= self.rough * max(1.0, move.cost)
                descent.ended = rough or descent.iteration == self.space.minimiser.max_iterations
            else:
                descent.ended = True
            if descent.ended:
                self.end_here(descent)
        self.rounds += 1
        costs = tuple(descent.cost for descent in self.descents)
        self.tell(StartRecord(self.rounds, costs, sum(not descent.ended for descent in self.descents)))
        others = (self.lowest.cost, *(minimum.cost for minimum in self.known))
        if len(going) == 1 and going[0].cost <= min(*costs, *others, self.plausible):
            going[0].ended = True  # it can only go lower: the comparison is decided

    def end_here(self, descent: Descent) -> None:
        """A minimum, which takes over the members."""
        self.minima.append(Minimum.of(self.space, descent))
        descent.members = ()


def _end_those_that_met(descents: Sequence[Descent]) -> None:
    """Of descents within ``SAME`` of each other, in the metric of the lower one's Hessian, keep the lower one."""
    order = sorted(descents, key=lambda descent: descent.cost)
    for position, lower in enumerate(order):
        if lower.ended:
            continue
        for higher in order[position + 1 :]:
            if not higher.ended and lower.newton.hessian.norm(higher.weights.w - lower.weights.w) < SAME:
                lower.members, higher.members, higher.ended = (*lower.members, *higher.members), (), True
                lower.highest = max(lower.highest, higher.highest, higher.cost)
                lower.passed += higher.passed
