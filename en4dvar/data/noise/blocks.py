r"""Errors of several series side by side: blocks of readings, each with its own kind of errors, and independent.

R is block diagonal once the readings are ordered by block: readings whose errors are correlated, directly or through
others, are one block of :class:`CorrelatedNoise`, those that are bounds one of :class:`BoundNoise`, those that share
the threshold of a robust cost one of :class:`HuberNoise`, the rest one of :class:`Noise`. So cost, score and
information are sums over blocks, and what each reading contributes stands at its place.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from en4dvar.data.noise.correlated import CorrelatedNoise, Correlation
from en4dvar.data.noise.gaussian import Linearisation, Noise, Predicted, ScaleSkewness
from en4dvar.data.noise.losses import BoundNoise, HuberNoise, record_of
from en4dvar.model.state import Array

Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Block:
    """The readings ``where`` (K',) and their errors."""

    where: Indices
    noise: Noise


@dataclass(frozen=True)
class BlockNoise(Noise):
    """``correlation`` (K, K) of the readings, None where no two are correlated; ``thresholds`` (K,) of the robust cost,
    inf where the errors are Gaussian; ``sides`` (K,) of :class:`BoundNoise`, 0 of readings that are no bound, None
    where none is.
    """

    correlation: csr_array | None
    thresholds: Array
    sides: Array | None = None

    def check(self, weights: Array) -> None:
        super().check(weights)
        if self.thresholds.shape != weights.shape:
            raise ValueError(f"thresholds of the robust cost have shape {self.thresholds.shape}, not {weights.shape}")
        for block in self.blocks:
            block.noise.check(weights[block.where])
            robust = np.isfinite(self.thresholds[block.where]).any()
            if not block.noise.independent and robust:
                raise ValueError("a robust cost needs independent observation errors")
            if np.any(self._bounds[block.where]) and (robust or not block.noise.independent):
                raise ValueError("bounds (at_most, at_least) need independent errors without a robust cost")

    @cached_property
    def _bounds(self) -> Array:
        return np.zeros(len(self.std)) if self.sides is None else self.sides

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """In the order of their first readings."""
        return tuple(sorted(self._blocks(), key=lambda block: int(block.where[0])))

    def _blocks(self) -> Iterator[Block]:
        alone = np.ones(len(self.std), dtype=bool)
        for where, matrix in self._groups():
            alone[where] = False
            yield Block(where, CorrelatedNoise(self.std[where], self.time_std[where], Correlation(matrix)))
        if len(where := np.flatnonzero(alone & (self._bounds != 0))):
            alone[where] = False
            yield Block(where, BoundNoise(self.std[where], self.time_std[where], self._bounds[where]))
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
    def independent(self) -> bool:
        return self.correlation is None

    @property
    def counts_within(self) -> float:
        return float(self.thresholds.min())

    @property
    def quadratic(self) -> bool:
        return all(block.noise.quadratic for block in self.blocks)

    def frozen(self, predicted: Predicted) -> Noise:
        return replace(self, std=self.error_std(predicted), time_std=np.zeros_like(self.std))

    def whitened_residual(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: n.whitened_residual(y, p), values)

    def drawn(self, predicted: Predicted, stream: np.random.Generator) -> Array:
        return self._each(predicted, lambda n, y, p: n.drawn(p, stream), predicted.values)

    def down_weights(self, values: Array, predicted: Predicted) -> Array | None:
        if not math.isfinite(self.counts_within):
            return None
        return self._each(predicted, lambda n, y, p: n.influence(n.whitened_residual(y, p)), values)

    def squares(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: n.squares(y, p), values)

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        costs = [b.noise.cost(values[b.where], weights[b.where], part(predicted, b.where)) for b in self.blocks]
        return np.asarray(np.sum(costs, axis=0))

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: n.log_likelihood(y, p), values)

    def log_conditional(self, values: Array, predicted: Predicted) -> Array:
        return self._each(predicted, lambda n, y, p: np.asarray(n.log_conditional(y, p)), values)

    def log_normalisation(self, weights: Array) -> float:
        return sum(block.noise.log_normalisation(weights[block.where]) for block in self.blocks)

    def whiten(self, values: Array, weights: Array, at: Linearisation) -> tuple[Array, Array]:
        parts = [b.noise.whiten(values[b.where], weights[b.where], tangent(at, b.where)) for b in self.blocks]
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
                values[b.where], weights[b.where], part(at, b.where), vectors[..., b.where]
            )
        return product

    def scale_skewness(self) -> ScaleSkewness:
        """The mean over the readings: they inform the one scale together."""
        share = [len(block.where) / len(self.std) for block in self.blocks]
        each = zip(*(astuple(block.noise.scale_skewness()) for block in self.blocks), strict=True)
        return ScaleSkewness(*(sum(w * of_block for w, of_block in zip(share, of, strict=True)) for of in each))

    def matrices(self) -> dict[str, tuple[Array, str]]:
        bounds = {} if self.sides is None else record_of(self.sides)
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
            values_of_all[..., block.where] = of(block.noise, values[..., block.where], part(predicted, block.where))
        return values_of_all


def part(predicted: Predicted, where: Indices) -> Predicted:
    """The predictions of some of the readings."""
    rates = None if predicted.rates is None else predicted.rates[..., where]
    return replace(predicted, values=predicted.values[..., where], rates=rates)


def tangent(at: Linearisation, where: Indices) -> Linearisation:
    """The linearisation for some of the readings."""
    rates = None if at.rate_anomalies is None else at.rate_anomalies[:, where]
    return replace(at, prediction=part(at.prediction, where), anomalies=at.anomalies[:, where], rate_anomalies=rates)
