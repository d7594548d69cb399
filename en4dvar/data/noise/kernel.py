"""The covariance of a model's discrepancy along time."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.model.state import Array

NUGGET = 1e-10  # of the amplitude squared, on the diagonal: smooth kernels of close readings are singular to rounding
SMOOTHNESS = {"exponential": 0.5, "matern-3/2": 1.5, "matern-5/2": 2.5}  # name → ν


@dataclass(frozen=True)
class Kernel:
    """cov(δ, δ') = a² g g' k(|t − t'|/ℓ) with a Matérn correlation k of smoothness ν, at ``times`` (K,).

    ν = ½ is exp(−|t − t'|/ℓ), whose paths are continuous and nowhere smooth; those of ν = 3/2 have one derivative,
    those of 5/2 two. g = √(1 + (ṁ/``grows_beyond``)²) grows with the rate of the observable, since a model that is
    early or late errs most where that is fast; g = 1 by default. Source: Rasmussen & Williams (2006), Gaussian
    Processes for Machine Learning, § 4.2.1.

    Raises
    ------
    ValueError: another ν, or ``grows_beyond`` not positive.
    """

    times: Array
    smoothness: float = 0.5
    grows_beyond: float = math.inf

    def __post_init__(self) -> None:
        if self.smoothness not in SMOOTHNESS.values():
            raise ValueError(f"the kernel of a discrepancy has smoothness 0.5, 1.5 or 2.5, not {self.smoothness:g}")
        if not self.grows_beyond > 0:
            raise ValueError("the rate beyond which a discrepancy grows must be positive")

    @property
    def grows(self) -> bool:
        """True if it depends on the rate."""
        return math.isfinite(self.grows_beyond)

    @cached_property
    def steps(self) -> Array:
        """From each time to the next (K − 1,)."""
        return np.diff(self.times)

    @cached_property
    def ordered(self) -> bool:
        """Whether the times increase."""
        return bool(np.all(self.steps > 0))

    @property
    def nugget(self) -> float:
        """Of the amplitude squared, on the diagonal."""
        return NUGGET if self.smoothness > 0.5 else 0.0

    @cached_property
    def lags(self) -> Array:
        """|t − t'| (K, K)."""
        return np.abs(np.subtract.outer(self.times, self.times))

    def correlation(self, length: Array) -> Array:
        """k (…, K, K) for lengths ℓ (…,), with the :data:`NUGGET` where k is smooth."""
        x = math.sqrt(2 * self.smoothness) * self.lags / length[..., None, None]
        k = np.exp(-x)
        if self.smoothness == 1.5:
            k *= 1 + x
        elif self.smoothness == 2.5:
            k *= 1 + x + x * x / 3
        diagonal = np.arange(len(self.times))
        k[..., diagonal, diagonal] = 1 + self.nugget
        return np.asarray(k)

    def log_length_slope(self, length: Array) -> Array:
        """∂k/∂ln ℓ (…, K, K)."""
        x = math.sqrt(2 * self.smoothness) * self.lags / length[..., None, None]
        factor = {0.5: x, 1.5: x * x, 2.5: x * x * (1 + x) / 3}[self.smoothness]
        return np.asarray(factor * np.exp(-x))

    def growth(self, rates: Array | None) -> Array:
        """g (…, K); 1 without rates."""
        if rates is None or not self.grows:
            return np.ones(len(self.times))
        return np.asarray(np.sqrt(1 + (rates / self.grows_beyond) ** 2))

    def log_growth_slope(self, rates: Array) -> Array:
        """∂ln g/∂ṁ (…, K)."""
        return np.asarray(rates / (self.grows_beyond**2 + rates**2)) if self.grows else np.zeros_like(rates)
