"""When an ensemble about one minimum of J leaves a doubt, and the sampled posterior that takes its place."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from en4dvar.descent.minima import Minimum
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.diagnosis import diagnostics as diag
from en4dvar.diagnosis.analysis import ChainRecord
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.plumbing.units import convert
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.problem import InverseProblem
from en4dvar.sampling import mcmc
from en4dvar.sampling.emulated_cost import needed_runs
from en4dvar.sampling.emulated_draws import RecordedRuns
from en4dvar.sampling.mixture import resampled
from en4dvar.sampling.modes import TOO_FEW, WeightedDraws, nearest, sample_modes
from en4dvar.sampling.shape import doubtful, guide
from en4dvar.schemes.settings import AssimilationSettings

COUNTS = math.log(1e-3)  # evidence of a minimum relative to that of the lowest, by Laplace, from which it may matter

MISSED = 0.5  # of J, by which a draw must be lower than all minima: another one is looked for there, or it is told
APART = 2.0  # standard deviations between modes of a parameter from which mean ± std describe none of them
SEEN = 0.02  # weight of a mode that is told
KEPT = 500  # draws of the posterior beside the members
OVERLAP = "no action is needed: mean ± std describe the members"


@dataclass(frozen=True)
class Refined:
    """Members (N, n), transformed, that take the ensemble's place, and what judges them.

    ``weights`` (M,) of the modes; ``log_evidence`` ln ∫ exp(−J_o) N(x; prior) dx, NaN where it is not known;
    ``lowest`` J that was met. ``draws`` (:data:`KEPT`, n) are equally likely; there are none of a chain. ``lower`` (n,)
    is a draw that lies lower than all minima; then nothing else was sampled.
    """

    members: Array
    summary: Mapping[str, float]
    weights: Array = field(default_factory=lambda: np.ones(1))
    log_evidence: float = math.nan
    lowest: float = math.inf
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))
    lower: Array | None = None
    warnings: tuple[Caution, ...] = ()


def that_count(minima: Sequence[Minimum], prior: Prior) -> tuple[Minimum, ...]:
    """The lowest, and the others that may hold some of the probability."""
    logs = [m.log_evidence(prior) for m in minima]
    return tuple(m for i, m in enumerate(minima) if i == 0 or logs[i] - logs[0] > COUNTS)


def mode_cautions(
    prior: Prior, minima: Sequence[Minimum], weights: Array, agree: bool, result: Refined | None
) -> Iterator[Caution]:
    """Warnings about the minima that count, of these weights; ``result`` is there where sampled."""
    lowest = minima[0].cost
    if result is not None and result.lowest < lowest - MISSED:
        words = f"a draw has J = {result.lowest:.1f}, lower than the lowest minimum that descents found, {lowest:.1f}"
        yield caution("starts-disagree", words)
    elif result is None and not agree:
        costs = ", ".join(f"{m.cost:.1f}" for m in minima[1:]) or "elsewhere"
        words = f"only one descent ended in the lowest minimum, J = {lowest:.1f}; others ended at {costs}"
        yield caution("starts-disagree", words)
    seen = [m for m, weight in zip(minima, weights, strict=True) if weight >= SEEN]
    if len(seen) < 2:
        return
    distances = _apart(seen)
    centres = [prior.to_physical(m.x) for m in seen]
    shares = " and ".join(f"{weight:.2f}" for weight in weights if weight >= SEEN)
    most = int(np.argmax(distances))
    p = prior.parameters[most]
    at = " and ".join(f"{convert(float(c[most]), p.unit, p.display_unit):.3g}" for c in centres)
    unit = "" if p.display_unit == "1" else f" {p.display_unit}"
    drawn = "members are drawn from all of them" if result else "members describe the first alone"
    words = f"the posterior has {len(seen)} modes, {p.name} = {at}{unit}, of weights {shares}; {drawn}"
    if result and not np.any(distances > APART):
        told = caution("several-modes", f"{words}, and overlap in every parameter", "note")
        yield replace(told, advice=OVERLAP)
        return
    names = tuple(name for j, name in enumerate(prior.names) if distances[j] > APART or j == most)
    yield caution("several-modes", words, None if result else "serious", names if result else ())


def _apart(minima: Sequence[Minimum]) -> Array:
    """(n,) the largest distance of two minima in each parameter, in the larger standard deviation of both."""
    at = np.array([m.x for m in minima])
    std = np.sqrt(np.array([np.diag(m.covariance) for m in minima]))
    between = np.abs(at[:, None] - at) / np.maximum(std[:, None], std)
    return np.asarray(between.max(axis=(0, 1)))


def samples(space: WeightSpace) -> bool:
    """True if a doubt is settled by sampling."""
    return may_sample(space.problem, space.settings) and space.basis.shape[1] == len(space.mean)


def may_sample(problem: InverseProblem, settings: AssimilationSettings) -> bool:
    """True if there is ``refine: auto`` with a cheap model of few parameters, all walks of which are estimated."""
    gaussian = problem.walks and not any(walk.spread for walk in problem.walks)
    few = needed_runs(len(problem.prior.names)) is not None and not gaussian
    return settings.refine == "auto" and problem.model.cheap and few and not settings.stochastic_model


def in_doubt(minima: Sequence[Minimum], agree: bool, shape: Mapping[str, float]) -> bool:
    """True if the Gaussian about the lowest of the minima that count may not be the posterior.

    ``agree``: whether descents from different members ended there. ``shape`` is that of
    :func:`~en4dvar.sampling.shape.examine_shape`.
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
    resume: Callable[[], mcmc.ChainState | None],
    keep: Callable[[mcmc.ChainState], None],
    look: Callable[[ChainRecord], None],
) -> Refined:
    """Members of the posterior that ``minima`` are the modes of, in place of ``posterior`` (N, n).

    By a Markov chain where the settings want one or weighted draws are too few. ``looking``: end at a draw that lies
    lower than all minima. ``resume`` is asked when the chain begins; it, ``keep``, ``look``: see
    :func:`~en4dvar.sampling.mcmc.sample`.
    """

    def cost(x: Array) -> Array:
        return space.costs(x, space.forecast(x))

    prior, exact, enough = space.problem.prior, space.settings.sampling == "exact", space.settings.draws
    chain = space.settings.refine == "mcmc"
    below = minima[0].cost - MISSED if looking and minima else -math.inf
    draws = None
    if len(minima) > 1 or not chain:  # the runs of these draws are kept; those of a chain would be too many
        recorded = RecordedRuns(space.forecast, space.costs, prior, space.problem.observations)
        drawn_by = cost if space.settings.emulator == "off" else recorded
        draws = sample_modes(drawn_by, prior, minima, seed, enough, below)
    if draws is not None and draws.lowest < below:
        return Refined(posterior, {}, lowest=draws.lowest, lower=draws.best)
    if draws is not None and not chain and draws.effective >= TOO_FEW:
        members = draws.members(len(posterior), member_stream(seed, "members of the modes"), exact)
        summary = _summary(draws, posterior)
        kept = draws.x[resampled(draws.shares, KEPT, member_stream(seed, "kept draws"))]
        return Refined(members, summary, draws.weights(len(minima)), draws.log_evidence, draws.lowest, kept)
    several = draws is not None and len(minima) > 1
    start = _in_all(minima, len(posterior), seed) if several else posterior
    emulated = None if several else guide(space, posterior, seed)
    walked = mcmc.sample(
        lambda x: -cost(x),
        start,
        seed,
        target=enough,
        resume=resume(),
        keep=keep,
        look=look,
        emulated=emulated,
        proposal=draws.proposal if several and draws is not None else None,
    )
    shares = shares_of(prior, minima, walked.flat) if several else np.ones(1)
    known = draws is not None and draws.effective >= TOO_FEW
    return Refined(
        walked.thin(len(posterior), exact),
        walked.summary(),
        shares,
        draws.log_evidence if draws is not None and known else math.nan,
        float(-walked.log_density.max()),
        warnings=() if walked.converged else (caution("chain-not-converged", walked.warning()),),
    )


