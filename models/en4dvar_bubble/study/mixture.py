r"""Likelihoods of data sets as mixtures of Gaussians, and what they say about a population.

The draws of an interim posterior L_i(x) N(x; m_0, C_0) are described by a mixture Σ_m a_m N(c_m, Σ_m) (expectation
maximisation); the interim prior is divided out of every component (:mod:`~en4dvar_bubble.study.gaussian`), so that

    L_i(x) ∝ Σ_m exp(k_m + η_mᵀx − ½ xᵀΛ_m x),
    ∫ L_i(x) N(x; ν, D) dx = Σ_m exp(k_m + ½ bᵀA⁻¹b − ½ νᵀD⁻¹ν) |I + DΛ_m|^{-1/2},  A = Λ_m + D⁻¹, b = η_m + D⁻¹ν,

and x given ν, D is drawn exactly: a component, then N(A⁻¹b, A⁻¹).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np

from en4dvar.prior import member_stream
from en4dvar.state import Array
from en4dvar_bubble.study.gaussian import divide_out


@dataclass(frozen=True)
class Mixtures:
    """Of S sets, M components, n coordinates: ``precision`` (S, M, n, n), ``linear`` (S, M, n), ``constant`` (S, M)."""

    precision: Array
    linear: Array
    constant: Array

    def joined(self, other: Mixtures) -> Mixtures:
        """The components of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Mixtures(*(np.concatenate(pair, axis=1) for pair in pairs))

    def log_marginal(self, mean: Array, variance: Array) -> Array:
        """(B,) sum over the sets of ln ∫ L_i(x) N(x; mean, diag variance) dx, for ``mean`` and ``variance`` (B, n)."""
        out = np.empty(len(mean))
        _log_marginals(self.precision, self.linear, self.constant, mean, variance, out)
        return out


def fit_mixtures(
    draws: Array, prior_mean: Array, prior_std: Array, seed: int, words: str, components: int = 12, rounds: int = 60,
    workers: int = 1,
) -> Mixtures:  # fmt: skip
    """From draws (S, D, n) of posteriors under the independent prior N(prior_mean, prior_std²), up to constants.

    ``seed`` and ``words`` name the random streams; ``workers`` threads.
    """
    n_sets, _, n = draws.shape
    parts = (np.empty((n_sets, components, n, n)), np.empty((n_sets, components, n)), np.empty((n_sets, components)))

    def one(s: int) -> None:
        share, centre, covariance = fit_gaussians(draws[s], member_stream(seed, words, s), components, rounds)
        found = divide_out(("",) * n, centre, covariance, np.log(share), prior_mean, prior_std)
        for target, values in zip(parts, (found.precision, found.linear, found.constant), strict=True):
            target[s] = values

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, range(n_sets)))
    return Mixtures(*parts)


def fit_gaussians(x: Array, rng: np.random.Generator, components: int, rounds: int) -> tuple[Array, Array, Array]:
    """Shares (M,), means (M, n) and covariances (M, n, n) of a mixture for points (D, n); expectation maximisation."""
    count, n = x.shape
    middle, root = x.mean(axis=0), np.linalg.cholesky(np.cov(x, rowvar=False))
    z = np.linalg.solve(root, (x - middle).T).T
    centre = z[[int(rng.integers(count))]]
    for _ in range(components - 1):  # k-means++ (Arthur & Vassilvitskii 2007)
        distance = np.min(np.sum((z[:, None] - centre) ** 2, axis=2), axis=1)
        centre = np.vstack([centre, z[rng.choice(count, p=distance / distance.sum())]])
    covariance = np.tile(0.3 * np.eye(n), (components, 1, 1))
    share = np.full(components, 1 / components)
    _maximise(z, share, centre, covariance, rounds)
    return share, middle + centre @ root.T, root @ covariance @ root.T


