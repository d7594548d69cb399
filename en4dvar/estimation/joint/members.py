r"""The posterior ensemble of a joint problem: Gaussian about the mode, and corrected by importance for cheap models.

What is shared, s, is drawn from Student's t about the mode, then about what was found; given s experiments are on
their own, so that

    p(s | y) ∝ p(s) Π_e L_e(s),      L_e(s) = ∫ p(y_e | s, v) p(v) dv ≈ mean_k p(y_e | s, v_k) p(v_k) / q(v_k | s)

with v_k from Student's t about where J is lowest given s and, once there are draws, half of them from one with the mean
and covariance of these: a curvature does not tell of a second minimum. The estimate of L_e is unbiased, and with it the
weights of s and the choice of one v_k for each member are those of the exact posterior (Andrieu & Roberts 2009, Ann.
Stat. 37, 697).

The minimum may hold one experiment in the wrong minimum of its own quantities, as a bubble whose radii explain rebounds
by their phase and not by their height. The others then keep what is shared about right, so that to look for a lower one
(:func:`challenger`) it is enough to look at one experiment after the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, logsumexp

from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.estimation.joint.descent import ArrowSystem, Experiment, Place
from en4dvar.model.state import Array, Mask
from en4dvar.priors.prior import member_stream

DRAWS, INNER = 96, 36  # of what is shared, and of the own quantities for each of them
FREEDOM = 7.0  # degrees of freedom of Student's t
WIDER = 1.2  # the proposals than the Gaussian
LEAST, ROUNDS = 2, 12  # rounds of such draws, at least and at most
ENOUGH, FEWEST = 96.0, 24.0  # effective draws that end the rounds; below which the weights say nothing
TEMPERING, POWERS = 0.9, 60  # uneven weights are raised to a power of this base, of so many that are tried
OF_PRIOR, DEEPEST, DESCENTS = 48, 4, 8  # of the prior; of which are descended from; by so many linearisations each
LOWER = 0.5  # of J

Moments = tuple[Array, Array]  # mean (n,) and covariance (n, n)


@dataclass(frozen=True)
class JointMembers:
    """N members in units of the prior: ``border`` (N, c), ``own`` (N, n_e) of each experiment.

    ``effective``: draws that the importance weights leave, NaN where there are none; ``log_evidence`` up to the errors'
    normalisation.
    """

    border: Array
    own: tuple[Array, ...]
    effective: float
    log_evidence: float

    def of(self, alive: Mask) -> "JointMembers":
        """Those that are alive, of N."""
        return replace(self, border=self.border[alive], own=tuple(of_it[alive] for of_it in self.own))


def gaussian(at: ArrowSystem, seed: int, count: int) -> JointMembers:
    """By Laplace's approximation, with exact mean and covariance of every experiment's quantities."""

    def numbers(words: str, size: int) -> Array:
        return member_stream(seed, words).standard_normal((count, size))

    border = numbers("joint border", len(at.place.border))
    x, own = at.arrow.sample(border, lambda e: numbers(f"joint {e}", len(at.place.own[e])))
    evidence = -at.cost - 0.5 * at.arrow.log_determinant
    own_members = tuple(v + dv for v, dv in zip(at.place.own, own, strict=True))
    return JointMembers(at.place.border + x, own_members, np.nan, evidence)


def span_of_runs(count: int) -> tuple[int, int]:
    """Forward runs of :func:`sampled`, of so many experiments, at least and at most."""
    return count * LEAST * DRAWS * INNER, count * ROUNDS * DRAWS * INNER


def sampled(
    experiments: Sequence[Experiment], at: ArrowSystem, seed: int, count: int,
    tell: Callable[[str], None] = lambda words: None,
) -> JointMembers | None:  # fmt: skip
    """By importance, in rounds until enough are effective; None where the proposals do not reach the posterior.

    Each further round draws about where the rounds before it have found the posterior, which may be bent, √2 times as
    wide, and all draws are weighed by the mixture of the proposals (Cornuet et al. 2012, Scand. J. Stat. 39, 798). The
    weights of a first round that has not reached a tail do not tell that it is missing: one round is never enough.
    """
    stream, rounds, proposals = member_stream(seed, "joint importance"), list[list[Array]](), list[Proposal]()
    proposal, of_own = Proposal(at.place.border, at.arrow.schur), list[Moments | None]([None] * len(experiments))
    for number in range(ROUNDS):
        proposals.append(proposal)
        border = proposal.drawn((DRAWS,), stream)
        log_target = -0.5 * np.sum(border**2, axis=1) - 0.5 * border.shape[1] * np.log(2 * np.pi)
        drawn = [_own(e, at, border, moments, stream) for e, moments in zip(experiments, of_own, strict=True)]
        for _, log_ratio, _ in drawn:
            log_target = log_target + logsumexp(log_ratio, axis=1) - np.log(INNER)
        rounds.append([border, log_target, *(part for of_it in drawn for part in of_it)])
        border, log_target, *parts = (np.concatenate(of_all) for of_all in zip(*rounds, strict=True))
        each = [parts[3 * i : 3 * i + 3] for i in range(len(experiments))]
        log_weights = (
            log_target - logsumexp([p.log_density(border) for p in proposals], axis=0) + np.log(len(proposals))
        )
        alive = np.isfinite(log_weights)
        if alive.sum() < FEWEST:
            return None
        weights = shares_of(log_weights)
        effective = effective_number(weights)
        tell(f"{effective:.0f} effective draws after {number + 1} of at most {ROUNDS} rounds, {ENOUGH:.0f} are wanted")
        if number + 1 >= LEAST and effective >= ENOUGH:
            break
        if of_shared := _moments(border[alive], log_weights[alive]):
            proposal = Proposal(of_shared[0], np.asarray(np.linalg.inv(2 * of_shared[1])))
        for e, (_, log, off) in enumerate(each):
            log_own = log[alive] + (log_weights - logsumexp(log, axis=1))[alive, None]
            of_own[e] = _moments(off[alive].reshape(log_own.size, off.shape[2]), log_own.ravel())
    if effective < FEWEST:
        return None
    order = np.argsort(border[:, 0], kind="stable")
    taken = order[resampled(weights[order], count, stream)]
    own_members = tuple(
        np.concatenate([own[i, resampled(shares_of(log[i]), 1, stream)] for i in taken])  # one each, by their weights
        for own, log, _ in each
    )
    evidence = float(logsumexp(log_weights)) - float(np.log(len(border)))
    return JointMembers(border[taken], own_members, effective, evidence)


@dataclass(frozen=True)
class Proposal:
    """Student's t about ``centre`` (…, n) with ``precision`` (…, n, n), widened."""

    centre: Array
    precision: Array

    def drawn(self, shape: tuple[int, ...], stream: np.random.Generator) -> Array:
        """(*shape, n)."""
        z = WIDER * stream.standard_normal((*shape, self.centre.shape[-1]))
        scaled = np.sqrt(FREEDOM / stream.chisquare(FREEDOM, shape))[..., None] * z
        root = np.swapaxes(np.linalg.cholesky(self.precision), -1, -2)
        return np.asarray(self.centre + np.linalg.solve(root, scaled[..., None])[..., 0])

    def log_density(self, at: Array) -> Array:
        """(…,) of points (…, n)."""
        n, root = self.centre.shape[-1], np.linalg.cholesky(self.precision)
        scaled = np.einsum("...ji,...j->...i", root, at - self.centre) / WIDER
        return np.asarray(
            gammaln((FREEDOM + n) / 2) - gammaln(FREEDOM / 2) - 0.5 * n * np.log(FREEDOM * np.pi) - n * np.log(WIDER)
            + np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
            - 0.5 * (FREEDOM + n) * np.log1p(np.sum(scaled**2, axis=-1) / FREEDOM)
        )  # fmt: skip


