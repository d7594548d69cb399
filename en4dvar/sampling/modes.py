"""The posterior as a mixture of its modes: weighted draws about every minimum that descents ended in, and the prior.

Importance weights against J correct what the Gaussians about the minima are not, so that the weight of a mode is its
share of the evidence, whatever its shape.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.descent.minima import Minimum
from en4dvar.ensemble.linalg import effective_number, resampled
from en4dvar.model.state import Array, Indices, Mask
from en4dvar.priors.prior import Prior, member_stream
from en4dvar.sampling.alike import LEAST, POOL, standing_for
from en4dvar.sampling.emulated_draws import EmulatedProposal, RecordedRuns
from en4dvar.sampling.importance import ClosingDraws, FixedDraws, Importance
from en4dvar.sampling.mixture import StudentMixture

DRAWS = 400  # of a round
HEATS = (8.0, 4.0, 2.0, 1.5)  # of the rounds that train an emulator
LAST_HEAT = 1.15  # of those that judge it: draws reach a little beyond what it says
TRIED, MOST_TRIED = 4, 20  # such rounds, at most, and as long as the evidence
RISEN = 0.06  # rises by so much within two rounds: each reaches farther along a valley; otherwise that is 0.05 at most;
GOOD = 0.25  # the effective share of one that ends them,
HOPELESS = 0.25  # and that, times the share of the mixture, below which none that follows is good enough
ENOUGH, MOST_RUNS = 1500.0, 8.0  # effective draws that end the rounds, and runs for each of them
LAST_RUNS = 30.0  # for each, as long as too few are effective
CLOSING = (2, 3, 6)  # rounds in which proposals close in, at least: two, and one for three directions, up to six
WIDER = 1.8  # at 1 the tail of a bent posterior is not found: standard deviations were up to half too small
FEW = 6  # directions up to which that is the factor of each; of more it is smaller, and their volume grows no further
THIN = 0.25  # effective share of draws of a mixture below which the posterior is drawn by an emulator
TOO_FEW = 60.0  # below so many the draws stand for nothing
ALONG, NEAR, VALLEY = np.linspace(0, 1, 17), 0.125, 0.5  # windows between modes, and the share of draws of a valley
GAP, CHANCE = 4.0, 1e-4  # width of a gap over what lies beside it, and the chance of any among draws of one peak
NOTHING, LOOKED = 0.005, 20  # the share in all gaps, and how many are looked at
OF_PRIOR = 0.2  # share of the first draws that come from the prior: what no descent found is not excluded

Cost = Callable[[Array], Array]


@dataclass(frozen=True)
class WeightedDraws:
    """Draws (D, n) of a posterior, transformed, with ``shares`` (D,) that sum to one.

    ``mode`` (D,) is the number of the minimum that each draw belongs to, see :func:`belonging`, ``costs`` (D,) its J,
    ``log_evidence`` ln ∫ exp(−J_o) N(x) dx, ``best`` (n,) the lowest draw, ``proposal`` a mixture that resembles them.
    ``settled``: whether the last rounds that trained an emulator reached no farther than those before.
    """

    x: Array
    shares: Array
    mode: Indices
    costs: Array
    log_evidence: float
    best: Array
    proposal: StudentMixture
    settled: bool = True

    @property
    def lowest(self) -> float:
        return float(self.costs.min())

    @property
    def effective(self) -> float:
        """Number of equally likely draws that are worth as much."""
        return effective_number(self.shares)

    @property
    def mean(self) -> Array:
        return np.asarray(self.shares @ self.x)

    @property
    def covariance(self) -> Array:
        apart = self.x - self.mean
        return np.asarray((self.shares[:, None] * apart).T @ apart)

    def members(self, count: int, stream: np.random.Generator, exact: bool) -> Array:
        """(N, n) equally likely ones, of every mode as many as its weight says, to one.

        ``exact``: of every mode nearly of the moments and quantiles of its draws, see :mod:`~en4dvar.sampling.alike`.
        """
        std = np.sqrt(np.diag(self.covariance)) + np.finfo(float).tiny  # over these, units do not matter
        vectors = np.linalg.eigh(self.covariance / np.outer(std, std))[1]
        order = np.lexsort(((self.x - self.mean) / std @ vectors[:, -1], self.mode))
        if not exact:
            return np.asarray(self.x[order[resampled(self.shares[order], count, stream)]])
        pool = order[resampled(self.shares[order], max(POOL * count, LEAST), stream)]
        every = ((np.arange(count) + 0.5) * len(pool) / count).astype(np.intp)
        chosen, of_each = np.split(every, np.flatnonzero(np.diff(self.mode[pool[every]])) + 1), list[Array]()
        for own in chosen:
            there = self.mode == self.mode[pool[own[0]]]
            of_mode = replace(self, shares=self.shares * there / self.shares[there].sum())
            begin, end = np.searchsorted(self.mode[pool], self.mode[pool[own[0]]] + np.arange(2))
            of_each.append(standing_for(self.x[pool[begin:end]], own - begin, of_mode.mean, of_mode.covariance))
        return np.concatenate(of_each)


def sample_modes(
    cost: Cost, prior: Prior, minima: Sequence[Minimum], seed: int, enough: float | None = None, below: float = -np.inf
) -> WeightedDraws:
    """Draws of exp(−J) until ``enough`` of them (default: :data:`ENOUGH`) are effective, by eight runs each, or more as
    long as these are :data:`TOO_FEW`, or until J of one is ``below`` a value.

    Rounds of draws from proposals that close in on the posterior tell the proposal of those that count: a mixture, or
    where that keeps too few of its draws and ``cost`` has recorded what the runs gave, the emulated posterior.
    ``cost``: J (B,) of control vectors (B, n), with the prior's own mean and covariance, +inf where the model fails.
    Deterministic in ``seed``.
    """
    enough, n = ENOUGH if enough is None else enough, len(prior.names)
    most, closing = math.ceil(LAST_RUNS * enough / DRAWS), _closing(n)
    runs = cost if isinstance(cost, RecordedRuns) else None

    def more(sampler: Importance) -> bool:
        """A round; whether no draw of it is low enough to end them all."""
        z = sampler.draw()
        sampler.add(z, 0.5 * np.sum(z**2, axis=1) - cost(prior.from_white(z)))
        return bool(sampler.costs.min() >= below)

    def unsettled() -> bool:
        return sampler.effective < (enough if len(sampler.z) < MOST_RUNS * enough else min(TOO_FEW, enough))

    mixture = _about(prior, minima)
    first = ClosingDraws(mixture, member_stream(seed, "modes"), DRAWS, WIDER ** min(1.0, FEW / n))
    rounds, going = 1, more(first)
    while going and rounds < most and not (rounds >= closing and (first.near or (runs and runs.emulates))):
        rounds, going = rounds + 1, more(first)
    sampler: Importance = first
    if going:
        mixture = first.next_proposal()
        sampler, rounds = FixedDraws(mixture, first.stream, DRAWS), rounds + 1
        going = more(sampler)
    while going and unsettled() and rounds < most:
        if runs and (not first.near or sampler.effective < THIN * len(sampler.z)):
            sampler, mixture, going = _guided(runs, sampler, mixture, more)
            runs = None
        else:
            rounds, going = rounds + 1, more(sampler)
    if not np.isfinite(sampler.log):
        raise ValueError("no draw about a minimum of J can be run")
    x = prior.from_white(sampler.z)
    columns = prior.from_white_change(mixture.root.transpose(0, 2, 1))
    return WeightedDraws(
        x=x,
        shares=sampler.shares,
        mode=belonging(prior, minima, x, sampler.shares),
        costs=sampler.costs,
        log_evidence=sampler.log,
        best=x[np.argmax(sampler.target)],
        proposal=StudentMixture(
            mixture.share, prior.from_white(mixture.centre), np.ascontiguousarray(columns.transpose(0, 2, 1))
        ),
        settled=sampler.settled,
    )


def _closing(n: int) -> int:
    """Rounds in which proposals of n directions close in, at least."""
    return min(CLOSING[0] + n // CLOSING[1], CLOSING[2])


def typical_runs(n: int, enough: float | None) -> int:
    """Forward runs of :func:`sample_modes` for n parameters where an emulator has to be trained and is just good."""
    last = math.ceil((ENOUGH if enough is None else enough) / (GOOD * DRAWS))
    return DRAWS * (_closing(n) + len(HEATS) + TRIED + last)


def _guided(
    runs: RecordedRuns, mixed: Importance, mixture: StudentMixture, more: Callable[[Importance], bool]
) -> tuple[Importance, StudentMixture, bool]:
    """A round of draws of the emulated posterior, after others that train the emulator, or ``mixed``, those of a
    mixture, where these keep a larger share effective; and a mixture about them. False where a draw ends them all.
    """
    start: StudentMixture | EmulatedProposal = mixture
    of_mixture, logs = mixed.effective / len(mixed.z), list[float]()
    for heat in (*HEATS, *(LAST_HEAT,) * MOST_TRIED):
        proposal = EmulatedProposal.fitted(runs, start, mixed.stream, heat)
        if proposal is None:
            return mixed, mixture, True
        sampler = FixedDraws(proposal, mixed.stream, DRAWS)
        if not more(sampler):
            return sampler, proposal.mixture, False
        start, share = proposal, sampler.effective / DRAWS
        logs.append(sampler.log)
        rise = logs[-1] - min(logs[-3:])
        enough = share >= GOOD or len(logs) >= len(HEATS) + TRIED
        if heat == LAST_HEAT and (share < HOPELESS * of_mixture or (enough and rise < RISEN)):
            break
    final = EmulatedProposal.fitted(runs, start, mixed.stream, LAST_HEAT) if share >= of_mixture else None
    if final is None:
        return mixed, mixture, True
    sampler = FixedDraws(final, mixed.stream, DRAWS)
    sampler.settled = rise < RISEN
    return sampler, final.mixture, more(sampler)


def _about(prior: Prior, minima: Sequence[Minimum]) -> StudentMixture:
    """Student t about the minima, all alike and in each of their shapes, and the prior; in the prior's coordinates."""
    minima = [shape for m in minima for shape in (m, *m.shapes)]
    n, count = len(prior.names), len(minima)
    share = np.append(np.full(count, (1 - OF_PRIOR) / count), OF_PRIOR)
    centre = np.vstack([*(prior.white(m.x) for m in minima), np.zeros(n)])
    root = np.stack([*(np.linalg.cholesky(prior.white_covariance(m.covariance)) for m in minima), np.eye(n)])
    return StudentMixture(share, centre, root)


