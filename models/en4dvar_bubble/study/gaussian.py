r"""Gaussian approximations of per-set likelihoods: the posterior of one data set with its prior divided out.

In transformed coordinates x the posterior of set i is close to N(m_i, C_i) and the prior is N(m_0, C_0), so

    L_i(x) = Z_i N(x; m_i, C_i) / N(x; m_0, C_0) = exp(c_i + η_iᵀx − ½ xᵀΛ_i x),
    Λ_i = C_i⁻¹ − C_0⁻¹,   η_i = C_i⁻¹ m_i − C_0⁻¹ m_0,

with Z_i the evidence. A direction the data say nothing about has Λ = 0; rounding below zero is cut off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
