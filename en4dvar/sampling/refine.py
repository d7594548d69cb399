"""When an ensemble about one minimum of J leaves a doubt, and the sampled posterior that takes its place.

The members' own J, known from the posterior forecast, clear most runs. Where they do not, and the model is cheap, an
emulator of J is fitted about the ensemble and sampled: its mean and standard deviations are those of the posterior
within about a tenth, and what they differ from the ensemble's is what a Markov chain would find
(benchmarks/gaussianity.py). A Gaussian that is too narrow draws no member where the tails of the posterior are, and a
tangent does not see what is elsewhere: members of the prior may, and as many runs twice as far out as members, or
along a way on which J hardly rises. Weighted, they tell mean and spread of any model.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from en4dvar.descent.beyond_gaussian import Drawn
from en4dvar.descent.minima import Minimum
from en4dvar.descent.preview import ITERATIONS, SEARCH
from en4dvar.descent.search import TOGETHER, WIDER
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import BEYOND_5, ChainRecord, Mode
from en4dvar.diagnosis.response.ledger import weighted_quantiles
from en4dvar.ensemble.forecast import Forecast
from en4dvar.ensemble.linalg import resampled, shares_of
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.problem import InverseProblem
from en4dvar.sampling import mcmc
from en4dvar.sampling.emulated_cost import Coordinates, EmulatedCost, ModelRuns, emulate, needed_runs
from en4dvar.sampling.emulated_draws import RecordedRuns
from en4dvar.sampling.ends import examine_ends
from en4dvar.sampling.modes import TOO_FEW, WeightedDraws, belonging, sample_modes, typical_runs
from en4dvar.schemes.settings import AssimilationSettings

COUNTS = math.log(1e-3)  # evidence of a minimum relative to that of the lowest, by Laplace, from which it may matter

MISSED = 0.5  # of J, by which a draw must be lower than all minima: another one is looked for there, or it is told
APART = 2.0  # standard deviations between modes of a parameter from which mean ± std describe none of them
SEEN = 0.02  # weight of a mode that is told
KEPT = 500  # draws of the posterior beside the members
CHAIN_FITS = 4  # of an emulator that has to guide a chain into the tails; two tell mean and spread
SHIFT, SPREAD = 0.25, 0.15  # of the ensemble, by the emulator, that leave a doubt: half of what is warned of
FAR = 2.0  # times as far out as the members
TINY = 1e-3  # standard error, or share that is left, below which none matters
ROUNDING = 1e-9  # of the standard deviation of all points: where one has all of the weight
ELSEWHERE = 0.5  # share of the posterior at members of the prior beyond the ensemble's own share there
CLEARED = 0.85  # effective share of the members above which no run was found that was off (docs: calibration)
LogDensity = Callable[[Array], Array]
Points = tuple[Array, Array, LogDensity]
"""(B, n), J (B,) of them and the logarithm of the density that they are drawn from, but for (2π)^(−n/2)."""
STILL_REACHING = "each round of draws reached farther along the posterior than the one before: its ends may be missing"
OVERLAP = "no action is needed: mean ± std describe the members"


def examine_shape(space: WeightSpace, ensemble: Array, fit: float, seed: int, settle: bool = True) -> dict[str, float]:
    """Numbers for :func:`~en4dvar.diagnosis.diagnostics.is_non_gaussian`, and its answer.

    Of the ``ensemble`` (N, n), transformed; ``fit``, the effective share of its members, is ``gaussian_fit`` of them.
    Deterministic in ``seed``. ``settle``: a doubt of the emulator's is looked into with more moves of its walkers.
    Where an emulator was needed there are ``mean_shift``, the largest distance of the ensemble's mean from the
    posterior's in posterior standard deviations, ``spread_ratio``, the standard deviation of the ensemble over the
    posterior's where that is farthest from 1, ``emulator_fit``, and
    ``emulated_mean_<name>``, ``emulated_std_<name>`` of each parameter, physical and SI.
    """
    numbers = {"gaussian_fit": fit}
    if fit < CLEARED:
        emulator = guide(space, ensemble, seed, fits=2)
        if emulator is not None:
            off = _off(emulator, ensemble)
            if settle and doubtful(off):  # by walkers that have not settled, as often as not
                emulator = emulator.settled(member_stream(seed, "emulator, settled"))
                off = _off(emulator, ensemble)
            numbers |= {**off, "emulator_fit": emulator.share}
            theta, names = space.problem.prior.to_physical(emulator.draws), space.problem.prior.names
            for what, values in (("mean", theta.mean(axis=0)), ("std", theta.std(axis=0))):  # of G, not of ln G
                numbers |= {f"emulated_{what}_{name}": float(v) for name, v in zip(names, values, strict=True)}
    doubted = any(walk.spread for walk in space.problem.walks)
    doubted |= bool(space.settings.own.approximate) and fit < CLEARED
    return {**numbers, "non_gaussian": diag.is_non_gaussian(numbers, doubted)}


def examine_tails(
    space: WeightSpace,
    minimum: Minimum,
    ensemble: Array,
    before: Forecast,
    after: Forecast,
    always: bool,
    drawn: Drawn | None = None,
) -> dict[str, float]:
    """How far mean, standard deviation and ends of the ensemble (N, n) about a minimum are from the posterior's in what
    is printed.

    By members of J known by their forecast ``after``, those of the prior by that ``before``, runs along each parameter
    and, ``always`` or where members leave a doubt or J rises too little along a parameter, as many runs :data:`FAR`
    times as far out as the members. Points are weighted with the density that they are drawn from, for the posterior
    and for that of the ensemble, which is Gaussian unless it was ``drawn`` otherwise: where it is the posterior both
    weights are the same, whatever the points are.
    ``tail_shift`` is the largest distance of both means in posterior standard deviations, ``tail_ratio`` the standard
    deviation of the ensemble over the posterior's where that is farthest from 1, ``tail_excess`` by how many standard
    errors of theirs a distance or ratio is beyond :data:`SHIFT` or :data:`SPREAD`. ``tail_mean_<name>``,
    ``tail_std_<name>`` are those of a parameter that is surely off by what is warned of, NaN where ``tail_members``,
    the effective number of the points, is below :data:`TOO_FEW` to say to what.
    ``tail_elsewhere``: most of the posterior is where the ensemble is not. ``tail_end`` is the largest distance of a 5
    or 95 % point of that density and of members from those of :func:`~en4dvar.sampling.ends.examine_ends`, in posterior
    standard deviations, and ``tail_q05_<name>``, ``tail_q95_<name>`` are the points of a parameter where that is what
    is warned of; there are none where J of all members is what that density says. Nothing of an ensemble without a
    covariance.
    """
    weighed: dict[str, float] = {}
    with suppress(np.linalg.LinAlgError):
        prior, own = space.problem.prior, _of_drawn(drawn, space.problem.prior) if drawn else _gaussian(ensemble)
        costs, before_costs = space.costs(ensemble, after), space.costs(space.members, before)
        parts: list[Points] = [(ensemble, costs, own), (space.members, before_costs, _gaussian(space.members))]
        weighed = _by_weights(prior, parts)
        runs = ModelRuns.of(ensemble, after, costs).joined(ModelRuns.of(space.members, before, before_costs))
        ends = examine_ends(space, minimum, ensemble, runs, drawn)
        if always or weighed["tail_excess"] > 0 or (ends and not ends.rises):
            mean, wider = ensemble.mean(axis=0), len(prior.names) * math.log(FAR)
            x = mean + FAR * (ensemble - mean)
            farther = x, space.costs(x, space.forecast(x)), lambda x: own(mean + (x - mean) / FAR) - wider
            weighed = _by_weights(prior, [*parts, farther])
        if ends:
            weighed["tail_end"] = float(ends.off.max())
            for j in np.flatnonzero(ends.off > diag.ENDS_OFF):
                of_it = {"q05": ends.quantiles[0, j], "q95": ends.quantiles[-1, j]}
                weighed |= {f"tail_{q}_{prior.names[j]}": float(value) for q, value in of_it.items()}
    return weighed


def _gaussian(points: Array) -> LogDensity:
    coordinates = Coordinates.about(points)
    log_root = float(np.sum(np.log(np.diag(coordinates.root))))
    return lambda x: np.asarray(-0.5 * np.sum(coordinates.of(x) ** 2, axis=1) - log_root)


def _of_drawn(drawn: Drawn, prior: Prior) -> LogDensity:
    return lambda x: -drawn.cost(x) - drawn.log_evidence - prior.log_det_root


def _by_weights(prior: Prior, parts: Sequence[Points]) -> dict[str, float]:
    """The numbers of :func:`examine_tails`, of the ensemble, the prior's members and others.

    The posterior is that of the prior's members, which the ensemble stands for where they are drawn at random, too.
    Few weights may be most of the posterior, which their errors say. Where that is at members of the prior which the
    ensemble does not reach, it is elsewhere, however few these are: a model with steps, of which a bundle sees one.
    """
    points, of_points, densities = zip(*parts, strict=True)
    x, costs = np.concatenate(points), np.concatenate(of_points)
    logs = [log_density(x) for log_density in densities]
    drawn, theta = np.logaddexp.reduce(logs), prior.to_physical(x)
    likelihood = prior.cost(x) - costs
    shares, its_shares = shares_of(likelihood + logs[1] - drawn), shares_of(logs[0] - drawn)
    mean, std, at, wide = _moments(theta, shares)
    its_mean, its_std, its_at, its_wide = _moments(theta, its_shares)
    begin, end = np.cumsum([len(part) for part in points[:2]])
    elsewhere = np.sum((shares - its_shares)[begin:end]) > ELSEWHERE  # where the ensemble does not reach
    shift, ratio = np.abs(its_mean - mean) / std, its_std / std
    off = np.array([shift - SHIFT, np.abs(np.log(ratio)) - math.log1p(SPREAD)])
    errors = 0.0 if elsewhere else np.linalg.norm([(at - its_at) / std, wide - its_wide], axis=1)
    excess = np.max(off / np.maximum(errors, TINY), axis=0)
    weighed = {
        "tail_shift": float(np.max(shift)),
        "tail_ratio": float(ratio[np.argmax(np.abs(np.log(ratio)))]),
        "tail_excess": max(0.0, float(np.max(excess))),
        "tail_members": float(1 / np.sum(shares**2)),
        "tail_elsewhere": bool(elsewhere),
    }
    known = np.array([mean, std]) if weighed["tail_members"] >= TOO_FEW else np.full((2, len(mean)), np.nan)
    sure = (excess > diag.SURE) & ((shift > diag.MEAN_OFF) | (np.abs(ratio - 1) > diag.SPREAD_OFF))
    for j in np.flatnonzero(sure):
        weighed |= {
            f"tail_{what}_{prior.names[j]}": float(v) for what, v in zip(("mean", "std"), known[:, j], strict=True)
        }
    return weighed


def _moments(theta: Array, shares: Array) -> tuple[Array, Array, Array, Array]:
    """Mean and standard deviation (n,) of points (B, n) of ``shares`` (B,), and by what (B, n) mean and logarithm of
    the standard deviation differ without each point, the latter to first order: their jackknife.
    """
    mean, left = shares @ theta, shares / np.maximum(1 - shares, TINY)
    squares = (theta - mean) ** 2
    std = np.maximum(np.sqrt(shares @ squares), ROUNDING * theta.std(axis=0))
    return mean, std, left[:, None] * (theta - mean), 0.5 * left[:, None] * (squares / std**2 - 1)


def doubtful(shape: Mapping[str, float]) -> bool:
    """True if mean or spread of the ensemble are off by half of what is warned of, by the emulator or, by more than
    their standard error, by weights, or an end of its Gaussian by what is warned of.
    """
    off = shape.get("mean_shift", 0.0) > SHIFT or abs(shape.get("spread_ratio", 1.0) - 1) > SPREAD
    return off or shape.get("tail_excess", 0.0) > 1 or shape.get("tail_end", 0.0) > diag.ENDS_OFF


def _off(emulator: EmulatedCost, ensemble: Array) -> dict[str, float]:
    """How far an ensemble (N, n) is from the emulator's draws."""
    shift, ratio = diag.off(ensemble, emulator.draws.mean(axis=0), emulator.draws.std(axis=0))
    return {"mean_shift": shift, "spread_ratio": ratio}