def nearest(prior: Prior, minima: Sequence[Minimum], x: Array) -> Indices:
    """Numbers (D,) of the minima whose Gaussian, weighted by its evidence, is densest at control vectors (D, n)."""
    logs = []
    for m in minima:
        apart = x - m.x
        squares = np.einsum("di,di->d", apart, np.linalg.solve(m.covariance, apart.T).T)
        logs.append(m.log_evidence(prior) - 0.5 * (squares + np.linalg.slogdet(m.covariance)[1]))
    return np.asarray(np.argmax(logs, axis=0))


def belonging(prior: Prior, minima: Sequence[Minimum], x: Array, shares: Array, for_one: float = 1.0) -> Indices:
    """Numbers (D,) of the minima that draws (D, n) with ``shares`` (D,) belong to, each of those in its own group; a
    group in which there is none has a number beyond them. ``for_one``: how many of a chain are worth one draw.
    """
    mode, new = np.zeros(len(x), dtype=np.intp), len(minima)
    if not minima:
        return mode
    groups = separated(np.vstack([x, *(m.x for m in minima)]), np.append(shares, np.zeros(new)), for_one)
    for group in groups:
        own, inside = group[group < len(x)], group[group >= len(x)] - len(x)
        if len(inside):
            mode[own] = inside[_by_valleys(prior, [minima[i] for i in inside], x[own], shares[own])]
        else:
            mode[own], new = new, new + 1
    return mode


