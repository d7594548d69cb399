"""Neo-Hookean or quadratic law: evidence of each data set, of all of them with one gel, and when not to decide."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array

DECISIVE = 3.0  # |Δ log-evidence|: odds of 20 to 1
MISFIT = 2.0  # χ² per reading above which a model is not one of those to choose from


@dataclass(frozen=True)
class Comparison:
    """Log-evidence of the quadratic over the neo-Hookean law.

    ``single`` (S,) of each data set by itself. ``population``: parameters of all bubbles about a common mean with a
    common spread. ``shared``: of all of them in one gel, material parameters common and R0, t_s of each bubble's own.
    ``chi2`` of one gel per reading, (neo-Hookean, quadratic): far from one where no single gel explains the readings.
    """

    single: Array
    population: float
    shared: float
    chi2: tuple[float, float]

    @property
    def independent(self) -> float:
        """Evidence of all data sets, every bubble in a gel of its own."""
        return float(self.single.sum())

    @property
    def undecidable(self) -> int:
        """Data sets that cannot tell the laws apart."""
        return int(np.sum(np.abs(self.single) < DECISIVE))


@dataclass(frozen=True)
class OneGel:
    """One law with one value of its parameters in all data sets of a gel."""

    log_evidence: float
    chi2_per_observation: float


def probability(difference: Array) -> Array:
    """Probability of the favoured-by-positive model at equal prior odds, 1/(1 + e^−Δ)."""
    return np.asarray(0.5 * (1 + np.tanh(np.asarray(difference) / 2)))


def verdict(difference: float, positive: str = "quadratic law", negative: str = "neo-Hookean") -> str:
    """In words: which model, and at what odds, or that the data cannot tell."""
    if not math.isfinite(difference):
        return "unknown"
    if abs(difference) < DECISIVE:
        return "undecidable"
    return f"{positive if difference > 0 else negative} (odds e^{abs(difference):.0f} : 1)"