def guide(space: WeightSpace, ensemble: Array, seed: int, fits: int = CHAIN_FITS) -> EmulatedCost | None:
    """An emulator of J about an ensemble (N, n); None where the settings or the model forbid."""
    if not _emulates(space.problem, space.settings):
        return None
    return emulate(space.forecast, space.problem, ensemble, member_stream(seed, "emulator"), fits)


def _emulates(problem: InverseProblem, settings: AssimilationSettings) -> bool:
    return settings.emulator != "off" and (settings.emulator != "auto" or problem.model.compiled)


@dataclass(frozen=True)
class Refined:
    """Members (N, n), transformed, that take the ensemble's place, and what judges them.

    ``modes``: of each minimum, and each group of draws without one, the weight, the quantiles (3, n) of the draws that
    belong to it, NaN where none does, and the lowest J of these;
    ``log_evidence`` ln ∫ exp(−J_o) N(x; prior) dx, NaN where it is not known;
    ``lowest`` J that was met, at ``best`` (n,) where a chain met it. ``draws`` (:data:`KEPT`, n) are equally likely;
    there are none of a chain. ``lower`` (n,) is a draw that lies lower than all minima; then nothing else was sampled.
    """

    members: Array
    summary: Mapping[str, float]
    modes: Sequence[tuple[float, Array, float]] = ()
    log_evidence: float = math.nan
    lowest: float = math.inf
    best: Array = field(default_factory=lambda: np.empty(0))
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))
    lower: Array | None = None
    warnings: tuple[Caution, ...] = ()