def separated(x: Array, shares: Array, for_one: float = 1.0) -> list[Indices]:
    """Numbers of the draws (D, n), with ``shares`` (D,), of each group: empty gaps of one coordinate lie between them.

    A gap is g = :data:`GAP` times as wide as k effective draws to either side of it, each of which is ``for_one``.
    Between draws that are equally dense everywhere, a space has the chance (1 + g/2)^(−2(k − 1)) of that, at most; k
    makes it :data:`CHANCE` for all D n spaces together. Of one peak of any other density the sparser side is the wider
    one, and what is curved or bent leaves no gap. Draws that hold less than :data:`NOTHING` leave it empty.
    """
    beside = for_one * (1 + math.log(max(x.size / for_one, 1.0) / CHANCE) / (2 * math.log(1 + GAP / 2)))
    order = np.argsort(shares, kind="stable")
    held = np.zeros(len(x), dtype=bool)
    held[order[np.cumsum(shares[order]) > NOTHING * shares.sum()]] = True
    groups, waiting = [], [np.arange(len(x))]
    while waiting:
        group = waiting.pop()
        there = group[held[group]]
        for values in x.T:
            at = _gap(values[there], shares[there], beside)
            if at is not None:
                waiting += [group[values[group] > at], group[values[group] <= at]]
                break
        else:
            groups.append(group)
    return groups


