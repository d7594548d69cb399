r"""The posterior ensemble of a joint problem: Gaussian about the mode, and corrected by importance for cheap models.

What is shared, s, is drawn from Student's t about the mode; given s each experiment is on its own, so that

    p(s | y) ∝ p(s) Π_e L_e(s),      L_e(s) = ∫ p(y_e | s, v) p(v) dv ≈ mean_k p(y_e | s, v_k) p(v_k) / q(v_k | s)

with v_k from a Gaussian about where J is low given s, widened. The estimate of L_e is unbiased, and with it the
weights of s and the choice of one v_k for each member are those of the exact posterior (Andrieu & Roberts 2009,
Ann. Stat. 37, 697).

The minimum may hold one experiment in the wrong minimum of its own quantities, as a bubble whose radii explain rebounds
by their phase and not by their height. The others then keep what is shared about right, so that to look for a lower one
(:func:`challenger`) it is enough to look at one experiment after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from en4dvar.ensemble.linalg import effective_number, resampled, shares_of
from en4dvar.estimation.joint.descent import ArrowSystem, Experiment, Place
from en4dvar.model.state import Array
from en4dvar.priors.prior import member_stream

DRAWS, INNER = 192, 12  # of what is shared, and of the own quantities for each of them
STEPS = 2  # linearisations that the own quantities given what is shared are sought by
FREEDOM = 7.0  # degrees of freedom of Student's t
WIDER = 1.2  # the proposals than the Gaussian
ROUNDS = 4  # of such draws at most, where fewer leave
FEWEST = 24.0  # effective draws below which the weights say nothing
OF_PRIOR, DEEPEST, DESCENTS = 48, 4, 8  # of the prior; of which are descended from; and with so many linearisations
LOWER = 0.5  # of J


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


def gaussian(at: ArrowSystem, seed: int, count: int) -> JointMembers:
    """By Laplace's approximation, with exact mean and covariance of every experiment's quantities."""

    def numbers(words: str, size: int) -> Array:
        return member_stream(seed, words).standard_normal((count, size))

    border = numbers("joint border", len(at.place.border))
    x, own = at.arrow.sample(border, lambda e: numbers(f"joint {e}", len(at.place.own[e])))
    evidence = -at.cost - 0.5 * at.arrow.log_determinant
    own_members = tuple(v + dv for v, dv in zip(at.place.own, own, strict=True))
    return JointMembers(at.place.border + x, own_members, np.nan, evidence)


def sampled(experiments: Sequence[Experiment], at: ArrowSystem, seed: int, count: int) -> JointMembers | None:
    """By importance, in rounds until enough are effective; None where the proposal does not reach the posterior."""
    stream, rounds = member_stream(seed, "joint importance"), list[list[Array]]()
    for _ in range(ROUNDS):
        border, log_weights = _proposed(at, stream)
        drawn = [_own(experiment, at, border, stream) for experiment in experiments]
        for _, log_ratio in drawn:
            log_weights = log_weights + logsumexp(log_ratio, axis=1) - np.log(INNER)
        rounds.append([border, log_weights, *(part for pair in drawn for part in pair)])
        border, log_weights, *pairs = (np.concatenate(parts) for parts in zip(*rounds, strict=True))
        if not np.isfinite(log_weights).any():
            return None
        weights = shares_of(log_weights)
        effective = effective_number(weights)
        if effective >= FEWEST:
            break
    else:
        return None
    order = np.argsort(border[:, 0], kind="stable") if border.shape[1] else np.arange(len(border))
    taken = order[resampled(weights[order], count, stream)]
    own_members = tuple(
        np.concatenate([own[i, resampled(shares_of(log[i]), 1, stream)] for i in taken])  # one each, by their weights
        for own, log in zip(pairs[::2], pairs[1::2], strict=True)
    )
    evidence = float(logsumexp(log_weights)) - float(np.log(len(border)))
    return JointMembers(border[taken], own_members, effective, evidence)


def _proposed(at: ArrowSystem, stream: np.random.Generator) -> tuple[Array, Array]:
    """Draws (M, c) of what is shared, and ln p(s) − ln q(s) (M,)."""
    c = len(at.place.border)
    root = np.linalg.cholesky(at.arrow.schur)
    z = stream.standard_normal((DRAWS, c))
    tails = np.sqrt(FREEDOM / stream.chisquare(FREEDOM, DRAWS))[:, None]
    scaled = WIDER * tails * z
    border = at.place.border + np.linalg.solve(root.T, scaled.T).T
    squares = np.sum((scaled / WIDER) ** 2, axis=1)
    log_q = (
        gammaln((FREEDOM + c) / 2) - gammaln(FREEDOM / 2) - 0.5 * c * np.log(FREEDOM * np.pi)
        + float(np.log(np.diag(root)).sum()) - c * np.log(WIDER)
        - 0.5 * (FREEDOM + c) * np.log1p(squares / FREEDOM)
    )  # fmt: skip
    log_p = -0.5 * np.sum(border**2, axis=1) - 0.5 * c * np.log(2 * np.pi)
    return border, log_p - log_q


def _own(experiment: Experiment, at: ArrowSystem, border: Array, stream: np.random.Generator) -> tuple[Array, Array]:
    """Own quantities (M, INNER, n_e) of an experiment given border (M, c), and ln p(y, v)/q(v) (M, INNER)."""
    e, n = experiment.e, len(at.place.own[experiment.e])
    means, precisions = _given(experiment, at, border)
    roots = np.linalg.cholesky(precisions)
    z = stream.standard_normal((len(border), INNER, n))
    own = means[:, None] + WIDER * np.linalg.solve(np.swapaxes(roots, 1, 2)[:, None], z[..., None])[..., 0]
    logs = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)[:, None]
    log_q = logs - 0.5 * np.sum(z**2, axis=2) - n * np.log(WIDER)
    points = experiment.joint.standard(e, np.repeat(border, INNER, axis=0), own.reshape(-1, n))
    costs = experiment.costs(points).reshape(len(border), INNER)
    return own, -costs - 0.5 * np.sum(own**2, axis=2) - log_q


def _given(experiment: Experiment, at: ArrowSystem, border: Array) -> tuple[Array, Array]:
    """The Gaussian of an experiment's own quantities given border (M, c): mean (M, n_e), precision (M, n_e, n_e).

    That of the arrow, moved by a step of Gauss and Newton where J is lower there: what one experiment knows much better
    alone than what is shared, as a time shift, is off the arrow's straight line by many of its standard deviations.
    """
    e, arrow = experiment.e, at.arrow
    block = arrow.blocks[e]
    precision = np.broadcast_to(block, (len(border), *block.shape))
    if not experiment.joint.columns(e)[1]:
        return np.zeros((len(border), 0)), precision
    mean = at.place.own[e] - np.linalg.solve(block, arrow.edges[e].T @ (border - at.place.border).T).T
    mean, precision, _ = experiment.settled(border, mean, precision, STEPS)
    return mean, precision


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
        places, _, ends = experiment.settled(border[:DEEPEST], starts, precision, DESCENTS)
        if ends.min() < at.forms[e].cost + 0.5 * float(own[e] @ own[e]) - LOWER:
            own[e], lower = places[np.argmin(ends)], True
    return Place(place.border, tuple(own)) if lower else None
