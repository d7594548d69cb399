r"""Likelihoods of data sets as mixtures of Gaussians, and what they say about a population.

The draws of an interim posterior L_i(x) N(x; m_0, C_0) are described by a mixture Σ_m a_m N(c_m, Σ_m); the interim
prior is divided out of every component, so that

    L_i(x) ∝ Σ_m exp(k_m + η_mᵀx − ½ xᵀΛ_m x),     Λ_m = Σ_m⁻¹ − C_0⁻¹,   η_m = Σ_m⁻¹ c_m − C_0⁻¹ m_0,
    ∫ L_i(x) N(x; ν, D) dx = Σ_m exp(k_m + ½ bᵀA⁻¹b − ½ νᵀD⁻¹ν) |I + DΛ_m|^{-1/2},  A = Λ_m + D⁻¹, b = η_m + D⁻¹ν,

and x given ν, D is drawn exactly: a component, then N(A⁻¹b, A⁻¹). A direction the data say nothing about has Λ = 0;
rounding below zero is cut off.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel
from en4dvar.priors.prior import member_stream
from en4dvar.sampling.mixture import fit_gaussians

ROUNDS = 60  # of expectation maximisation


class Mixture(NamedTuple):
    """L of one set: ``precision`` Λ (M, n, n), ``linear`` η (M, n), ``constant`` k (M,). Kernels can read it."""

    precision: Array
    linear: Array
    constant: Array

    @classmethod
    def divided(cls, mean: Array, covariance: Array, log_share: Array, prior_mean: Array, prior_std: Array) -> Mixture:
        """Components of the posterior, means (M, n) and covariances (M, n, n), with an independent prior divided out.

        ``log_share`` (M,): ln of the components' shares, or of evidences where the constants are to be likelihoods'.
        """
        # in units of the prior's standard deviation, so that cutting off means the same in every direction
        scaled = covariance / np.outer(prior_std, prior_std)
        z = (mean - prior_mean) / prior_std
        values, vectors = np.linalg.eigh(scaled)
        gain = np.maximum(1 / values - 1, 0.0)
        precision = np.einsum("sij,sj,skj->sik", vectors, gain, vectors)
        # about the prior mean m_0 = 0 here: η = C⁻¹ z, with the same directions cut off
        inverse = precision + np.eye(len(prior_mean))
        linear = np.einsum("sij,sj->si", inverse, z)
        log_det = -np.linalg.slogdet(inverse)[1]
        constant = log_share - 0.5 * log_det - 0.5 * np.einsum("si,si->s", linear, z)
        # back to x = m_0 + s z
        precision_x = precision / np.outer(prior_std, prior_std)
        shift = np.einsum("sij,j->si", precision_x, prior_mean)
        constant_x = constant - (linear / prior_std) @ prior_mean - 0.5 * shift @ prior_mean
        return cls(precision_x, linear / prior_std + shift, constant_x)

    def joined(self, other: Mixture) -> Mixture:
        """The components of both."""
        return Mixture(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def log_marginal(mixtures: Sequence[Mixture], mean: Array, variance: Array) -> Array:
    """(B,) sum over the sets of ln ∫ L_i(x) N(x; mean, diag variance) dx, for ``mean`` and ``variance`` (B, n)."""
    total = np.zeros(len(mean))
    for mixture in mixtures:
        _add_log_marginal(mixture, mean, variance, total)
    return total


def fit_mixtures(
    draws: Array, prior_mean: Array, prior_std: Array, seed: int, words: str, components: int, workers: int = 1
) -> list[Mixture]:
    """From draws (S, D, n) of posteriors under the independent prior N(prior_mean, prior_std²), up to constants.

    ``seed`` and ``words`` name the random streams; ``workers`` threads.
    """

    def fit_set(s: int) -> Mixture:
        share, centre, covariance = fit_gaussians(draws[s], member_stream(seed, words, s), components, ROUNDS)
        return Mixture.divided(centre, covariance, np.log(share), prior_mean, prior_std)

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(fit_set, range(len(draws))))


@kernel
def condition(precision: Array, linear: Array, mean: Array, variance: Array, middle: Array, root: Array) -> float:
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


@kernel
def _back(root: Array, z: Array) -> None:
    """z ← root⁻ᵀ z."""
    n = z.size
    for i in range(n - 1, -1, -1):
        total = z[i]
        for k in range(i + 1, n):
            total -= root[k, i] * z[k]
        z[i] = total / root[i, i]


@kernel
def draw_conditioned(middle: Array, root: Array, z: Array, out: Array) -> None:
    """A draw of N(middle, (root rootᵀ)⁻¹) from standard normal z, which is overwritten."""
    _back(root, z)
    for i in range(z.size):
        out[i] = middle[i] + z[i]


@kernel
def _add_log_marginal(mixture: Mixture, mean: Array, variance: Array, total: Array) -> None:
    n_parts, n = mixture.linear.shape
    middle, root, logs = np.empty(n), np.zeros((n, n)), np.empty(n_parts)
    for b in range(mean.shape[0]):
        for m in range(n_parts):
            part = condition(mixture.precision[m], mixture.linear[m], mean[b], variance[b], middle, root)
            logs[m] = mixture.constant[m] + part
        top = logs.max()
        total[b] += top + np.log(np.sum(np.exp(logs - top)))
