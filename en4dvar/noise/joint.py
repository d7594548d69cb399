"""The errors of several series as those of one data set."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from en4dvar.noise.blocks import BlockNoise
from en4dvar.noise.correlated import CorrelatedNoise, Correlation
from en4dvar.noise.gaussian import Noise
from en4dvar.noise.huber import HuberNoise
from en4dvar.state import Array


def noise_of_readings(
    std: Array, time_std: Array, correlation: Array | None = None, thresholds: Array | None = None
) -> Noise:
    """Errors of K readings: ``std``, ``time_std`` and, where some are robust, ``thresholds`` (K,), inf where Gaussian;
    a ``correlation`` (K, K) where some are correlated.

    Where all are of one kind it is that kind. Raises :class:`ValueError` where the matrix is no correlation.
    """
    within = np.full(len(std), math.inf) if thresholds is None else thresholds
    noise = BlockNoise(std, time_std, None if correlation is None else Correlation(correlation), within)
    return noise.blocks[0].noise if len(noise.blocks) == 1 else noise


def joint_noise(times: Sequence[Array], noises: Sequence[Noise], between: Array) -> Noise:
    """The errors of S series, one after the other, from those of each and the correlation ``between`` (S, S) them.

    Errors of series i and j that are independent in time have the correlation ρ_ij at equal times (equal to the bit)
    and none else. Where both are correlated in time they need the same times and the same correlation C, and have
    ρ_ij C (a Kronecker product).

    Raises
    ------
    ValueError: that is not so; ``between`` is no correlation; a robust cost, or a discrepancy, beside a correlation.
    """
    Correlation(between)
    matrices = [_correlation_of(noise) for noise in noises]
    edges = np.cumsum([0, *map(len, times)])
    whole = np.eye(edges[-1])
    for i, matrix in enumerate(matrices):
        here = slice(edges[i], edges[i + 1])
        whole[here, here] = matrix
        for j in range(i):
            if between[i, j]:
                there = slice(edges[j], edges[j + 1])
                whole[here, there] = between[i, j] * _across(times[i], times[j], matrix, matrices[j])
                whole[there, here] = whole[here, there].T
    thresholds = np.concatenate([np.full(len(n.std), n.counts_within) for n in noises])
    std, time_std = (np.concatenate([getattr(n, key) for n in noises]) for key in ("std", "time_std"))
    correlated = np.count_nonzero(whole) > len(whole)
    return noise_of_readings(std, time_std, whole if correlated else None, thresholds)


def _correlation_of(noise: Noise) -> Array:
    """C (K, K) of the errors of one series. Raises :class:`ValueError` for those that have none to be joined."""
    if type(noise) not in (Noise, HuberNoise, CorrelatedNoise, BlockNoise):
        raise ValueError("a discrepancy of the model is not possible beside other series; leave one of them out")
    matrices = noise.matrices()
    return matrices["correlation"][0] if matrices else np.eye(len(noise.std))


def _across(times: Array, others: Array, own: Array, of_others: Array) -> Array:
    """What the correlation of two series is multiplied by, (K, K') over their times."""
    if np.count_nonzero(own) == len(own) and np.count_nonzero(of_others) == len(of_others):
        return (times[:, None] == others).astype(float)
    if not np.array_equal(times, others) or not np.array_equal(own, of_others):
        raise ValueError(
            "two series with errors correlated in time need the same times and the same correlation in time to be "
            "correlated with each other"
        )
    return own
