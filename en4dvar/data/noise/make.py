"""From what is stated about the errors to their kind, of one series and of several together."""

import math
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from scipy.sparse import block_array, csr_array, eye_array

from en4dvar.data.noise.blocks import BlockNoise
from en4dvar.data.noise.correlated import SHARED, CorrelatedNoise, Correlation, SharedErrors
from en4dvar.data.noise.discrepancy import DiscrepancyNoise, Kernel
from en4dvar.data.noise.gaussian import Noise
from en4dvar.data.noise.losses import SIDES, BoundNoise, HuberNoise, sides_of
from en4dvar.data.noise.robust_discrepancy import RobustDiscrepancyNoise
from en4dvar.model.state import Array


def noise_of_record(
    times: Array, std: Array, time_std: Array, matrices: Mapping[str, Array], attributes: Mapping[str, object]
) -> Noise:
    """The errors whose :meth:`Noise.matrices` and :meth:`Noise.attributes` are among what a file holds."""
    numbers = "huber_threshold", "discrepancy_smoothness", "discrepancy_grows_beyond"
    held = {key: float(cast(float, attributes[key])) for key in numbers if key in attributes}
    kernel = None
    if "discrepancy_smoothness" in held:
        kernel = Kernel(times, held["discrepancy_smoothness"], held["discrepancy_grows_beyond"])
    correlation = SharedErrors(matrices[SHARED]) if SHARED in matrices else matrices.get("correlation")
    return noise_of(std, time_std, correlation, held.get("huber_threshold"), kernel, matrices.get(SIDES))


def noise_of(
    std: Array,
    time_std: Array | None = None,
    correlation: Array | SharedErrors | None = None,
    huber: float | None = None,
    discrepancy: Kernel | None = None,
    sides: Array | None = None,
) -> Noise:
    """Errors of the kind that is given: independent, correlated by a matrix (K, K) or by what they share, or robust
    beyond ``huber`` std.

    Any of them may stand beside a ``discrepancy`` of the model; its amplitude and length are then parameters
    (:data:`~en4dvar.model.state.DISCREPANCY`). ``sides`` (K,): readings that are upper (1) or lower (−1) bounds.

    Raises
    ------
    ValueError: both a correlation and a robust cost, either or a discrepancy beside bounds, or a matrix that is no
        correlation.
    """
    time_std = np.zeros_like(std) if time_std is None else time_std
    if sides is not None and np.any(sides):
        if correlation is not None or huber is not None or discrepancy is not None:
            raise ValueError("bounds (at_most, at_least) stand beside no correlation, robust cost or discrepancy")
        return noise_of_readings(std, time_std, sides=sides)
    if correlation is not None and huber is not None:
        raise ValueError("a robust cost needs independent observation errors")
    between = Correlation(correlation) if isinstance(correlation, np.ndarray) else correlation
    if discrepancy is not None and huber is not None:
        return RobustDiscrepancyNoise(std, time_std, discrepancy, None, huber)
    if discrepancy is not None:
        return DiscrepancyNoise(std, time_std, discrepancy, between)
    if between is not None:
        return CorrelatedNoise(std, time_std, between)
    return Noise(std, time_std) if huber is None else HuberNoise(std, time_std, huber)


def noise_of_readings(
    std: Array,
    time_std: Array,
    correlation: csr_array | None = None,
    thresholds: Array | None = None,
    sides: Array | None = None,
) -> Noise:
    """Errors of K readings: ``std``, ``time_std`` and, where some are robust, ``thresholds`` (K,), inf where Gaussian;
    a ``correlation`` (K, K) where some are correlated, with a unit diagonal; ``sides`` (K,) of bounds, 0 of the others.

    Where all are of one kind it is that kind. Raises :class:`ValueError` where the matrix is no correlation.
    """
    within = np.full(len(std), math.inf) if thresholds is None else thresholds
    noise = BlockNoise(std, time_std, correlation, within, sides if np.any(sides) else None)
    return noise.blocks[0].noise if len(noise.blocks) == 1 else noise


def joint_noise(times: Sequence[Array], noises: Sequence[Noise], between: Array) -> Noise:
    """The errors of S series, one after the other, from those of each and the correlation ``between`` (S, S) them.

    Errors of series i and j that are independent in time have the correlation ρ_ij at equal times (equal to the bit)
    and none else. Where both are correlated in time they need the same times and the same correlation C, and have
    ρ_ij C (a Kronecker product). What is not correlated takes no memory.

    Raises
    ------
    ValueError: that is not so; ``between`` is no correlation; a robust cost, or a discrepancy, beside a correlation.
    """
    Correlation(between)
    matrices = [correlation_of(noise) for noise in noises]
    blocks = [[None] * len(noises) for _ in noises]
    for i, matrix in enumerate(matrices):
        blocks[i][i] = matrix
        for j in range(i):
            if between[i, j]:
                across = between[i, j] * _across(times[i], times[j], matrix, matrices[j])
                blocks[i][j], blocks[j][i] = across, across.T
    whole = block_array(blocks, format="csr")
    whole.eliminate_zeros()
    thresholds = np.concatenate([np.full(len(n.std), n.counts_within) for n in noises])
    std, time_std = (np.concatenate([getattr(n, key) for n in noises]) for key in ("std", "time_std"))
    sides = np.concatenate([sides_of(noise) for noise in noises])
    return noise_of_readings(std, time_std, whole if _correlated(whole) else None, thresholds, sides)


def correlation_of(noise: Noise) -> csr_array:
    """C (K, K) of the errors of one series. Raises :class:`ValueError` for those that have none to be joined."""
    if isinstance(noise, BlockNoise) and noise.correlation is not None:
        return noise.correlation
    if isinstance(noise, CorrelatedNoise):
        return csr_array(noise.correlation.matrix)
    if type(noise) not in (Noise, HuberNoise, BoundNoise, BlockNoise):
        raise ValueError("a discrepancy of the model is not possible beside other series; leave one of them out")
    return eye_array(len(noise.std), format="csr")


def _correlated(matrix: csr_array) -> bool:
    """True if there is more than a diagonal."""
    return bool(matrix.count_nonzero() > matrix.shape[0])


def _across(times: Array, others: Array, own: csr_array, of_others: csr_array) -> csr_array:
    """Factor (K, K') of the correlation of two series, over their times."""
    if not _correlated(own) and not _correlated(of_others):
        instants, label = np.unique(np.concatenate([times, others]), return_inverse=True)
        at = csr_array((np.ones(len(label)), (np.arange(len(label)), label)), shape=(len(label), len(instants)))
        return csr_array(at[: len(times)] @ at[len(times) :].T)
    if not np.array_equal(times, others) or (own != of_others).nnz:
        raise ValueError(
            "two series with errors correlated in time need the same times and the same correlation in time to be "
            "correlated with each other"
        )
    return own
