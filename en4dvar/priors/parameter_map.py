r"""Parameter maps of priors that are no transformed Gaussians: θ = F⁻¹(Φ(x)) of a Gaussian score x ~ N(0, 1).

    uniform      θ on (a, b)
    half-normal  θ = a + |N(0, s²)|
    beta         (θ − a)/(b − a) ~ Beta(α, β)
    bounded-normal, bounded-lognormal   θ or ln θ ~ N(m, s²), cut off at a and b, with m between them

The map is smooth, increasing and exact, so that the prior density of θ is the one named, while everything that works in
the control coordinate sees a Gaussian. Both tails are taken from their own side, so that θ keeps its distance to the
nearer bound to full relative precision. Where x says too little (below −38, Φ is no number) θ is the bound.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import betainc, betaincinv, betaln, erf, erfinv, log_ndtr, ndtr, ndtri, ndtri_exp

from en4dvar.model.state import Array

Numbers = tuple[float, ...]
Bounds = tuple[float, float]
NEAR = 1e-5  # of a std from a bound: there the second order of a cut Gaussian is exact to 1e-10
LOG_ROOT_2PI = 0.5 * math.log(2 * math.pi)


class QuantileMap(NamedTuple):
    """A distribution of the share u = (θ − a)/scale, whose scale is b − a, or the std s where there is no b.

    ``below`` gives u from x < 0, ``above`` from x ≥ 0 what is left to the upper bound, 1 − u, or u itself where
    there is none, which ``upper`` says; ``score`` x from u and 1 − u; ``log_density`` ln of the density of u, from the
    same two.
    """

    below: Callable[[Array, Numbers], Array]
    above: Callable[[Array, Numbers], Array]
    score: Callable[[Array, Array, Numbers], Array]
    log_density: Callable[[float, float, Numbers], float]
    upper: bool = True


def _half_normal_score(u: Array, _: Array, shape: Numbers) -> Array:
    """From 2Φ(u) − 1 where that is small, else from 2Φ(−u)."""
    low, high = ndtri(erf(u / math.sqrt(2))), -ndtri_exp(np.minimum(log_ndtr(-u) + math.log(2), 0.0))
    return np.asarray(np.where(u < 0.5, low, high))


def _beta_log_density(u: float, rest: float, shape: Numbers) -> float:
    a, b = shape
    return (a - 1) * math.log(u) + (b - 1) * math.log(rest) - float(betaln(a, b))


def _cut_share(x: Array, low: float, high: float) -> Array:
    """Share w of the way from α = ``low`` to β = ``high`` of z ~ N(0, 1) between them, from its score x < 0."""
    p = ndtr(x) * (ndtr(high) - ndtr(low))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = p * math.sqrt(2 * math.pi) * np.exp(0.5 * low * low)
        # Φ(α + d) − Φ(α) = p to second order, where the difference of two Φ has no digits
        near = t * (1 + 0.5 * low * t)
    return np.asarray(np.where(t * max(1.0, abs(low)) < NEAR, near, ndtri(ndtr(low) + p) - low) / (high - low))


def _cut_probability(w: Array, low: float, high: float) -> Array:
    """What :func:`_cut_share` inverts, as a probability Φ(x)."""
    d = (high - low) * w
    near = np.exp(-0.5 * low * low - LOG_ROOT_2PI) * d * (1 - 0.5 * low * d)
    p = np.where(d * max(1.0, abs(low)) < NEAR, near, ndtr(low + d) - ndtr(low))
    return np.asarray(p / (ndtr(high) - ndtr(low)))


def _cut_score(w: Array, rest: Array, shape: Numbers) -> Array:
    low, high = shape[:2]
    below, above = _cut_probability(w, low, high), _cut_probability(rest, -high, -low)
    return np.asarray(np.where(below < 0.5, ndtri(below), -ndtri(above)))


def _cut_log_density(w: float, shape: Numbers) -> float:
    low, high = shape[:2]
    z = low + (high - low) * w
    return -LOG_ROOT_2PI - 0.5 * z * z + math.log((high - low) / (ndtr(high) - ndtr(low)))


def _share_of_log(u: Array, rest: Array, shape: Numbers) -> tuple[Array, Array]:
    """Shares of the way from ln a to ln b, from those from a to b; ``shape`` is (α, β, ln b/a)."""
    span = shape[2]
    return np.log1p(u * math.expm1(span)) / span, -np.log1p(rest * math.expm1(-span)) / span


def _log_cut_log_density(u: float, rest: float, shape: Numbers) -> float:
    w, span = float(_share_of_log(np.array(u), np.array(rest), shape)[0]), shape[2]
    return _cut_log_density(w, shape) - math.log(span / math.expm1(span)) - span * w


QUANTILE_MAPS: Mapping[str, QuantileMap] = {
    "uniform": QuantileMap(
        below=lambda x, shape: ndtr(x),
        above=lambda x, shape: ndtr(-x),
        score=lambda u, rest, shape: np.where(u < 0.5, ndtri(u), -ndtri(rest)),
        log_density=lambda u, rest, shape: 0.0,
    ),
    "half-normal": QuantileMap(
        below=lambda x, shape: math.sqrt(2) * erfinv(ndtr(x)),
        above=lambda x, shape: -ndtri_exp(log_ndtr(-x) - math.log(2)),
        score=_half_normal_score,
        log_density=lambda u, rest, shape: math.log(2) - LOG_ROOT_2PI - 0.5 * u * u,
        upper=False,
    ),
    "beta": QuantileMap(
        below=lambda x, shape: betaincinv(*shape, ndtr(x)),
        above=lambda x, shape: betaincinv(*shape[::-1], ndtr(-x)),
        score=lambda u, rest, shape: np.where(
            betainc(*shape, u) < 0.5, ndtri(betainc(*shape, u)), -ndtri(betainc(*shape[::-1], rest))
        ),
        log_density=_beta_log_density,
    ),
    "bounded-normal": QuantileMap(
        below=lambda x, shape: _cut_share(x, *shape),
        above=lambda x, shape: _cut_share(-x, -shape[1], -shape[0]),
        score=_cut_score,
        log_density=lambda u, rest, shape: _cut_log_density(u, shape),
    ),
    "bounded-lognormal": QuantileMap(
        below=lambda x, shape: np.expm1(shape[2] * _cut_share(x, *shape[:2])) / math.expm1(shape[2]),
        above=lambda x, shape: np.expm1(-shape[2] * _cut_share(-x, -shape[1], -shape[0])) / math.expm1(-shape[2]),
        score=lambda u, rest, shape: _cut_score(*_share_of_log(u, rest, shape), shape),
        log_density=_log_cut_log_density,
    ),
}


def value(kind: str, x: Array, bounds: Bounds, shape: Numbers) -> Array:
    """θ of scores ``x`` of any shape; ``shape`` is (s,) of a half-normal, (α, β) of a beta, () of a uniform,
    (α, β) of a bounded normal, the bounds in std from m, and (α, β, ln b/a) of a bounded lognormal.
    """
    quantiles, (low, high) = QUANTILE_MAPS[kind], bounds
    scale = _scale(bounds, shape)
    below = low + scale * quantiles.below(np.minimum(x, 0.0), shape)
    above = scale * quantiles.above(np.maximum(x, 0.0), shape)
    return np.asarray(np.where(x < 0, below, low + above if math.isinf(high) else high - above))


def score(kind: str, theta: Array, bounds: Bounds, shape: Numbers) -> Array:
    """x of values strictly inside of the bounds."""
    (low, high), scale = bounds, _scale(bounds, shape)
    rest = np.zeros_like(theta) if math.isinf(high) else (high - theta) / scale
    return np.asarray(QUANTILE_MAPS[kind].score((theta - low) / scale, rest, shape))


def slope(kind: str, x: float, bounds: Bounds, shape: Numbers) -> float:
    """dθ/dx = φ(x)/f(θ), also where θ is rounded to a bound."""
    quantiles, from_low = QUANTILE_MAPS[kind], x < 0 or math.isinf(bounds[1])
    near = max(float((quantiles.below if x < 0 else quantiles.above)(np.array(x), shape)), np.finfo(float).tiny)
    u, rest = (near, 1 - near) if from_low else (1 - near, near)
    return _scale(bounds, shape) * math.exp(-LOG_ROOT_2PI - 0.5 * x * x - quantiles.log_density(u, rest, shape))


def _scale(bounds: Bounds, shape: Numbers) -> float:
    low, high = bounds
    return shape[0] if math.isinf(high) else high - low
