r"""Marginal likelihoods of data sets given a population, by importance sampling with emulators.

    p_i(ν, D) = ∫ L_i(x) N(x; ν, D) dx ≈ (1/J) Σ_j L_i(x_j) N(x_j) / q(x_j)
    q = N · ((1 − ε) (0.7 m/Z + 0.3 t/Z') + ε)

Of the J draws a share ε comes from the population N itself, the others from the set's mixture m, conditioned, and from
one for its tempered likelihood, t ≈ L^{1/3} (deterministic mixture: Owen & Zhou 2000, J. Am. Stat. Assoc. 95, 135). Of
a bubble unlike the others the populations that are likely see the tail only, where m is poor: with draws of m alone
the estimate there was mostly too small, and now and then a single weight decided everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from en4dvar.estimation.population.likelihoods import EmulatedLikelihood, log_likelihood
from en4dvar.estimation.population.mixtures import Mixture, condition, draw_conditioned
from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel
from en4dvar.priors.prior import member_stream

DEFENSIVE = 0.1  # share ε of the draws
TEMPERATURE, TEMPERED = 3.0, 0.3  # of t, and its share of what the mixtures draw


class SetPosterior(NamedTuple):
    """One data set's likelihood: L̂ on the emulator, and the mixtures m and t. Kernels can read it."""

    likelihood: EmulatedLikelihood
    mixture: Mixture
    tempered: Mixture


@dataclass(frozen=True)
class Marginals:
    """For B populations and S sets: ``logs`` (B, S) of the estimated marginal likelihoods, ``variance`` (B, S) of one
    draw's weight relative to the square of their mean, and ``x`` (B, S, P, n), of each P draws given data and
    population.
    """

    logs: Array
    variance: Array
    x: Array


def marginals(
    sets: Sequence[SetPosterior], mean: Array, variance: Array, counts: Sequence[int], picks: int, seed: int,
    words: str, workers: int = 1,
) -> Marginals:  # fmt: skip
    """Estimates for populations of ``mean`` and ``variance`` (B, n), from ``counts`` (S,) draws of each set.

    ``picks`` of them are chosen by their weights; ``seed`` and ``words`` name the random streams.

    Raises
    ------
    ValueError: fewer than two draws.
    """
    shape = len(sets), len(mean)
    logs, relative, x = np.empty(shape), np.empty(shape), np.empty((*shape, picks, mean.shape[1]))

    def estimate_set(s: int) -> None:
        few, split = max(1, round(DEFENSIVE * counts[s])), len(sets[s].mixture.constant)
        both = sets[s].mixture.joined(sets[s].tempered)
        _marginals(
            member_stream(seed, words, s), both, split, sets[s].likelihood, mean, variance, counts[s], few, logs[s],
            relative[s], x[s],
        )  # fmt: skip

    if min(counts) < 2:
        raise ValueError("a marginal needs at least two draws")
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(estimate_set, range(len(sets))))
    return Marginals(logs.T, relative.T, x.transpose(1, 0, 2, 3))


@kernel
def _marginals(
    rng: np.random.Generator, both: Mixture, split: int, likelihood: EmulatedLikelihood, mean: Array, variance: Array,
    count: int, few: int, out: Array, relative: Array, chosen: Array,
) -> None:  # fmt: skip
    """One set: the first ``split`` components are its mixture's; ``few`` of ``count`` draws are of the population."""
    n_parts, n = both.linear.shape
    middle, root = np.empty((n_parts, n)), np.zeros((n_parts, n, n))
    logs, offset = np.empty(n_parts), np.empty(n_parts)
    x, z = np.empty((count, n)), np.empty(n)
    share = few / count
    for b in range(mean.shape[0]):
        for m in range(n_parts):
            logs[m] = condition(both.precision[m], both.linear[m], mean[b], variance[b], middle[m], root[m])
        for begin, end, part in ((0, split, 1 - TEMPERED), (split, n_parts, TEMPERED)):
            here = logs[begin:end] + both.constant[begin:end]
            top = here.max()
            offset[begin:end] = both.constant[begin:end] + np.log((1 - share) * part / np.exp(here - top).sum()) - top
        cumulated = np.cumsum(np.exp(logs + offset))
        weights = np.empty(count)
        for c in range(count):
            for i in range(n):
                z[i] = rng.standard_normal()
            if c < few:
                for i in range(n):
                    x[c, i] = mean[b, i] + np.sqrt(variance[b, i]) * z[i]
            else:
                m = min(np.searchsorted(cumulated, rng.random() * cumulated[-1]), n_parts - 1)
                draw_conditioned(middle[m], root[m], z, x[c])
            log_mixture = _log_mixture(x[c], both.precision, both.linear, offset)
            weights[c] = log_likelihood(x[c], likelihood) - np.log(np.exp(min(log_mixture, 700.0)) + share)
        top = weights.max()
        total, squares = 0.0, 0.0
        for c in range(count):
            weights[c] = np.exp(weights[c] - top)
            total += weights[c]
            squares += weights[c] ** 2
        out[b] = top + np.log(total / count)
        relative[b] = (squares / count / (total / count) ** 2 - 1) * count / (count - 1)
        cumulated_weights = np.cumsum(weights)
        for k in range(chosen.shape[1]):
            at = rng.random() * cumulated_weights[-1]
            chosen[b, k] = x[min(np.searchsorted(cumulated_weights, at, side="right"), count - 1)]


@kernel
def _log_mixture(x: Array, precision: Array, linear: Array, constant: Array) -> float:
    n_parts, n = linear.shape
    logs = np.empty(n_parts)
    for m in range(n_parts):
        logs[m] = constant[m]
        for i in range(n):
            slope = linear[m, i]
            for j in range(n):
                slope -= 0.5 * precision[m, i, j] * x[j]
            logs[m] += x[i] * slope
    top = logs.max()
    total: float = top + np.log(np.sum(np.exp(logs - top)))
    return total
