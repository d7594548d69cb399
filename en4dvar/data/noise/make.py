r"""From what is stated about the errors to their kind, of one series and of several together.

Errors of several series side by side are blocks of readings, each with its own kind of errors, and independent. R is
block diagonal once the readings are ordered by block: readings whose errors are correlated, directly or through others,
are one block of :class:`CorrelatedNoise`, those that are bounds one of :class:`BoundNoise`, those that share the
threshold of a robust cost one of :class:`HuberNoise`, the rest one of :class:`Noise`. So cost, score and information
are sums over blocks, and what each reading contributes stands at its place.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array, csr_array, eye_array

from en4dvar.data.noise.correlated import AnyCorrelation, CorrelatedNoise, Correlation, recorded
from en4dvar.data.noise.discrepancy import DiscrepancyNoise, Kernel, RobustDiscrepancyNoise
from en4dvar.data.noise.gaussian import Linearisation, Noise, Predicted
from en4dvar.data.noise.losses import SIDES, BoundNoise, HuberNoise, record_of, sides_of
from en4dvar.model.state import Array, floats

Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Block:
    """The readings ``where`` (K',) and their errors."""

    where: Indices
    noise: Noise


@dataclass(frozen=True)
class BlockNoise(Noise):
    """``correlation`` (K, K) of the readings, None where no two are correlated; ``thresholds`` (K,) of the robust cost,
    inf where the errors are Gaussian; ``sides`` (K,) of :class:`BoundNoise`, 0 of readings that are no bound.
    """

    correlation: csr_array | None
    thresholds: Array
    sides: Array

    def check(self, weights: Array) -> None:
        super().check(weights)
        if self.thresholds.shape != weights.shape:
            raise ValueError(f"thresholds of the robust cost have shape {self.thresholds.shape}, not {weights.shape}")
        for block in self.blocks:
            block.noise.check(weights[block.where])
            robust = np.isfinite(self.thresholds[block.where]).any()
            if not block.noise.independent and robust:
                raise ValueError("a robust cost needs independent observation errors")
            if np.any(self.sides[block.where]) and (robust or not block.noise.independent):
                raise ValueError("bounds (at_most, at_least) need independent errors without a robust cost")

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """In the order of their first readings."""
        return tuple(sorted(self._blocks(), key=lambda block: int(block.where[0])))

    def _blocks(self) -> Iterator[Block]:
        alone = np.ones(len(self.std), dtype=bool)
        for where, matrix in self._groups():
            alone[where] = False
            yield Block(where, CorrelatedNoise(self.std[where], self.time_std[where], Correlation(matrix)))
        if len(where := np.flatnonzero(alone & (self.sides != 0))):
            alone[where] = False
            yield Block(where, BoundNoise(self.std[where], self.time_std[where], self.sides[where]))
        for threshold in np.unique(self.thresholds[alone]):
            where = np.flatnonzero(alone & (self.thresholds == threshold))
            errors = self.std[where], self.time_std[where]
            yield Block(where, HuberNoise(*errors, float(threshold)) if math.isfinite(threshold) else Noise(*errors))

    def _groups(self) -> Iterator[tuple[Indices, Array]]:
        """Sets of readings that are correlated with each other and with no other, and their matrices."""
        if self.correlation is None:
            return
        from scipy.sparse.csgraph import connected_components

        _, label = connected_components(self.correlation, directed=False)
        order, edges = np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))
        for where in np.split(order, edges[:-1]):
            if len(where) > 1:
                yield where, self.correlation[where][:, where].toarray()

    @property
    def words(self) -> str:
        return "".join(dict.fromkeys(block.noise.words for block in self.blocks))

    @property
    def independent(self) -> bool:  # type: ignore[override]
        return self.correlation is None

    @property
    def counts_within(self) -> float:
        return float(self.thresholds.min())

    @property
    def quadratic(self) -> bool:
        return all(block.noise.quadratic for block in self.blocks)

    def whitened_residual(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: n.whitened_residual(y, p), values)

    def drawn(self, predicted: Predicted, stream: np.random.Generator) -> Array:
        return self._each(predicted, lambda n, y, p: n.drawn(p, stream), predicted.values)

    def influence(self, residual: Array) -> Array:
        return self._each(Predicted(residual), lambda n, v, _: n.influence(v), residual)

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        costs = [b.noise.cost(values[b.where], weights[b.where], predicted.among(b.where)) for b in self.blocks]
        return np.asarray(np.sum(costs, axis=0))

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: n.log_likelihood(y, p), values)

    def log_conditional(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: np.asarray(n.log_conditional(y, p)), values)

    def log_normalisation(self, weights: Array) -> float:
        return sum(block.noise.log_normalisation(weights[block.where]) for block in self.blocks)

    def whiten(self, values: Array, weights: Array, at: Linearisation) -> tuple[Array, Array]:
        parts = [b.noise.whiten(values[b.where], weights[b.where], at.among(b.where)) for b in self.blocks]
        rows = len(parts[0][0]) // len(self.blocks[0].where)  # of each reading: its own, and that of ln s
        d, sensitivity = np.empty((rows, len(values))), np.empty((rows, len(values), len(at.anomalies)))
        for block, (own, slopes) in zip(self.blocks, parts, strict=True):
            d[:, block.where] = own.reshape(rows, -1)
            sensitivity[:, block.where] = slopes.reshape(rows, len(block.where), -1)
        return d.ravel(), sensitivity.reshape(rows * len(values), -1)

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        product = np.empty_like(vectors)
        for b in self.blocks:
            product[..., b.where] = b.noise.precision_times(
                values[b.where], weights[b.where], at.among(b.where), vectors[..., b.where]
            )
        return product

    def pulls(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: n.pulls(y, p), values)

    def whitened_rows(self, values: Array, rows: Array, predicted: Predicted) -> Array:
        white = np.empty((len(predicted.values), *rows.shape))
        for b in self.blocks:
            own = b.noise.whitened_rows(values[b.where], rows[:, b.where], predicted.among(b.where))
            white[..., b.where] = own
        return white

    def matrices(self) -> dict[str, tuple[Array, str]]:
        bounds = record_of(self.sides) if np.any(self.sides) else {}
        if self.correlation is None:
            return bounds
        entries = self.correlation.tocoo()
        return {
            **bounds,
            "correlation": (entries.data, "correlation of the errors of two readings, of those that are correlated"),
            "correlation_row": (entries.row, "which reading, counted from 0"),
            "correlation_column": (entries.col, "and which other"),
        }

    def _each(self, predicted: Predicted, of: Callable[[Noise, Array, Predicted], Array], values: Array) -> Array:
        """(…, K) of what each block gives of its readings (…, K')."""
        values_of_all = np.empty(np.broadcast_shapes(predicted.values.shape, values.shape))
        for block in self.blocks:
            values_of_all[..., block.where] = of(block.noise, values[..., block.where], predicted.among(block.where))
        return values_of_all