def _moments(points: Array, log_weights: Array) -> Moments | None:
    """Mean (n,) and covariance (n, n) of points (D, n), with the largest power of the weights that leaves 2 √D and 2 n
    of them effective: of the few that weights as uneven as those of a first round leave, both are too narrow. None of
    fewer points.
    """
    least = 2 * max(len(points) ** 0.5, points.shape[1])
    if len(points) < least:
        return None
    powers = (shares_of(power * log_weights) for power in TEMPERING ** np.arange(POWERS))
    weights = next((w for w in powers if effective_number(w) >= least), None)
    return np.average(points, axis=0, weights=weights), np.atleast_2d(np.cov(points.T, aweights=weights))


def _own(
    experiment: Experiment, at: ArrowSystem, border: Array, moments: Moments | None, stream: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Own quantities v (M, INNER, n_e) of an experiment given border (M, c), ln p(y, v)/q(v) (M, INNER), and how far
    they are from where J is lowest, in units of its curvature there, of which ``moments`` are known from earlier draws.
    """
    e, n, arrow = experiment.e, len(at.place.own[experiment.e]), at.arrow
    means, precisions = experiment.followed(border, at.place.border, at.place.own[e], arrow.blocks[e], arrow.edges[e])
    units = np.swapaxes(np.linalg.inv(np.linalg.cholesky(precisions)), 1, 2)  # of the curvature: v = means + units u
    proposals = [Proposal(means[:, None], precisions[:, None])]
    if moments is not None:
        spread = units @ moments[1] @ np.swapaxes(units, 1, 2)
        proposals.append(Proposal((means + units @ moments[0])[:, None], np.asarray(np.linalg.inv(spread))[:, None]))
    own = np.concatenate([p.drawn((len(border), INNER // len(proposals)), stream) for p in proposals], axis=1)
    points = experiment.joint.standard(e, np.repeat(border, INNER, axis=0), own.reshape(len(border) * INNER, n))
    costs = experiment.costs(points).reshape(len(border), INNER)
    log_p = -0.5 * np.sum(own**2, axis=2) - 0.5 * n * np.log(2 * np.pi)
    log_q = logsumexp([p.log_density(own) for p in proposals], axis=0) - np.log(len(proposals))
    off = np.linalg.solve(units, np.swapaxes(own - means[:, None], 1, 2))
    return own, log_p - costs - log_q, np.swapaxes(off, 1, 2)


def challenger(experiments: Sequence[Experiment], at: ArrowSystem, seed: int) -> Place | None:
    """The place with the own quantities of some experiments in lower minima; None where none is found."""
    place, lower = at.place, False
    own = list(place.own)
    for experiment in experiments:
        e, n = experiment.e, len(own[experiment.e])
        if not n:
            continue
        draws = member_stream(seed, f"joint challengers {e}").standard_normal((OF_PRIOR, n))
        border = np.tile(place.border, (OF_PRIOR, 1))
        costs = experiment.costs(experiment.joint.standard(e, border, draws)) + 0.5 * np.sum(draws**2, axis=1)
        starts = draws[np.argsort(costs, kind="stable")[:DEEPEST]]
        precision = np.broadcast_to(at.arrow.blocks[e], (DEEPEST, n, n))
        places, precision, ends = experiment.settled(border[:DEEPEST], starts, precision, DESCENTS)
        lowest = [np.argmin(ends)]  # goes on by as many
        places, _, ends = experiment.settled(border[:1], places[lowest], precision[lowest], DESCENTS)
        if ends[0] < at.forms[e].cost + 0.5 * float(own[e] @ own[e]) - LOWER:
            own[e], lower = places[0], True
    return Place(place.border, tuple(own)) if lower else None