def that_count(minima: Sequence[Minimum], prior: Prior, beyond: float = COUNTS) -> tuple[Minimum, ...]:
    """The lowest, and the others that may hold some of the probability, of evidence ``beyond`` that of the lowest."""
    logs = [m.log_evidence(prior) for m in minima]
    return tuple(m for i, m in enumerate(minima) if i == 0 or logs[i] - logs[0] > beyond)


def mode_cautions(
    prior: Prior, minima: Sequence[Minimum], modes: Sequence[Mode], settled: bool, result: Refined | None
) -> Iterator[Caution]:
    """Warnings about the minima that count, and the ``modes`` about them; ``result`` is there where sampled.

    ``settled``: whether the search for the lowest of them is. Where not sampled, the first is the one that members
    describe, which counts however little of the probability it holds: the lowest may be the narrowest.
    """
    lowest = minima[0].cost
    if result is not None and result.lowest < lowest - MISSED:
        words = f"a draw has J = {result.lowest:.1f}, lower than the lowest minimum that descents found, {lowest:.1f}"
        yield caution("starts-disagree", words)
    elif not settled:
        costs = ", ".join(f"{m.cost:.1f}" for m in minima[1:])
        others = f"others ended at {costs}" if costs else "the others came to no minimum"
        number = "one descent" if minima[0].descents < 2 else f"{minima[0].descents} descents"
        yield caution("starts-disagree", f"only {number} ended in the lowest minimum, J = {lowest:.1f}; {others}")
    seen = [m for i, m in enumerate(modes) if m.weight >= SEEN or (i == 0 and result is None)]
    if len(seen) < 2:
        return
    distances = _apart(prior, seen)
    shares = " and ".join(f"{m.weight:.2f}" for m in seen)
    most = int(np.argmax(distances))
    p = prior.parameters[most]
    at = " and ".join(f"{convert(float(m.centre[most]), p.unit, p.display_unit):.3g}" for m in seen)
    unit = unit_after(p.display_unit)
    drawn = "members are drawn from all of them" if result else "members describe only the first"
    words = f"the posterior has {len(seen)} modes, {p.name} = {at}{unit}, of weights {shares}; {drawn}"
    if result and not np.any(distances > APART):
        yield replace(caution("several-modes", f"{words}, and overlap in every parameter", "note"), advice=OVERLAP)
        return
    names = tuple(name for j, name in enumerate(prior.names) if distances[j] > APART or j == most)
    yield caution("several-modes", words, None if result else "serious", names if result else ())


