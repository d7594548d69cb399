"""Independent errors with heavy tails, the robust cost."""

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.data.noise.gaussian import Noise, ScaleSkewness
from en4dvar.model.state import Array


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

    @property
    def expected_curvature(self) -> float:
        """E[ρ''] under the density of ρ: the share within the threshold."""
        return self._inside / (self._inside + 2 / self.threshold * self._edge)

    def scale_skewness(self) -> ScaleSkewness:
        """For large thresholds the same as for Gaussian errors.

        >>> round(HuberNoise(np.ones(1), np.zeros(1), 6.0).scale_skewness().of_scale, 4)
        2.0
        """
        c, edge = self.threshold, self._edge
        if c > 8:  # e^{−c²/2} is rounding there
            return ScaleSkewness()
        from scipy.special import exp1

        norm = self._inside + 2 / c * edge
        slope = self._inside / norm  # E[ψ']
        square = (self._inside - 2 * c * edge) / norm  # E[v²ψ']
        at_edge = 2 * edge / norm  # E[vψ''] = −c · at_edge, E[v³ψ''] = −c³ · at_edge: ψ' drops to 0 at ±c
        weight = slope + 2 * c * edge * float(exp1(c * c)) * math.exp(c * c) / norm  # E[ψ/v]
        information = 1 + square  # E[v²ψ²] − 1 = E[vψ + v²ψ'], for E[vψ] = 1
        return ScaleSkewness(
            (2 * slope - c * at_edge) / weight, (1 + 3 * square - c**3 * at_edge) / information, information
        )

    def _white(self, stream: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Within the threshold of a Gaussian cut there, beyond it exponential."""
        from scipy.special import ndtr, ndtri

        c, (which, where) = self.threshold, stream.uniform(size=(2, *shape))
        inside = self._inside / (self._inside + 2 / c * self._edge)
        within = ndtri(ndtr(-c) + where * (1 - 2 * ndtr(-c)))
        beyond = np.sign(which - (1 + inside) / 2) * (c - np.log(where) / c)
        return np.asarray(np.where(which < inside, within, beyond))

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
