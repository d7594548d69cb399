r"""Likelihoods of data sets as mixtures of Gaussians, and what they say about a population.

The draws of a posterior L_i(x) N(x; 0, C_0) are described by a mixture Σ_m a_m N(c_m, Σ_m); the prior is divided out
of every component, so that

    L_i(x) ∝ Σ_m exp(k_m + η_mᵀx − ½ xᵀΛ_m x),     Λ_m = Σ_m⁻¹ − C_0⁻¹,   η_m = Σ_m⁻¹ c_m,
    ∫ L_i(x) N(x; ν, D) dx = Σ_m exp(k_m + ½ bᵀA⁻¹b − ½ νᵀD⁻¹ν) |I + DΛ_m|^{-1/2},  A = Λ_m + D⁻¹, b = η_m + D⁻¹ν,

and x given ν, D is drawn exactly: a component, then N(A⁻¹b, A⁻¹). A direction the data say nothing about has Λ = 0;
rounding below zero is cut off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel


class Mixture(NamedTuple):
    """L of one set: ``precision`` Λ (M, n, n), ``linear`` η (M, n), ``constant`` k (M,). Kernels can read it."""

    precision: Array
    linear: Array
    constant: Array

    @classmethod
    def divided(cls, mean: Array, covariance: Array, log_share: Array, prior_std: Array) -> Mixture:
        """Components of the posterior, means (M, n) and covariances (M, n, n), with the prior N(0, diag prior_std²)
        divided out. ``log_share`` (M,): ln of the components' shares.
        """
        # in units of the prior's standard deviation, so that cutting off means the same in every direction
        z = mean / prior_std
        values, vectors = np.linalg.eigh(covariance / np.outer(prior_std, prior_std))
        gain = np.maximum(1 / values - 1, 0.0)
        precision = np.einsum("sij,sj,skj->sik", vectors, gain, vectors)
        inverse = precision + np.eye(len(prior_std))
        linear = np.einsum("sij,sj->si", inverse, z)  # η = C⁻¹ z, with the same directions cut off
        log_det = -np.linalg.slogdet(inverse)[1]
        constant = log_share - 0.5 * log_det - 0.5 * np.einsum("si,si->s", linear, z)
        return cls(precision / np.outer(prior_std, prior_std), linear / prior_std, constant)


def log_marginal(mixture: Mixture, mean: Array, variance: Array) -> Array:
    """(B,) ln ∫ L(x) N(x; mean, diag variance) dx, for ``mean`` and ``variance`` (B, n)."""
    out = np.empty(len(mean))
    _log_marginal(mixture, mean, variance, out)
    return out


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
def _log_marginal(mixture: Mixture, mean: Array, variance: Array, out: Array) -> None:
    n_parts, n = mixture.linear.shape
    middle, root, logs = np.empty(n), np.zeros((n, n)), np.empty(n_parts)
    for b in range(mean.shape[0]):
        for m in range(n_parts):
            part = condition(mixture.precision[m], mixture.linear[m], mean[b], variance[b], middle, root)
            logs[m] = mixture.constant[m] + part
        top = logs.max()
        out[b] = top + np.log(np.sum(np.exp(logs - top)))