def noise_of_record(
    times: Array, std: Array, time_std: Array, matrices: Mapping[str, Array], attributes: Mapping[str, object]
) -> Noise:
    """The errors whose :meth:`Noise.matrices` and :meth:`Noise.attributes` are among what a file holds."""
    numbers = "huber_threshold", "discrepancy_smoothness", "discrepancy_grows_beyond"
    held = {key: float(cast(float, attributes[key])) for key in numbers if key in attributes}
    kernel = None
    if "discrepancy_smoothness" in held:
        kernel = Kernel(times, held["discrepancy_smoothness"], held["discrepancy_grows_beyond"])
    return noise_of(std, time_std, recorded(matrices), held.get("huber_threshold"), kernel, matrices.get(SIDES))


def noise_of(
    std: Array,
    time_std: Array | None = None,
    correlation: Array | AnyCorrelation | None = None,
    huber: float | None = None,
    discrepancy: Kernel | None = None,
    sides: Array | None = None,
) -> Noise:
    """Errors of the kind that is given: independent, correlated by a matrix (K, K), by what they share or as they
    decay, or robust beyond ``huber`` std.

    Any of them may stand beside a ``discrepancy`` of the model; its amplitude and length are then parameters
    (:data:`~en4dvar.model.state.DISCREPANCY`). ``sides`` (K,): readings that are upper (1) or lower (−1) bounds.

    Raises ValueError: both a correlation and a robust cost, either or a discrepancy beside bounds, or a matrix that is
    no correlation.
    """
    std = floats(std)
    time_std = np.zeros_like(std) if time_std is None else floats(time_std)
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
    noise = BlockNoise(std, time_std, correlation, within, np.zeros(len(std)) if sides is None else sides)
    return noise.blocks[0].noise if len(noise.blocks) == 1 else noise


def joint_noise(times: Sequence[Array], noises: Sequence[Noise], between: Array) -> Noise:
    """The errors of S series, one after the other, from those of each and the correlation ``between`` (S, S) them.

    Errors of series i and j that are independent in time have the correlation ρ_ij at equal times (equal to the bit)
    and none else. Where both are correlated in time they need the same times and the same correlation C, and have
    ρ_ij C (a Kronecker product). What is not correlated takes no memory.

    Raises ValueError: that is not so; ``between`` is no correlation; a robust cost, or a discrepancy, beside a
    correlation.
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
        what = "a discrepancy of the model is" if noise.discrepant else f"errors of the kind {type(noise).__name__} are"
        raise ValueError(f"{what} not possible beside other series; leave one of them out")
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
        words = "two series with errors correlated in time need the same times and the same correlation in time"
        raise ValueError(f"{words} to be correlated with each other")
    return own
