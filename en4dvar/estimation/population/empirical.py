"""The median of data sets one by one, with its interval from their scatter: an answer that needs no model of them.

It stands beside that of the hierarchy as a check, and alone where there is no other. In white coordinates of the prior;
each data set counts by 1/(s² + T²), s the standard deviation of its own posterior without what all have in common, and
T² how much they differ beyond the s² (Paule & Mandel 1982, J. Res. NBS 87, 377): a few that are sure of themselves do
not outweigh many others where they disagree with them. The interval is
that of Student's t with the standard deviation of the weighted median under resampling of the data sets (Efron 1979,
Ann. Stat. 7, 1), which is not taken to be smaller than the standard error of the weighted mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from en4dvar.model.state import Array
from en4dvar.priors.prior import PriorTerm, member_stream

RESAMPLED = 2000
TAIL = 0.05
SMALLEST = 1e-12  # variance that a data set is taken to have


@dataclass(frozen=True)
class Empirical:
    """Physical 5, 50 and 95 % of the median over data sets: ``quantiles`` (3,) with all that is uncertain, and the
    parts of its half-width over 1.645 that come from between the data sets and from what they have in common.
    """

    quantiles: Array
    between: float
    common: float


def empirical(term: PriorTerm, middle: Array, std: Array, common: float, seed: int) -> Empirical:
    """Of medians and standard deviations (S,) in white coordinates; ``common``: the standard deviation they share."""
    centre, spread = median_of(middle, std, member_stream(seed, f"empirical {term.parameter.name}"))
    factor = float(stdtrit(len(middle) - 1, 1 - TAIL) / ndtri(1 - TAIL))

    def physical(z: float) -> float:
        return float(term.to_physical(np.array([term.mean + term.std * z]))[0])

    def half_width(size: float) -> float:
        return (physical(centre + size) - physical(centre - size)) / 2

    z = float(ndtri(1 - TAIL)) * float(np.hypot(factor * spread, common))
    quantiles = np.array([physical(centre + shift) for shift in (-z, 0.0, z)])
    return Empirical(quantiles, half_width(factor * spread), half_width(common))


def median_of(middle: Array, std: Array, stream: np.random.Generator) -> tuple[float, float]:
    """The weighted median of data sets (S,), and its standard deviation."""
    from scipy.optimize import brentq  # where it is used: every start would take longer

    variance = np.maximum(std**2, SMALLEST)

    def beyond(between: float) -> float:
        weights = 1 / (variance + between)
        return float(weights @ (middle - np.average(middle, weights=weights)) ** 2) - (len(middle) - 1)

    between = brentq(beyond, 0.0, 2 * middle.var(ddof=1)) if beyond(0.0) > 0 else 0.0
    weights = 1 / (variance + between)
    chosen = stream.integers(len(middle), size=(RESAMPLED, len(middle)))
    medians = _weighted_medians(middle[chosen], weights[chosen])
    spread = max(float(medians.std()), float(weights.sum() ** -0.5))
    return float(_weighted_medians(middle[None], weights[None])[0]), spread


def _weighted_medians(x: Array, weights: Array) -> Array:
    """(B,) of rows (B, S): half of the weight lies below, interpolated between the middles of steps."""
    order = np.argsort(x, axis=1, kind="stable")
    x, weights = np.take_along_axis(x, order, axis=1), np.take_along_axis(weights, order, axis=1)
    below = (np.cumsum(weights, axis=1) - 0.5 * weights) / weights.sum(axis=1, keepdims=True)
    return np.array([np.interp(0.5, shares, values) for shares, values in zip(below, x, strict=True)])