def _apart(prior: Prior, modes: Sequence[Mode]) -> Array:
    """(n,) the largest distance of two modes in each parameter, in the larger standard deviation of both."""
    at, low, high = (
        prior.from_physical(np.array([getattr(m, key) for m in modes])) for key in ("centre", "q05", "q95")
    )
    std = (high - low) / (2 * BEYOND_5)
    return np.asarray((np.abs(at[:, None] - at) / np.maximum(std[:, None], std)).max(axis=(0, 1)))


def weighs(space: WeightSpace) -> bool:
    """True if J of single members tells of doubts with ``refine: auto``."""
    auto = space.settings.refine == "auto" and not space.settings.stochastic_model
    return auto and space.basis.shape[1] == len(space.mean)


def samples(space: WeightSpace) -> bool:
    """True if a doubt is settled by sampling."""
    return may_sample(space.problem, space.settings) and weighs(space)


def may_sample(problem: InverseProblem, settings: AssimilationSettings) -> bool:
    """True if there is ``refine: auto`` with a cheap model of few parameters, all walks of which are estimated."""
    gaussian = problem.walks and not any(walk.spread for walk in problem.walks)
    few = needed_runs(len(problem.prior.names)) is not None and not gaussian
    return settings.refine == "auto" and problem.model.cheap and few and not settings.stochastic_model


