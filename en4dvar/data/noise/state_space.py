r"""Whitening beside a discrepancy in O(K): its process in state-space form, filtered along the readings.

A Matérn process of smoothness p + ½ is the first component of a linear system (f, f'/λ, …)ᵀ of p + 1 states,
λ = √(2p + 1)/ℓ, with transition e^{−λΔ} times a polynomial in λΔ and the stationary covariance P_∞. Kalman's filter of
y_k − m_k = a_k f(t_k) + ε_k gives what is new in each reading, v_k, and its standard deviation L_kk: the numbers of
the Cholesky factor of R + A, which takes K³/3 operations.

Source: Hartikainen & Särkkä (2010), Proc. IEEE MLSP, 379; Särkkä & Solin (2019), Applied Stochastic Differential
Equations, § 12.3.
"""

from __future__ import annotations

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import called, kernel


def innovations(residuals: Array, errors: Array, amplitudes: Array, lengths: Array, steps: Array, nu: float) -> Array:
    """v and the diagonal of L (2, B, K) of B runs.

    Parameters
    ----------
    residuals: (B, K) y − m. errors: (B, K) variances of ε. amplitudes: (B, K) a g.
    lengths: (B,) ℓ. steps: (K − 1,) > 0 between readings. nu: ½, 3/2 or 5/2.
    """
    order = int(nu + 0.5)
    white = np.empty((2, *residuals.shape))
    with np.errstate(all="ignore"):
        rates = np.sqrt(2 * nu) / lengths
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (residuals, errors, amplitudes, rates, steps)]
    _filter(order, arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], white)
    return white


@kernel
def _filter(
    order: int, residuals: Array, errors: Array, amplitudes: Array, rates: Array, steps: Array, white: Array
) -> None:
    """``white`` (2, B, K), run by run."""
    stationary = np.eye(order)
    if order == 3:
        stationary[1, 1] = 1.0 / 3.0
        stationary[0, 2] = stationary[2, 0] = -1.0 / 3.0
    move, half = np.empty((order, order)), np.empty((order, order))
    apart = np.empty((order, order))  # P − P_∞
    mean, column = np.empty(order), np.empty(order)
    for run in range(residuals.shape[0]):
        mean[:] = 0.0
        apart[:] = 0.0
        for k in range(residuals.shape[1]):
            if k > 0:
                _set_transition(order, rates[run] * steps[k - 1], move)
                _advance(move, mean, apart, column, half)
            a = amplitudes[run, k]
            variance = a * a * (stationary[0, 0] + apart[0, 0]) + errors[run, k]
            if not variance > 0.0:
                variance = np.nan
            missed = residuals[run, k] - a * mean[0]
            white[0, run, k], white[1, run, k] = missed / np.sqrt(variance), np.sqrt(variance)
            for i in range(order):
                column[i] = a * (stationary[i, 0] + apart[i, 0])
            for i in range(order):
                mean[i] += column[i] * missed / variance
                for j in range(order):
                    apart[i, j] -= column[i] * column[j] / variance


@called
def _set_transition(order: int, d: float, move: Array) -> None:
    """Of the state over a step d = λΔ."""
    shrink, q = np.exp(-d), 0.5 * d * d
    if order == 1:
        move[0, 0] = shrink
    elif order == 2:
        move[0, 0], move[0, 1] = shrink * (1 + d), shrink * d
        move[1, 0], move[1, 1] = -shrink * d, shrink * (1 - d)
    else:
        move[0, 0], move[0, 1], move[0, 2] = shrink * (1 + d + q), shrink * (d + 2 * q), shrink * q
        move[1, 0], move[1, 1], move[1, 2] = -shrink * q, shrink * (1 + d - 2 * q), shrink * (d - q)
        move[2, 0], move[2, 1] = shrink * (q - d), shrink * (2 * q - 3 * d)
        move[2, 2] = shrink * (1 - 2 * d + q)


@called
def _advance(move: Array, mean: Array, apart: Array, column: Array, half: Array) -> None:
    """Mean and covariance of the state over a step; ``column`` and ``half`` are room to work in."""
    order = len(mean)
    for i in range(order):
        column[i] = 0.0
        for j in range(order):
            column[i] += move[i, j] * mean[j]
            half[i, j] = 0.0
            for m in range(order):
                half[i, j] += move[i, m] * apart[m, j]
    for i in range(order):
        mean[i] = column[i]
        for j in range(order):
            apart[i, j] = 0.0
            for m in range(order):
                apart[i, j] += half[i, m] * move[j, m]
