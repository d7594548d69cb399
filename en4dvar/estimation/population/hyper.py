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

    def log_density(self, nu: Array, log_tau: Array) -> Array:
        """(B,) of ν and ln τ (B, p), normalised; −inf where a spread is out of bounds."""
        p = nu.shape[1]
        constant = -p * (0.5 * math.log(2 * math.pi) + math.log(self.mean_std))
        constant += p * (0.5 * math.log(2 / math.pi) - math.log(self.spread))
        logs = -0.5 * np.sum((nu / self.mean_std) ** 2, axis=1)
        logs += np.sum(log_tau - 0.5 * np.exp(2 * log_tau) / self.spread**2, axis=1)
        inside = np.all((log_tau > math.log(SPREADS[0])) & (log_tau < math.log(SPREADS[1])), axis=1)
        return np.where(inside, logs + constant, -np.inf)

    def scattered(self, count: int, p: int, stream: np.random.Generator) -> Array:
        """(count, 2p) of ν and ln τ somewhere in the bulk of the hyperprior."""
        nu = 0.5 * self.mean_std * stream.standard_normal((count, p))
        return np.hstack([nu, math.log(0.6 * self.spread) + 0.5 * stream.standard_normal((count, p))])