def runs_of_doubt(problem: InverseProblem, settings: AssimilationSettings) -> int:
    """Forward runs that a doubt takes, typically, where it may be settled by sampling: draws of the prior and a round
    of descents from them, an emulator of J, and all rounds of sampling.
    """
    n = len(problem.prior.names)
    wanted = needed_runs(n) if _emulates(problem, settings) else None
    emulator = 2 * wanted[1] if wanted else 0
    descents = TOGETHER * ITERATIONS * (1 + n + SEARCH)
    return WIDER * settings.members + descents + emulator + typical_runs(n, settings.draws)


def in_doubt(minima: Sequence[Minimum], agree: bool, shape: Mapping[str, float]) -> bool:
    """True if the Gaussian about the lowest of the minima that count may not be the posterior.

    ``agree``: whether descents from different members ended there. ``shape`` is that of :func:`examine_shape`.
    """
    unclear = shape.get("emulator_fit", 1.0) < diag.EMULATED_ENOUGH
    return not agree or len(minima) > 1 or bool(shape.get("non_gaussian")) or doubtful(shape) or unclear


def refined(
    space: WeightSpace,
    posterior: Array,
    minima: Sequence[Minimum],
    seed: int,
    *,
    looking: bool,
    look: Callable[[ChainRecord], None],
) -> Refined:
    """Members of the posterior that ``minima`` are the modes of, in place of ``posterior`` (N, n).

    By a Markov chain where the settings want one or weighted draws are too few. ``looking``: end at a draw that lies
    lower than all minima. ``look``: see :func:`~en4dvar.sampling.mcmc.sample`.
    """

    def cost(x: Array) -> Array:
        return space.costs(x, space.forecast(x))

    prior, exact, enough = space.problem.prior, space.settings.sampling == "exact", space.settings.draws
    chain = space.settings.refine == "mcmc"
    below = minima[0].cost - MISSED if looking and minima else -math.inf
    draws = None
    if len(minima) > 1 or not chain:  # the runs of these draws are kept; those of a chain would be too many
        recorded = RecordedRuns(space.forecast, space.problem)
        drawn_by = cost if space.settings.emulator == "off" else recorded
        draws = sample_modes(drawn_by, prior, minima, seed, enough, below)
    if draws is not None and draws.lowest < below:
        return Refined(posterior, {}, lowest=draws.lowest, lower=draws.best)
    if draws is not None and not chain and draws.effective >= TOO_FEW:
        members = draws.members(len(posterior), member_stream(seed, "members of the modes"), exact)
        summary = _summary(draws, posterior)
        kept = draws.x[resampled(draws.shares, KEPT, member_stream(seed, "kept draws"))]
        own = _own_draws(draws.x, draws.shares, draws.mode, draws.costs, len(minima))
        told = () if draws.settled else (caution("chain-not-converged", STILL_REACHING),)
        return Refined(members, summary, own, draws.log_evidence, draws.lowest, draws=kept, warnings=told)
    several = len(minima) > 1  # then there are draws
    start = _in_all(minima, len(posterior), seed) if several else posterior
    emulated = None if several else guide(space, posterior, seed)
    walked = mcmc.sample(
        lambda x: -cost(x),
        start,
        seed,
        target=enough,
        look=look,
        emulated=emulated,
        proposal=draws.proposal if draws and several else None,
    )
    equal = np.full(len(walked.flat), 1 / len(walked.flat))
    for_one = max(1.0, len(equal) / float(walked.effective.min()))
    mode = belonging(prior, minima, walked.flat, equal, for_one)
    return Refined(
        walked.thin(len(posterior), exact),
        walked.summary(),
        _own_draws(walked.flat, equal, mode, -walked.log_density.ravel(), len(minima)),
        draws.log_evidence if draws and draws.effective >= TOO_FEW else math.nan,
        float(-walked.log_density.max()),
        walked.flat[np.argmax(walked.log_density)],
        warnings=() if walked.converged else (caution("chain-not-converged", walked.warning()),),
    )


