r"""What each reading does to a posterior, and how far it lies from what the prior expects.

Leaving reading k out changes the posterior by the factor 1/p(y_k | y_{−k}, θ)^β, with independent errors
1/p(y_k | θ)^β, so the members θ_i, weighted by it, stand for the posterior without k (Gelfand, Dey & Chang 1992).
Members that are draws of a Gaussian get the ratio of posterior and Gaussian as a weight before: to divide by p alone
would add the opposite of a nonlinearity that they lack. The largest weights become quantiles of a generalised Pareto
distribution fitted to them, whose shape k̂ tells whether the weighted mean is to be believed (Vehtari, Simpson, Gelman,
Yao & Gabry 2024, J. Mach. Learn. Res. 25, 72; fit: Zhang & Stephens 2009, Technometrics 51, 316): with N draws where
k̂ < min(0.7, 1 − 1/log₁₀ N).

The linear Gaussian posterior knows the answer exactly: with rows S_k, d_k of the whitened arrays that belong to
reading k, members of mean c̄ and covariance P in the coordinates of the tangent become members of

    P₋ₖ = (P⁻¹ − S_kᵀS_k)⁻¹,     c̄ − P₋ₖ S_kᵀ (d_k − S_k c̄).

Weights are corrected by it: to its change is added the difference of the changes by the weights of the model and by
those of its tangent, whose errors of sampling are nearly the same, so that k̂ < 0.7 will do. It stands alone beyond,
where the reading all but decides a parameter. Errors that are not independent have no such rows, and weights alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from en4dvar.prior import Prior
from en4dvar.state import Array

AT_ONCE = 500  # readings
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

    def log_ratios(self, part: slice) -> Array:
        """ln of 1/p(y_k | θ) (N, K') of some readings, up to a constant of each."""
        residual = self.d[part] - np.einsum("kmr,ir->ikm", self.S[part], self.coordinates)
        return 0.5 * np.sum(residual**2, axis=-1)

    def without(self, part: slice) -> Array:
        """What is added to the control vectors (K', N, n) of the members if a reading is left out; NaN where nothing is
        known without it.
        """
        S, mean = self.S[part], self.coordinates.mean(axis=0)
        around = self.coordinates - mean
        P = around.T @ around / (len(around) - 1)
        gain = S @ P  # (K', m, r)
        left = np.eye(S.shape[1]) - gain @ S.transpose(0, 2, 1)
        known = np.linalg.eigvalsh(left)[:, 0] > SINGULAR
        left[~known] = np.eye(S.shape[1])
        after = P + gain.transpose(0, 2, 1) @ np.linalg.solve(left, gain)
        moved = -np.einsum("krs,kms,km->kr", after, S, self.d[part] - S @ mean)
        wider = np.linalg.cholesky(after) @ np.linalg.inv(np.linalg.cholesky(P)) - np.eye(len(P))
        change = moved[:, None] + np.einsum("krs,is->kir", wider, around)
        change[~known] = math.nan
        return np.asarray(change @ self.directions)


@dataclass(frozen=True)
class Influence:
    """Of n parameters and K readings: the change of the posterior mean if one reading is left out.

    ``change`` (n, K), physical and SI, NaN where it cannot be told; ``in_std`` (n, K) in posterior standard deviations.
    ``pareto_shape`` (K,) is k̂; ``how`` (K,) is 0 by importance weights, 1 by linear response, 2 unknown.
    """

    change: Array
    in_std: Array
    pareto_shape: Array
    how: npt.NDArray[np.intp]

    @classmethod
    def of(
        cls, prior: Prior, members: Array, log_weights: Array, log_ratios: Array, tangent: ReadingTangent | None = None
    ) -> Self:
        """From members (N, n), transformed, and the log (N, K) of 1/p(y_k | y_{−k}, θ)^β.

        ``log_weights`` (N,), up to a constant, are those with which the members stand for the posterior.
        """
        draws, k = log_ratios.shape
        theta = prior.to_physical(members)
        change, shape, how = np.empty((theta.shape[1], k)), np.empty(k), np.empty(k, dtype=np.intp)
        for begin in range(0, k, AT_ONCE):
            part = slice(begin, begin + AT_ONCE)
            change[:, part], shape[part] = weighted_change(theta, log_weights, log_ratios[:, part])
            how[part] = np.where(shape[part] < believed_shape(draws), WEIGHTED, UNKNOWN)
            if tangent is not None:
                moved = prior.to_physical(members + tangent.without(part)).mean(axis=1) - theta.mean(axis=0)
                by_tangent, _ = weighted_change(theta, np.zeros(draws), tangent.log_ratios(part))
                weighted = (shape[part] < BELIEVED) & np.isfinite(moved).all(axis=1)
                change[:, part] = np.where(weighted, change[:, part] - by_tangent + moved.T, moved.T)
                how[part] = np.where(weighted, WEIGHTED, LINEAR)
        how[~np.isfinite(change).all(axis=0)] = UNKNOWN
        change[:, how == UNKNOWN] = math.nan
        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(change, change / theta.std(axis=0, ddof=1)[:, None], shape, how)


def weighted_change(theta: Array, log_weights: Array, log_ratios: Array) -> tuple[Array, Array]:
    """Change (n, K) of the weighted mean of draws (N, n) when ratios (N, K) join their weights (N,), and the shapes."""
    before, _ = pareto_smoothed(log_weights[:, None])
    after, shape = pareto_smoothed(log_weights[:, None] + log_ratios)
    return theta.T @ np.exp(after) - theta.T @ np.exp(before), shape


def gaussian_log_weights(members: Array, costs: Array) -> Array:
    """ln of posterior over Gaussian (N,), up to a constant, of draws (N, n) of a Gaussian and their J (N,)."""
    around = members - members.mean(axis=0)
    P = around.T @ around / (len(members) - 1)
    return np.asarray(0.5 * np.einsum("ij,ji->i", around, np.linalg.solve(P, around.T)) - costs)


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
    """Log weights (N, K) that sum to one in each column, and the Pareto shapes k̂ (K,), of log ratios (N, K).

    k̂ is +inf where there are too few draws for a tail, −inf where the ratios do not differ.
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
