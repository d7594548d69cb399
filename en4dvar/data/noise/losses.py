"""Independent errors with another loss than ½ v²: heavy tails, the robust cost; and readings that are bounds."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.data.noise.gaussian import Noise, Predicted
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError

SIDES = "sides"  # in the record
WORDS = {1: "at most", -1: "at least"}


@dataclass(frozen=True)
class HuberNoise(Noise):
    """Independent errors with exponential tails beyond ``threshold`` c > 0 standard deviations."""

    threshold: float

    def check(self, weights: Array) -> None:
        super().check(weights)
        if not self.threshold > 0:
            raise ValueError("the threshold of the robust cost must be positive")

    @property
    def words(self) -> str:
        return f", robust beyond {self.threshold:g} std"

    @property
    def counts_within(self) -> float:
        return self.threshold

    def influence(self, residual: Array) -> Array:
        return np.asarray(self.threshold / np.maximum(np.abs(residual), self.threshold))

    def attributes(self) -> dict[str, float]:
        return {"huber_threshold": self.threshold}

    @cached_property
    def expected_curvature(self) -> float:
        """The share of the density within the threshold."""
        return self._inside / (self._inside + 2 / self.threshold * self._edge)

    @cached_property
    def scale_information(self) -> float:  # type: ignore[override]
        """E[v²ψ²] − 1 = 1 + E[v²ψ'], ψ = ρ': for large thresholds the same as for Gaussian errors."""
        return 1 + (self._inside - 2 * self.threshold * self._edge) / math.exp(self._log_norm())

    def _white(self, stream: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Within the threshold of a Gaussian cut there, beyond it exponential."""
        from scipy.special import ndtr, ndtri

        c, (which, where) = self.threshold, stream.uniform(size=(2, *shape))
        within = ndtri(ndtr(-c) + where * (1 - 2 * ndtr(-c)))
        beyond = np.sign(which - (1 + self.expected_curvature) / 2) * (c - np.log(where) / c)
        return np.asarray(np.where(which < self.expected_curvature, within, beyond))

    def _loss(self, v: Array) -> Array:
        inner = np.minimum(np.abs(v), self.threshold)
        return np.asarray(inner * (np.abs(v) - 0.5 * inner))

    def _log_norm(self) -> float:
        return math.log(self._inside + 2 / self.threshold * self._edge)

    @property
    def _edge(self) -> float:
        """exp(−½c²)."""
        return math.exp(-0.5 * self.threshold**2)

    @property
    def _inside(self) -> float:
        """∫ exp(−½v²) dv over |v| < c."""
        return math.sqrt(2 * math.pi) * math.erf(self.threshold / math.sqrt(2))


@dataclass(frozen=True)
class BoundNoise(Noise):
    """Independent bounds: ``sides`` (K,) is 1 where the reading says "at most", −1 where it says "at least".

    A prediction on the right side costs nothing; beyond the bound J_o is that of a Gaussian error, ½ v². So exp(−J_o)
    is the probability that the statement is made of a prediction, not a density of readings: it is at most 1, and there
    is nothing to normalise. The inequalities of PEST++ have the same cost (White et al. 2020, USGS TM 7C26, § 9.1.14).
    """

    sides: Array

    quadratic = False

    def check(self, weights: Array) -> None:
        super().check(weights)
        if not np.all(np.abs(self.sides) == 1):
            raise ValueError("a reading is at most or at least what is stated, not both")
        if self.timed:
            raise ValueError("bounds (at_most, at_least) take no timing error")

    @property
    def words(self) -> str:
        return "".join(f", {words}" for side, words in WORDS.items() if np.any(self.sides == side))

    def influence(self, residual: Array) -> Array:
        return np.where(self.sides * residual < 0, 1.0, 0.0)

    def drawn(self, predicted: Predicted, stream: np.random.Generator) -> Array:
        """Raises :class:`ConfigError`: nothing says which bound would be stated of a prediction."""
        raise ConfigError("readings that are bounds (at_most, at_least) cannot be drawn from a model; leave them out")

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        return -self._loss(self.whitened_residual(values, predicted))

    def log_normalisation(self, weights: Array) -> float:
        return 0.0

    def matrices(self) -> dict[str, tuple[Array, str]]:
        return record_of(self.sides)

    def _loss(self, v: Array) -> Array:
        return np.asarray(0.5 * v * v * self.influence(v))


def record_of(sides: Array) -> dict[str, tuple[Array, str]]:
    """``sides`` (K,) for the record."""
    return {SIDES: (sides, "1: the reading is an upper bound, -1: a lower bound, 0: neither")}


def sides_of(noise: Noise) -> Array:
    """(K,) 1 and −1 of readings that are upper and lower bounds, 0 of the others."""
    sides = getattr(noise, SIDES, None)
    return np.zeros(len(noise.std)) if sides is None else np.asarray(sides)