def _own_draws(x: Array, shares: Array, mode: Indices, costs: Array, count: int) -> list[tuple[float, Array, float]]:
    """Of each of ``count`` modes, and those beyond them, what :attr:`Refined.modes` says, of draws (D, n) of J
    ``costs`` (D,).
    """
    own = []
    for number in range(max(count, int(mode.max()) + 1) if count else 0):
        there = mode == number
        weight = float(shares[there].sum())
        of = shares[there] / weight if weight else np.array([np.nan])
        values = x[there] if weight else np.full((1, x.shape[1]), np.nan)
        quantiles = np.stack([weighted_quantiles(column, of) for column in values.T], axis=1)
        own.append((weight, quantiles, float(costs[there].min(initial=np.inf))))
    return own


def _in_all(minima: Sequence[Minimum], count: int, seed: int) -> Array:
    """(N, n) draws about each minimum in turn."""
    normal = member_stream(seed, "start in all modes").standard_normal((count, len(minima[0].x)))
    about = [(m.x, np.linalg.cholesky(m.covariance)) for m in minima]
    return np.stack([x + root @ z for z, (x, root) in zip(normal, itertools.cycle(about), strict=False)])


def _summary(draws: WeightedDraws, posterior: Array) -> dict[str, float]:
    """The numbers that judge weighted draws, and how far they are from the ensemble they replace, for the result."""
    shift, ratio = diag.off(posterior, draws.mean, np.sqrt(np.diag(draws.covariance)))
    return {
        "importance_draws": len(draws.x),
        "importance_effective_sample_size": draws.effective,
        "importance_largest_shift": shift,
        "importance_largest_spread_ratio": max(ratio, 1 / ratio),
    }