@numba.njit(cache=True, nogil=True)
def _maximise(z, share, centre, covariance, rounds):  # type: ignore[no-untyped-def]
    """Rounds of expectation maximisation for points (D, n); share, centre and covariance are overwritten."""
    count, n = z.shape
    parts = share.size
    of_part, apart = np.empty((count, parts)), np.empty(n)
    for _ in range(rounds):
        for m in range(parts):
            lower = np.linalg.cholesky(covariance[m])
            constant = np.log(share[m])
            for i in range(n):
                constant -= np.log(lower[i, i])
            for d in range(count):
                log = constant
                for i in range(n):
                    scaled = z[d, i] - centre[m, i]
                    for k in range(i):
                        scaled -= lower[i, k] * apart[k]
                    apart[i] = scaled / lower[i, i]
                    log -= 0.5 * apart[i] ** 2
                of_part[d, m] = log
        for d in range(count):
            top, total = of_part[d].max(), 0.0
            for m in range(parts):
                of_part[d, m] = np.exp(of_part[d, m] - top)
                total += of_part[d, m]
            for m in range(parts):
                of_part[d, m] /= total
        for m in range(parts):
            size = 1e-9 * count
            centre[m] = 0.0
            for d in range(count):
                size += of_part[d, m]
                for i in range(n):
                    centre[m, i] += of_part[d, m] * z[d, i]
            share[m] = size
            centre[m] /= size
            covariance[m] = 0.0
            for d in range(count):
                for i in range(n):
                    apart[i] = z[d, i] - centre[m, i]
                    for k in range(i + 1):
                        covariance[m, i, k] += of_part[d, m] * apart[i] * apart[k]
            for i in range(n):
                for k in range(i + 1):
                    covariance[m, i, k] = covariance[m, i, k] / size + (1e-4 if i == k else 0.0)
                    covariance[m, k, i] = covariance[m, i, k]
        share /= share.sum()


@numba.njit(cache=True, nogil=True)
def condition(precision, linear, mean, variance, middle, root):  # type: ignore[no-untyped-def]
    """A⁻¹b and the lower root of A; returns ½ bᵀA⁻¹b − ½ ln|DA| − ½ νᵀD⁻¹ν."""
    n = mean.size
    value = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = precision[i, j]
            if i == j:
                total += 1.0 / variance[i]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i == j:
                root[i, i] = np.sqrt(total)
                value -= np.log(root[i, i]) + 0.5 * np.log(variance[i])
            else:
                root[i, j] = total / root[j, j]
        total = linear[i] + mean[i] / variance[i]
        for k in range(i):
            total -= root[i, k] * middle[k]
        middle[i] = total / root[i, i]
        value += 0.5 * middle[i] ** 2 - 0.5 * mean[i] ** 2 / variance[i]
    _back(root, middle)
    return value


@numba.njit(cache=True, nogil=True)
def _back(root, z):  # type: ignore[no-untyped-def]
    """z ← root⁻ᵀ z."""
    n = z.size
    for i in range(n - 1, -1, -1):
        total = z[i]
        for k in range(i + 1, n):
            total -= root[k, i] * z[k]
        z[i] = total / root[i, i]


@numba.njit(cache=True, nogil=True)
def draw_conditioned(middle, root, z, out):  # type: ignore[no-untyped-def]
    """A draw of N(middle, (root rootᵀ)⁻¹) from standard normal z, which is overwritten."""
    _back(root, z)
    for i in range(z.size):
        out[i] = middle[i] + z[i]


@numba.njit(cache=True, nogil=True)
def _log_marginals(precision, linear, constant, mean, variance, out):  # type: ignore[no-untyped-def]
    n_sets, n_parts, n = linear.shape
    middle, root, logs = np.empty(n), np.zeros((n, n)), np.empty(n_parts)
    for b in range(mean.shape[0]):
        out[b] = 0.0
        for s in range(n_sets):
            for m in range(n_parts):
                logs[m] = constant[s, m] + condition(precision[s, m], linear[s, m], mean[b], variance[b], middle, root)
            top = logs.max()
            out[b] += top + np.log(np.sum(np.exp(logs - top)))
