r"""Gaussian approximations of per-set likelihoods: the posterior of one data set with its prior divided out.

In transformed coordinates x the posterior of set i is close to N(m_i, C_i) and the prior is N(m_0, C_0), so

    L_i(x) = Z_i N(x; m_i, C_i) / N(x; m_0, C_0) = exp(c_i + η_iᵀx − ½ xᵀΛ_i x),
    Λ_i = C_i⁻¹ − C_0⁻¹,   η_i = C_i⁻¹ m_i − C_0⁻¹ m_0,

with Z_i the evidence. A direction the data say nothing about has Λ = 0; rounding below zero is cut off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.prior import Prior
from en4dvar.problem import Analysis
from en4dvar.state import Array


@dataclass(frozen=True)
class Factors:
    """Likelihoods of S sets over n coordinates: ``precision`` (S, n, n), ``linear`` (S, n), ``constant`` (S,).

    ``prior_mean`` and ``prior_std`` (n,) are those of the prior that was divided out.
    """

    names: tuple[str, ...]
    precision: Array
    linear: Array
    constant: Array
    prior_mean: Array
    prior_std: Array


def factors(analyses: Sequence[Analysis], prior: Prior, keep: Sequence[str] | None = None) -> Factors:
    """Likelihood factors of analyses made with ``prior``; ``keep`` integrates all other coordinates over their prior.

    Members that failed are left out.
    """
    where = [prior.names.index(name) for name in keep or prior.names]
    mean = np.empty((len(analyses), len(where)))
    covariance = np.empty((len(analyses), len(where), len(where)))
    for i, analysis in enumerate(analyses):
        alive = np.array([not reason for reason in analysis.posterior_failures])
        x = prior.from_physical(analysis.posterior[alive])[:, where]
        mean[i] = x.mean(axis=0)
        covariance[i] = np.cov(x, rowvar=False).reshape(len(where), len(where))
    evidence = np.array([a.log_evidence for a in analyses])
    names = tuple(prior.names[j] for j in where)
    return divide_out(names, mean, covariance, evidence, prior.mean[where], prior.std[where])


def divide_out(
    names: tuple[str, ...], mean: Array, covariance: Array, log_evidence: Array, prior_mean: Array, prior_std: Array
) -> Factors:
    """Factors from posterior means (S, n), covariances (S, n, n) and log-evidences (S,); the prior is independent."""
    n = len(names)
    # in units of the prior's standard deviation, so that cutting off means the same in every direction
    scaled = covariance / np.outer(prior_std, prior_std)
    z = (mean - prior_mean) / prior_std
    values, vectors = np.linalg.eigh(scaled)
    gain = np.maximum(1 / values - 1, 0.0)
    precision = np.einsum("sij,sj,skj->sik", vectors, gain, vectors)
    # about the prior mean m_0 = 0 here: η = C⁻¹ z, with the same directions cut off
    inverse = precision + np.eye(n)
    linear = np.einsum("sij,sj->si", inverse, z)
    log_det = -np.linalg.slogdet(inverse)[1]
    constant = log_evidence - 0.5 * log_det - 0.5 * np.einsum("si,si->s", linear, z)
    # back to x = m_0 + s z
    precision_x = precision / np.outer(prior_std, prior_std)
    shift = np.einsum("sij,j->si", precision_x, prior_mean)
    linear_x = linear / prior_std + shift
    constant_x = constant - (linear / prior_std) @ prior_mean - 0.5 * shift @ prior_mean
    return Factors(names, precision_x, linear_x, constant_x, prior_mean, prior_std)


def log_pooled_evidence(shared: Factors) -> float:
    """ln ∫ p(x) Π_i L_i(x) dx: all sets share the coordinates, whose prior is the one divided out."""
    prior_precision = np.diag(shared.prior_std**-2.0)
    A = prior_precision + shared.precision.sum(axis=0)
    b = prior_precision @ shared.prior_mean + shared.linear.sum(axis=0)
    log_prior = -np.sum(np.log(shared.prior_std)) - 0.5 * np.sum((shared.prior_mean / shared.prior_std) ** 2)
    log_integral = 0.5 * b @ np.linalg.solve(A, b) - 0.5 * np.linalg.slogdet(A)[1]
    return float(shared.constant.sum() + log_prior + log_integral)
