r"""The influence of each reading on a posterior, and its distance from the prior's expectation.

The linear Gaussian posterior knows it exactly: with rows S_k, d_k of the whitened arrays that belong to reading k, one
of independent errors, members of mean c̄ and covariance P in the coordinates of the tangent become members of

    P₋ₖ = (P⁻¹ − S_kᵀS_k)⁻¹,     c̄ − P₋ₖ S_kᵀ (d_k − S_k c̄).

Members that are draws of the Gaussian about the mode are told by it. Draws of a Markov chain, and errors that are not
independent, are told by importance weights: leaving reading k out changes the posterior by 1/p(y_k | y_{−k}, θ)^β, so
the members, weighted by it, stand for the posterior without k (Gelfand, Dey & Chang 1992). The largest weights become
quantiles of a generalised Pareto distribution fitted to them, whose shape k̂ tells whether the weighted mean is to be
believed (Vehtari, Simpson, Gelman, Yao & Gabry 2024, J. Mach. Learn. Res. 25, 72; fit: Zhang & Stephens 2009,
Technometrics 51, 316): with N draws where k̂ < min(0.7, 1 − 1/log₁₀ N). Elsewhere the influence is not known
without a fit that lacks the reading.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from en4dvar.model.state import Array, Indices
from en4dvar.priors.prior import Prior

AT_ONCE = 24_000  # draws times readings
FEWEST_IN_TAIL = 5  # weights a Pareto distribution is fitted to
BELIEVED = 0.7  # k̂ below which a weighted mean is believed, of however many draws
SHAPE, COUNT = 0.5, 10  # of a weak prior on k̂: where it lies, and how many draws it is worth
SINGULAR = 1e-6  # share of a reading that is not its own, below which nothing is known without it
FLAT = 30  # values of the profile likelihood, beside √M
WEIGHTED, LINEAR, UNKNOWN = 0, 1, 2  # how a change was found


@dataclass(frozen=True)
class ReadingTangent:
    """The tangent of K readings of independent errors: ``d`` (K, m) and ``S`` (K, m, r) are the whitened rows of each,
    where N members have ``coordinates`` (N, r); ``directions`` (r, n) is what these change in the control vector.
    """

    d: Array
    S: Array
    coordinates: Array
    directions: Array

    def without(self, part: slice) -> Array:
        """Change of the members (K', N, n) if a reading is left out; NaN where nothing is known without it."""
        S, mean = self.S[part], self.coordinates.mean(axis=0)
        around = self.coordinates - mean
        P = around.T @ around / (len(around) - 1)
        gain = S @ P  # (K', m, r)
        left = np.eye(S.shape[1]) - gain @ S.transpose(0, 2, 1)
        known = np.linalg.eigvalsh(left)[:, 0] > SINGULAR
        left[~known] = np.eye(S.shape[1])
        after = P + gain.transpose(0, 2, 1) @ np.linalg.solve(left, gain)
        moved = -np.einsum("krs,kms,km->kr", after, S, self.d[part] - S @ mean)
        try:
            wider = np.linalg.cholesky(after) @ np.linalg.inv(np.linalg.cholesky(P)) - np.eye(len(P))
        except np.linalg.LinAlgError:  # members that do not differ in a direction
            wider = np.full_like(after, math.nan)
        change = moved[:, None] + np.einsum("krs,is->kir", wider, around)
        change[~known] = math.nan
        return np.asarray(change @ self.directions)


@dataclass(frozen=True)
class Influence:
    """Influence of K readings on n parameters: the change of the posterior mean if one reading is left out.

    ``change`` (n, K), physical and SI, NaN where it cannot be told; ``in_std`` (n, K) in posterior standard deviations.
    ``pareto_shape`` (K,) is k̂, NaN without weights; ``how`` (K,) is 0 by importance weights, 1 by the tangent, 2 where
    it is not known without a fit that lacks the reading.
    """

    change: Array
    in_std: Array
    pareto_shape: Array
    how: Indices

    @classmethod
    def by_weights(cls, theta: Array, log_ratios: Array) -> Self:
        """From physical members (N, n), draws of the posterior, and the log (N, K) of 1/p(y_k | y_{−k}, θ)^β."""
        draws, k = log_ratios.shape
        change, shape = np.empty((theta.shape[1], k)), np.empty(k)
        for part in _parts(k, draws):
            log_weights, shape[part] = pareto_smoothed(log_ratios[:, part])
            change[:, part] = theta.T @ np.exp(log_weights) - theta.mean(axis=0)[:, None]
        change[:, ~(shape < believed_shape(draws))] = math.nan
        return cls._of(change, theta, shape, WEIGHTED)

    @classmethod
    def by_tangent(cls, prior: Prior, members: Array, tangent: ReadingTangent) -> Self:
        """From members (N, n), transformed, draws of the Gaussian about the mode."""
        theta, k = prior.to_physical(members), len(tangent.d)
        change = np.empty((theta.shape[1], k))
        for part in _parts(k, len(members)):
            moved = prior.to_physical(members + tangent.without(part)).mean(axis=1)
            change[:, part] = (moved - theta.mean(axis=0)).T
        return cls._of(change, theta, np.full(k, math.nan), LINEAR)

    @classmethod
    def _of(cls, change: Array, theta: Array, shape: Array, how: int) -> Self:
        known = np.isfinite(change).all(axis=0)
        change[:, ~known] = math.nan
        with np.errstate(divide="ignore", invalid="ignore"):
            in_std = change / theta.std(axis=0, ddof=1)[:, None]
        return cls(change, in_std, shape, np.where(known, how, UNKNOWN))


def _parts(k: int, draws: int) -> Iterator[slice]:
    """Some of K readings at a time, so that memory does not grow with them."""
    size = max(1, AT_ONCE // draws)
    return (slice(begin, begin + size) for begin in range(0, k, size))


def believed_shape(draws: int) -> float:
    """k̂ below which a mean weighted over so many draws is to be believed.

    >>> round(believed_shape(48), 3), believed_shape(4000)
    (0.405, 0.7)
    """
    return min(BELIEVED, 1 - 1 / math.log10(max(draws, 2)))


def prior_distance(values: Array, predictions: Array, std: Array) -> Array:
    """How far each reading (K,) lies from the prior's predictions (N, K), in the std of their difference."""
    if len(predictions) < 2:
        return np.full(len(values), math.nan)
    expected, spread = predictions.mean(axis=0), predictions.std(axis=0, ddof=1)
    return np.asarray((values - expected) / np.hypot(spread, std))


def pareto_smoothed(log_ratios: Array) -> tuple[Array, Array]:
    """Log weights (N, K) that sum to one in each column, and the Pareto shapes k̂ (K,), of log ratios (N, K). k̂ is
    +inf where there are too few draws for a tail, −inf where the ratios do not differ.
    """
    draws, k = log_ratios.shape
    x = log_ratios - log_ratios.max(axis=0)
    shape = np.full(k, -math.inf)
    tail = math.ceil(min(draws / 5, 3 * math.sqrt(draws)))
    varies = np.ptp(x, axis=0) > 0
    if tail < FEWEST_IN_TAIL:
        shape[varies] = math.inf
    elif varies.any():
        order = np.argsort(x[:, varies], axis=0, kind="stable")
        ranked = np.take_along_axis(x[:, varies], order, axis=0)
        floor = np.exp(ranked[-tail - 1])
        excess = np.exp(ranked[-tail:]) - floor
        shape[varies], scale = _pareto(excess)
        quantiles = np.log(floor + _quantiles(tail, shape[varies], scale))
        usable = np.isfinite(quantiles).all(axis=0) & (excess[0] > 0)
        ranked[-tail:] = np.where(usable, np.minimum(quantiles, 0.0), ranked[-tail:])
        smooth = np.empty_like(ranked)
        np.put_along_axis(smooth, order, ranked, axis=0)
        x[:, varies] = smooth
    return x - np.log(np.exp(x).sum(axis=0)), shape


def _pareto(excess: Array) -> tuple[Array, Array]:
    """Shape and scale (K,) of generalised Pareto distributions fitted to ascending numbers (M, K)."""
    m = len(excess)
    count = FLAT + math.isqrt(m)
    grid = 1 - np.sqrt(count / (np.arange(1, count + 1) - 0.5))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        b = grid[:, None] / (3 * excess[int(m / 4 + 0.5) - 1]) + 1 / excess[-1]  # (G, K)
        k = np.log1p(-b[:, None] * excess).mean(axis=1)
        profile = m * (np.log(-(b / k)) - k - 1)
        profile = np.where(np.isfinite(profile), profile, -np.inf)
        weights = np.nan_to_num(np.exp(profile - profile.max(axis=0)))
        b = np.sum(weights * np.where(weights > 0, b, 0.0), axis=0) / weights.sum(axis=0)
        k = np.log1p(-b * excess).mean(axis=0)
        scale = -k / b
    shape = (m * k + COUNT * SHAPE) / (m + COUNT)
    return np.where(np.isfinite(shape), shape, math.inf), scale


def _quantiles(m: int, shape: Array, scale: Array) -> Array:
    """(M, K) at the middles of M equal shares."""
    log_above = np.log1p(-(np.arange(m) + 0.5) / m)[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(np.where(np.abs(shape) < 1e-12, -log_above, np.expm1(-shape * log_above) / shape) * scale)
