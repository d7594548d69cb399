r"""Errors with heavy tails beside a discrepancy of the model.

δ cannot be integrated out of Huber's density, so it is marginalised by Laplace's approximation at its mode,

    J_o = β { min_δ [ Σ ρ((r − δ)/s) + ½ δᵀA⁻¹δ ] + ½ ln det(S²/κ + A) + ½ K ln κ − Σ ln std },     r = y − m,

with the expected curvature κ = E[ρ''] in place of that at each reading, which jumps where one crosses the threshold. It
is exact for Gaussian errors (c → ∞) and without a discrepancy. At the minimum u = A⁻¹δ = ρ'(v)/s with v = (r − δ)/s;
u solves a quadratic problem in the box |u| ≤ c/s, found along the readings (:mod:`~en4dvar.data.noise.state_space`).
Then ∂J_o/∂m = −u, and rows of d and S are those of S²/w + A, w = ρ'(v)/v.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from en4dvar.data.noise.discrepancy import DiscrepancyNoise
from en4dvar.data.noise.gaussian import Predicted
from en4dvar.data.noise.losses import HuberNoise
from en4dvar.data.noise.state_space import boxed
from en4dvar.model.state import Array


@dataclass(frozen=True)
class RobustDiscrepancyNoise(DiscrepancyNoise):
    """Independent errors with exponential tails beyond ``threshold`` std, beside a discrepancy."""

    threshold: float = math.inf

    @cached_property
    def huber(self) -> HuberNoise:
        """The same errors without a discrepancy."""
        return HuberNoise(self.std, self.time_std, self.threshold)

    def check(self, weights: Array) -> None:
        super().check(weights)
        self.huber.check(weights)

    @property
    def words(self) -> str:
        return f"{self.huber.words} + discrepancy"

    @property
    def counts_within(self) -> float:
        return self.threshold

    @property
    def expected_light(self) -> float:  # type: ignore[override]
        return self.huber.expected_curvature

    def attributes(self) -> dict[str, float]:
        return {**self.huber.attributes(), **super().attributes()}

    def gaussian_at(self, values: Array, predicted: Predicted) -> DiscrepancyNoise:
        root = np.sqrt(self._light(values, predicted))
        return DiscrepancyNoise(self.std / root, self.time_std / root, self.kernel)

    def _light(self, values: Array, predicted: Predicted) -> Array:
        _, errors, s, *_ = self._at_mode(values, predicted)
        most = self.threshold * s
        return np.asarray(most / np.maximum(np.abs(errors), most))

    def _more_variance(self, values: Array, predicted: Predicted) -> Array:
        first = slice(len(values))
        kernel = replace(self.kernel, times=self.kernel.times[first])
        within = replace(self, std=self.std[first], time_std=self.time_std[first], kernel=kernel)
        there = predicted.among(first)
        return np.asarray(within.error_std(there) ** 2 * (1 / within._light(values, there) - 1))

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        terms = self._terms(values, predicted)
        with np.errstate(over="ignore", invalid="ignore"):
            total = weights[0] * np.sum(terms - np.log(self.std), axis=-1)
        return np.where(np.isfinite(total), total, np.inf)

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        """Shares of the observations (…, K): a division of the joint density; single terms have no meaning."""
        return -self._terms(values, predicted) - self._log_norm()

    def log_conditional(self, values: Array, predicted: Predicted) -> None:
        """None: the joint density is an approximation that knows no reading by itself."""

    def _white(self, stream: np.random.Generator, shape: tuple[int, ...]) -> Array:
        return self.huber._white(stream, shape)

    def _log_norm(self) -> float:
        return self.huber._log_norm()

    def _terms(self, values: Array, predicted: Predicted) -> Array:
        """Terms of J_o (…, K), β and ln std apart; NaN where a prediction is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            u, errors, s, delta, roots = self._at_mode(values, predicted)
            terms = self.huber._loss(errors / s) + 0.5 * u * delta + np.log(roots)
            return np.asarray(terms + 0.5 * math.log(self.expected_light))

    def _at_mode(self, values: Array, predicted: Predicted) -> Array:
        """u, r − δ, s and δ at the mode in δ, and the diagonal of the root of S²/κ + A (5, …, K)."""
        with np.errstate(over="ignore", invalid="ignore"):
            k, (residual, s, a, length) = self.kernel, self._in_time(values, predicted)
            u, delta = boxed(residual, s, k.nugget * a**2, a, length, k.steps, k.smoothness, self.threshold)
            _, roots = self._filtered(residual, s**2 / self.expected_light, a, length)
            return np.reshape([u, residual - delta, s, delta, roots], (5, *predicted.values.shape))
