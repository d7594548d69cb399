"""Whether a frame was lost, or counted twice: all times from some reading on are one interval off.

A camera that drops a frame and numbers the others on dates all that follow one interval too early. Parameters that set
a period take this up, and an estimated discrepancy excuses what is left. So J is minimised anew with an interval added
to the times from reading k on. Which k, is found with errors held and independent (a discrepancy gives J other minima,
in which descents end, and hides the step), and with what all data sets have in common held.

Descents at every third k cost a fifth of the estimate. But readings that all lie before k, or all after it, have no
step between them: fits to the first half, to the first three quarters and, all times moved, to the last two fifths lead
near the minimum at every k that lies on the other side. One reading on the wrong side can lead far away, so that halves
would not do. From there two linearisations, one with no time moved and one with all, tell how low J_k gets for each of
these k, as far as it is quadratic. Descents follow where that promises most, and J of the problem itself is minimised
with the best k if it is low enough there. The mean of exp(J₀ − J_k) over all k, of which those far from the best count
as zero, is the ratio of evidences but for the width of the posteriors. Where moved times leave a misfit, errors count
as large as that, since a step in time improves any wrong model somewhat.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np

from en4dvar.data.noise import noise_of
from en4dvar.descent.loop import minimise
from en4dvar.descent.start import ROUGH, descent_at
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.honesty.checks import THERE
from en4dvar.estimation.stages import Stages, control_of, values_of
from en4dvar.model.state import TIME_SHIFT, Array, Mask
from en4dvar.plumbing.caution import Caution, caution, codes
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.priors.varying.model import clock
from en4dvar.problem import InverseProblem
from en4dvar.schemes.base import Minimiser

DOUBTS = {"misfit", "residual-structure", "odd-residuals", "discrepancy-found", "prior-conflict", "implausible-data"}
FEWEST = 8  # readings
EVEN = 0.05  # of an interval, by which times of frames may differ from multiples of it
FIRST, LAST = (0.75, 0.5), 0.6  # of the readings, up to which and from which on they are fitted by themselves
TRIED, ITERATIONS = 3, 6  # descents in search of k, and iterations of each of them
BESIDE = 3  # readings about a k whose J is known from the descent there
BELIEVED = 0.1  # of J: a promise of less comes from a place where J is not quadratic
SMALL = 0.1  # of the prior's median amplitude, and of an interval between the two readings of one frame
LIKELIER = 100.0


def lost_frame(stages: Stages, analysis: Analysis, mode: Array, cautions: Sequence[Caution]) -> tuple[Caution, ...]:
    """A caution where the data speak for a frame that was lost, or counted twice. Nothing is run where nothing else is
    doubtful and a discrepancy is small, the times are not those of frames or the model is not cheap.
    """
    problem, scheme, o = stages.problem, stages.minimiser, stages.problem.observations
    asked = stages.compares and problem.model.cheap and (DOUBTS & set(codes(cautions)) or _discrepant(analysis))
    if not (asked and scheme and scheme.searches and scheme.economical(stages.space.basis)):
        return ()
    if o.parts or len(o) < FEWEST:
        return ()
    interval, said = float(np.median(np.diff(o.times))), list[tuple[float, str]]()
    steps = np.diff(o.times) / interval
    if np.max(np.abs(steps - np.rint(steps))) > EVEN:
        return ()
    search = _Search(stages, mode)
    for share, seems in ((1.0, "early, as if a frame was lost"), (SMALL - 1, "late, as if a frame was counted twice")):
        k, log_ratio = search.likeliest(share * interval)
        if log_ratio > math.log(LIKELIER):
            after, size = (clock(problem.model, float(time)) for time in (o.file_times[k - 1], interval))
            words = f"after the reading at {after}, or one beside it, all times seem one interval ({size}) too {seems}"
            said.append((log_ratio, f"{words}: without that the readings are e^{log_ratio:.1f} times likelier"))
    return (caution("lost-frame", max(said)[1]),) if said else ()


def _discrepant(analysis: Analysis) -> bool:
    """Whether half of the members have a discrepancy that, if more of them had it, would be warned of."""
    sizes = [
        analysis.posterior[:, j] for j, p in enumerate(analysis.parameters) if p in analysis.problem.discrepancy[:1]
    ]
    return any(np.nanmedian(size) > THERE * np.median(analysis.own_std) for size in sizes)


class _Search:
    """For the reading from which on times are moved; ``mode`` (n,) is that of J with none moved."""

    def __init__(self, stages: Stages, mode: Array):
        problem, prior, o = stages.problem, stages.problem.prior, stages.problem.observations
        assert stages.minimiser is not None
        self.stages, self.own, self.mode = stages, stages.minimiser, mode
        self.values, usual = values_of(prior, mode), {**problem.fixed, **values_of(prior, prior.mean)}
        self.values |= {name: usual[name] for name in problem.of_errors & {*prior.names}}
        self.values |= {p.name: SMALL * usual[p.name] for p in problem.discrepancy[:1] if p.name in self.values}
        self.free = [j for j, p in enumerate(prior.parameters) if not (p.common or p.name in problem.of_errors)]
        own = prior.of(tuple(prior.terms[j] for j in self.free))
        fixed = {name: value for name, value in {**usual, **self.values}.items() if name not in own.names}
        noise = o.noise if o.noise.independent else noise_of(o.noise.std, o.noise.time_std)
        self.bare = replace(problem, prior=own, fixed=fixed, observations=replace(o, noise=noise, continued=None))

    def likeliest(self, by: float) -> tuple[int, float]:
        """The k from which on all times are likeliest to be ``by`` later, and the logarithm of the ratio; -inf where
        the search finds no reason to ask for it.
        """
        if not self.free:
            return 0, -math.inf
        (start, unmoved), count = self.unmoved, len(self.bare.observations)
        spaces = [self._space(of) for of in (self.bare, _later(self.bare, by, 1))]
        promised = dict[int, tuple[float, Array]]()

        def look(x: Array, some: Sequence[int], anew: bool = True) -> None:
            costs, lowest = _quadratic(spaces, x)
            believed = np.minimum(costs, np.maximum(lowest, BELIEVED * costs))
            for k in some:
                if anew or not promised.get(k, (math.inf, x))[0] <= believed[k - 1]:
                    promised[k] = float(believed[k - 1]), x

        for begin, end, x in self.firsts:
            look(x, range(begin, end))
        begin = int(LAST * count)
        after = _among(spaces[1].problem, np.arange(count) >= begin)
        x, _ = self._descend(after, [self._shifted(x, by - other) for other, x in self.lasts], ROUGH, ITERATIONS)
        self.lasts.append((by, x))
        look(x, range(1, begin + 1), anew=False)
        ends, best = dict[int, tuple[float, Array]](), unmoved - math.log(LIKELIER)
        while len(ends) < TRIED:
            k = min(promised.keys() - ends.keys(), key=lambda k: promised[k][0])
            if not promised[k][0] < best:
                break
            x, cost = self._descend(_later(self.bare, by, k), [promised[k][1], start], ROUGH, ITERATIONS)
            ends[k], best = (cost, x), min(best, cost)
            look(x, range(max(k - BESIDE, 1), min(k + BESIDE + 1, count)))
        self.stages.space.forward_runs += sum(space.forward_runs for space in spaces)
        k = min(ends, key=lambda k: ends[k][0], default=0)
        lowest, x = ends.get(k, (math.inf, start))
        if not (lowest < unmoved and self._gain(unmoved, np.array(lowest)) > math.log(LIKELIER)):
            return k, -math.inf
        beside = np.array([cost for j, (cost, _) in promised.items() if abs(j - k) <= BESIDE])
        unmoved, moved = self._freed(0.0, k, start), self._freed(by, k, x)
        gains = self._gain(unmoved, moved + np.maximum(beside - lowest, 0.0))
        return k, float(np.logaddexp.reduce(gains)) - math.log(count - 1)

    @cached_property
    def unmoved(self) -> tuple[Array, float]:
        return self._descend(self.bare, [self.mode[self.free]], ROUGH)

    @cached_property
    def firsts(self) -> list[tuple[int, int, Array]]:
        """Where fits to the first readings lead, and the k from which on, and up to which, this is the best place."""
        x, end, fits = self.unmoved[0], len(self.bare.observations), list[tuple[int, int, Array]]()
        readings = np.arange(end)
        for begin in [int(share * end) for share in FIRST]:
            x, _ = self._descend(_among(self.bare, readings < begin), [x], ROUGH, ITERATIONS)
            fits.append((begin, end, x))
            end = begin
        return fits

    @cached_property
    def lasts(self) -> list[tuple[float, Array]]:
        """Where fits to the last readings have led, and by how much later these were."""
        return [(0.0, self.unmoved[0])]

    def _shifted(self, x: Array, by: float) -> Array:
        """The same with a clock that takes ``by`` off, where one is estimated."""
        values = values_of(self.bare.prior, x)
        values[TIME_SHIFT.name] = values.get(TIME_SHIFT.name, 0.0) - by
        return control_of(self.bare.prior, values)

    def _freed(self, by: float, k: int, at: Array) -> float:
        """J of the problem itself at its minimum, found from where what is free is as in ``at``, or from the mode."""
        start = control_of(self.stages.problem.prior, self.values | values_of(self.bare.prior, at))
        return self._descend(_later(self.stages.problem, by, k), [start, self.mode])[1]

    def _gain(self, unmoved: float, costs: Array) -> Array:
        return (unmoved - costs) / np.maximum(1.0, 2 * costs / len(self.bare.observations.used))

    def _space(self, problem: InverseProblem, own: Minimiser | None = None) -> WeightSpace:
        settings = replace(self.stages.settings, own=own or self.own)
        return WeightSpace(problem, settings, self.stages.seed, self.stages.executor)

    def _descend(
        self, problem: InverseProblem, starts: Sequence[Array], tolerance: float = 0.0, most: int = 10**6
    ) -> tuple[Array, float]:
        """Where a descent from the best of ``starts`` leads, and J there; infinite where too few members survive."""
        tolerance, most = max(tolerance, self.own.cost_tolerance), min(most, self.own.max_iterations)
        own, x = replace(self.own, cost_tolerance=tolerance, max_iterations=most), np.array(starts)
        space = self._space(problem, own)
        descent = descent_at(space, x[np.argmin(space.costs(x, space.forecast(x)))], len(space.members) + 1)
        with suppress(TooFewMembersError):
            minimise(DataWindow(space), [descent])
        self.stages.space.forward_runs += space.forward_runs
        return space.control(descent.weights.w), descent.cost


def _later(problem: InverseProblem, by: float, k: int) -> InverseProblem:
    """With the times of all readings from k on ``by`` later."""
    o = problem.observations
    times = o.times + by * (np.arange(len(o)) >= k)
    return replace(problem, observations=replace(o, times=times, continued=None))


def _among(problem: InverseProblem, where: Mask) -> InverseProblem:
    """With the weights of all other readings zero."""
    o = problem.observations
    return replace(problem, observations=replace(o, weights=np.where(where, o.weights, 0.0)))


def _quadratic(spaces: Sequence[WeightSpace], x: Array) -> tuple[Array, Array]:
    """J_k (K − 1,) of k = 1, 2, … at x (n,), and how low it gets as far as it is quadratic, where readings before k are
    those of the first of ``spaces`` and all others of the second; infinite where too few members survive.
    """
    sums = list[tuple[Array, Array, Array]]()
    for space in spaces:
        descent, o = Descent(space.weights_at(space.weights_of(x))), space.problem.observations
        if DataWindow(space).linearise([descent])[0] is None or (linear := descent.iterate.linear) is None:
            nowhere = np.full(len(o) - 1, math.inf)
            return nowhere, nowhere
        d, S = (part.reshape(-1, len(o), *part.shape[1:]) for part in o.whiten(linear))
        each = -o.weights * o.log_likelihood(linear.prediction)
        sums.append((each, np.einsum("mk,mkr->kr", d, S), np.einsum("mkr,mks->krs", S, S)))
    before, after = ([np.cumsum(part, axis=0) for part in of] for of in sums)
    J, slope, curvature = (a[:-1] + b[-1] - b[:-1] for a, b in zip(before, after, strict=True))
    c, precision = space.basis.T @ descent.weights.w, len(space.members) - 1.0
    J, gradient = J + 0.5 * precision * c @ c - o.log_normalisation(), precision * c - slope
    steps = np.linalg.solve(curvature + precision * np.eye(len(c)), gradient[..., None])[..., 0]
    return J, J - 0.5 * np.sum(gradient * steps, axis=1)
