"""The hyperprior: what is known beforehand of the mean ν and the spread τ of a population, h = (ν, ln τ)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Lt

from en4dvar.model.state import Array

SPREADS = (1e-3, 10.0)  # of τ; smaller ones are indistinguishable, and lost to rounding in the marginals


@dataclass(frozen=True)
class HyperPrior:
    """Standard deviation of ν about the prior mean and scale of τ, in transformed coordinates; share of odd sets."""

    mean_std: Annotated[
        float, Gt(0), "Hyperprior of the mean: normal about the prior's, with so many of its standard deviations."
    ] = 1.0
    spread: Annotated[
        float, Gt(0), "Hyperprior of the spread: half-normal, with so many of the prior's standard deviations."
    ] = 0.5
    odd: Annotated[
        float, Ge(0), Lt(1), "Probability that a data set is odd: of another population, in all parameters or in one."
    ] = 0.05


class Hyper:
    """The hyperprior over h = (ν, ln τ) of p coordinates."""

    def __init__(self, p: int, scales: HyperPrior):
        self.p, self.scales = p, scales
        self.constant = -p * (0.5 * math.log(2 * math.pi) + math.log(scales.mean_std))
        self.constant += p * (0.5 * math.log(2 / math.pi) - math.log(scales.spread))

    def population(self, h: Array) -> tuple[Array, Array]:
        """Mean and variance (B, p) of x given h (B, 2p)."""
        return h[:, : self.p], np.exp(2 * h[:, self.p :])

    def log_density(self, h: Array) -> Array:
        """(B,), normalised; −inf where a spread is out of bounds."""
        nu, log_tau = h[:, : self.p], h[:, self.p :]
        logs = -0.5 * np.sum((nu / self.scales.mean_std) ** 2, axis=1)
        logs += np.sum(log_tau - 0.5 * np.exp(2 * log_tau) / self.scales.spread**2, axis=1)
        inside = np.all((log_tau > math.log(SPREADS[0])) & (log_tau < math.log(SPREADS[1])), axis=1)
        return np.where(inside, logs + self.constant, -np.inf)

    def scattered(self, count: int, stream: np.random.Generator) -> Array:
        """(count, 2p) somewhere in the bulk of the hyperprior."""
        nu = 0.5 * self.scales.mean_std * stream.standard_normal((count, self.p))
        return np.hstack([nu, math.log(0.6 * self.scales.spread) + 0.5 * stream.standard_normal((count, self.p))])
