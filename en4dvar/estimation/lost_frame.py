"""Whether a frame was lost, or counted twice: all times from some reading on are one interval off.

A camera that drops a frame and numbers the others on dates all that follow one interval too early. Parameters that set
a period take this up, and an estimated discrepancy excuses what is left. So J is minimised anew with an interval added
to the times from reading k on, first with R held and hardly any discrepancy: a large one gives J other minima, in which
descents end, and the step in k is then hard to see. Every third k is tried, from the last reading back, then those
beside the best; the best two are descended again with nothing held. The mean of exp(J₀ − J_k) over all k, of which the
others count as zero, is the ratio of evidences but for the width of the posteriors. Where moved times leave a misfit,
errors count as large as that, since a step in time improves any wrong model somewhat.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from en4dvar.descent.loop import minimise
from en4dvar.descent.start import ROUGH, descent_at
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import DataWindow
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.honesty.checks import THERE
from en4dvar.estimation.stages import Stages
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution, codes
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.priors.varying.model import clock
from en4dvar.problem import InverseProblem

DOUBTS = {"misfit", "residual-structure", "odd-residuals", "discrepancy-found", "prior-conflict", "implausible-data"}
FEWEST = 8  # readings
EVEN = 0.05  # of an interval, by which times of frames may differ from multiples of it
STRIDE, FREED = 3, 2
SMALL = 0.1  # of the prior's median amplitude, and of an interval between the two readings of one frame
LIKELIER = 100.0


def lost_frame(stages: Stages, analysis: Analysis, mode: Array, cautions: Sequence[Caution]) -> tuple[Caution, ...]:
    """A caution where the data speak for a frame that was lost, or counted twice. Nothing is run where nothing else is
    doubtful and a discrepancy is small, the times are not those of frames or the model is not cheap.
    """
    problem, scheme, o = stages.problem, stages.minimiser, stages.problem.observations
    asked = stages.compares and stages.settings.what_if and problem.model.cheap
    doubtful = DOUBTS & set(codes(cautions)) or _discrepant(analysis)
    if not (asked and doubtful and scheme and scheme.searches and scheme.economical(stages.space.basis)):
        return ()
    if o.parts or len(o) < FEWEST:
        return ()
    interval, said = float(np.median(np.diff(o.times))), list[tuple[float, str]]()
    steps = np.diff(o.times) / interval
    if np.max(np.abs(steps - np.rint(steps))) > EVEN:
        return ()
    _, lowest = _descend(stages, problem, [mode])
    for share, seems in ((1.0, "early, as if a frame was lost"), (SMALL - 1, "late, as if a frame was counted twice")):
        costs = _costs(stages, mode, share * interval)
        left = np.array(list(costs.values()))
        gains = (lowest - left) / np.maximum(1.0, 2 * left / len(o.used))
        log_ratio = float(np.logaddexp.reduce(gains)) - math.log(len(o) - 1)
        if log_ratio > math.log(LIKELIER):
            k = min(costs, key=costs.__getitem__)
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


def _costs(stages: Stages, mode: Array, by: float) -> dict[int, float]:
    """J_k by k, of the best k's, where all times from reading k on are ``by`` later."""
    problem, prior = stages.problem, stages.problem.prior
    o, held = problem.observations, dict(zip(prior.names, prior.to_physical(prior.mean).tolist(), strict=True))
    for parameter in problem.discrepancy[:1]:
        held[parameter.name] = SMALL * held.get(parameter.name, problem.fixed.get(parameter.name, 0.0))
    free = [j for j, name in enumerate(prior.names) if name not in problem.of_errors]
    others = prior.of(tuple(prior.terms[j] for j in free))
    if not free:
        return {}
    fixed = {**problem.fixed, **{name: value for name, value in held.items() if name in problem.of_errors}}
    bare, at, costs = replace(problem, prior=others, fixed=fixed), {len(o): mode[free]}, dict[int, float]()

    def times(of: InverseProblem, k: int) -> InverseProblem:
        later = o.times + by * (np.arange(len(o)) >= k)
        return replace(of, observations=replace(o, times=later, continued=None))

    def screen(some: Sequence[int]) -> None:
        for k in (k for k in some if 0 < k < len(o) and k not in costs):
            near = at[min(j for j in at if j > k)]
            at[k], costs[k] = _descend(stages, times(bare, k), [near, at[len(o)]], ROUGH)

    screen(range(len(o) - 1, 0, -STRIDE))
    best = min(costs, key=costs.__getitem__)
    _, unmoved = _descend(stages, bare, [mode[free]], ROUGH)
    if not costs[best] < unmoved:
        return {}
    screen(range(best + STRIDE - 1, best - STRIDE, -1))
    freed = dict[int, float]()
    for k in sorted(costs, key=costs.__getitem__)[:FREED]:
        values = {**held, **dict(zip(others.names, others.to_physical(at[k]).tolist(), strict=True))}
        start = prior.from_physical(np.array([values[name] for name in prior.names]))
        _, freed[k] = _descend(stages, times(problem, k), [start, mode])
    return freed


def _descend(
    stages: Stages, problem: InverseProblem, starts: Sequence[Array], tolerance: float = 0.0
) -> tuple[Array, float]:
    """Where a descent from the best of ``starts`` leads, and J there; infinite where too few members survive."""
    assert stages.minimiser is not None
    own = replace(stages.minimiser, cost_tolerance=max(tolerance, stages.minimiser.cost_tolerance))
    space = WeightSpace(problem, replace(stages.settings, own=own), stages.seed, stages.executor)
    x = np.array(starts)
    descent = descent_at(space, x[np.argmin(space.costs(x, space.forecast(x)))], len(space.members) + 1)
    with suppress(TooFewMembersError):
        minimise(DataWindow(space), [descent])
    stages.space.forward_runs += space.forward_runs
    return space.control(descent.weights.w), descent.cost