def shares_of(prior: Prior, minima: Sequence[Minimum], draws: Array) -> Array:
    """(M,) shares of draws (D, n) that belong to each of M minima; 0 where the chain has left one."""
    return np.asarray(np.bincount(nearest(prior, minima, draws), minlength=len(minima)) / len(draws))


def _in_all(minima: Sequence[Minimum], count: int, seed: int) -> Array:
    """(N, n) draws about each minimum in turn."""
    normal = member_stream(seed, "start in all modes").standard_normal((count, len(minima[0].x)))
    roots = [np.linalg.cholesky(m.covariance) for m in minima]
    every = range(count)
    return np.stack([minima[i % len(minima)].x + roots[i % len(minima)] @ normal[i] for i in every])


def _summary(draws: WeightedDraws, posterior: Array) -> dict[str, float]:
    """The numbers that judge weighted draws, and how far they are from the ensemble they replace, for the result."""
    std = np.sqrt(np.diag(draws.covariance))
    moved = (draws.mean - posterior.mean(axis=0)) / std
    widened = np.log(std / posterior.std(axis=0, ddof=1))
    return {
        "importance_draws": len(draws.x),
        "importance_effective_sample_size": draws.effective,
        "importance_largest_shift": float(np.max(np.abs(moved))),
        "importance_largest_spread_ratio": float(np.exp(np.max(np.abs(widened)))),
    }