def _gap(values: Array, shares: Array, beside: float) -> float | None:
    """The middle of a gap among values (D,), of the :data:`LOOKED` widest."""

    def span(part: slice) -> float:
        """How far ``beside`` effective draws reach from the first of a part on; infinite where these are fewer."""
        enough = np.cumsum(held[part]) ** 2 >= beside * np.cumsum(held[part] ** 2)
        return float(abs(at[part][np.argmax(enough)] - at[part][0])) if enough.any() else math.inf

    at, same = np.unique(values, return_inverse=True)  # a walker may stay where it is
    held, widths = np.asarray(np.bincount(same, shares), dtype=float), np.diff(at)
    for i in np.argsort(-widths, kind="stable")[:LOOKED]:
        if widths[i] > GAP * max(span(slice(i, None, -1)), span(slice(i + 1, None))):
            return float(at[i] + 0.5 * widths[i])
    return None


def _by_valleys(prior: Prior, minima: Sequence[Minimum], x: Array, shares: Array) -> Indices:
    """Numbers (D,) of the minima on whose side of the valley between them draws (D, n) with ``shares`` (D,) lie, and
    where there is none all that of the lower one.

    Which Gaussian is densest says only where to look: far from all minima, along a bent posterior, it is an accident of
    how wide they are.
    """
    mode = nearest(prior, minima, x)
    for j in range(1, len(minima)):
        for i in range(j):
            first, second = (shares * (mode == number) for number in (i, j))
            if first.any() and second.any():
                mode[np.isin(mode, (i, j))] = i
                mode[((first + second) > 0) & _beyond_valley(x, first, second)] = j
    return mode


def _beyond_valley(x: Array, first: Array, second: Array) -> Mask:
    """Which draws (D, n) lie beyond the place that has fewest, on the way from those with shares ``first`` (D,) to
    those with shares ``second`` (D,), along the direction that tells them apart best; none where the way is filled.
    """
    both = first + second
    a, b = (shares @ x / shares.sum() for shares in (first, second))
    apart = x - both @ x / both.sum()
    scale = np.sqrt(both @ apart**2) + np.finfo(float).tiny
    total = ((both[:, None] * apart).T @ apart) / np.outer(scale, scale)
    way = np.linalg.pinv(total, hermitian=True) @ ((b - a) / scale) / scale
    t = (x - a) @ way / ((b - a) @ way)
    counts = np.array([both[np.abs(t - at) <= NEAR].sum() for at in ALONG])
    peaks = np.minimum(np.maximum.accumulate(counts), np.maximum.accumulate(counts[::-1])[::-1])
    filled = np.divide(counts, peaks, out=np.ones_like(counts), where=peaks > 0)  # no valley is beyond all draws
    lowest = int(np.argmin(filled))
    return np.asarray((t > ALONG[lowest]) & bool(counts[lowest] < VALLEY * peaks[lowest]))
