"""Neo-Hookean or quadratic law: evidence of each data set, of all of them with one gel, and when not to decide."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.state import Array
from en4dvar_bubble.study.gaussian import Factors, log_pooled_evidence

DECISIVE = 3.0  # |Δ log-evidence|: odds of 20 to 1


@dataclass(frozen=True)
class Comparison:
    """Log-evidence of the quadratic over the neo-Hookean law.

    ``single`` (S,) of each data set by itself. ``independent``: of all of them, every bubble in a gel of its own.
    ``population``: mean and spread of the material parameters common (hierarchical step).
    ``shared``: of all of them in one gel, material parameters common and R0, t_s of each bubble's own.
    """

    single: Array
    independent: float
    population: float
    shared: float

    @property
    def undecidable(self) -> int:
        """Data sets that cannot tell the laws apart."""
        return int(np.sum(np.abs(self.single) < DECISIVE))


def compare_laws(nh: Factors, quadratic: Factors, log_nh: Array, log_quadratic: Array, population: float) -> Comparison:
    """From the likelihood factors of the shared coordinates, the log-evidences (S,) of both laws, and the difference of
    their hierarchical log-evidences.
    """
    single = log_quadratic - log_nh
    shared = log_pooled_evidence(quadratic) - log_pooled_evidence(nh)
    return Comparison(single, float(single.sum()), population, shared)


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
