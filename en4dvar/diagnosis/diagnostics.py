"""Diagnostics of an analysis: pure functions of arrays, and the plain words that go with them."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from en4dvar.data.observations import Observations
from en4dvar.model.state import Array, Mask

TAIL = 0.0005  # each tail of the central 99.9 % interval
MEAN_OFF, SPREAD_OFF = 0.5, 0.3  # in posterior standard deviations, as a fraction: beyond, a posterior is non-Gaussian
ENDS_OFF = 0.5  # the same of 5 and 95 % points, in posterior standard deviations
SURE = 2.0  # standard errors of weighted moments beyond what leaves a doubt, from which it is warned of
EMULATED_ENOUGH = 0.2  # effective share of its runs below which an emulator is not believed
GAUSSIAN_ENOUGH = 0.35  # the same of the members: the criterion where there is no emulator to believe
DECISIVE = 20.0  # ratio of two evidences from which on the data are said to speak for one of the models
UNSEEN = 0.1  # posterior standard deviations: a step that is within what so few members tell of the posterior
SHORT_STEP = 0.5  # the same: the end of a step that is longer is no minimum
HARDLY_INFORMED = 0.1  # DFS of a parameter below which its posterior is said to be its prior
METHOD: Literal["normal_unbiased"] = "normal_unbiased"


def background_cost(w: Array, n_members: int | None = None) -> Array:
    """J_b = (N−1)/2 ‖w‖² of weights (…, N), or of their coordinates (…, r) in an orthonormal basis."""
    return np.asarray(0.5 * ((n_members or w.shape[-1]) - 1) * np.add.reduce(w * w, axis=-1))


def dfs(singular_values: Array, n_members: int) -> float:
    """Degrees of freedom for signal: the trace of the influence matrix, Σ σ²/(N−1+σ²), σ the singular values of S."""
    squares = singular_values * singular_values
    return float(np.add.reduce(squares / (n_members - 1 + squares)))


def dfs_per_parameter(prior_variance: Array, posterior: Array) -> Array:
    """1 − posterior variance / prior variance (n,), of ensembles, (N, n) the posterior, in transformed space."""
    return np.asarray(1 - posterior.var(axis=0) / prior_variance)


def spread(members: Array, prior_variance: Array) -> Array:
    """Root mean over the parameters of ensemble variance / prior variance (…,); (…, N, n) and (n,), transformed."""
    n_members, n = members.shape[-2:]
    anomalies = members - np.add.reduce(members, axis=-2, keepdims=True) / n_members
    variance = np.einsum("...ij,...ij->...j", anomalies, anomalies) / n_members
    return np.asarray(np.sqrt(np.add.reduce(variance / prior_variance, axis=-1) / n))


def nrmse(values: Array, predictions: Array) -> float:
    """Normalised fit 1 − ‖y − ŷ‖/‖y − ȳ‖ of the rheometry literature: 1 is perfect, 0 is no better than the mean."""
    spread = np.linalg.norm(values - np.mean(values))
    return float(1 - np.linalg.norm(values - predictions) / spread) if spread > 0 else float("nan")


def log_evidence(cost: float, singular_values: Array, n_members: int, observations: Observations) -> float:
    """Laplace approximation of ln p(y): −J_min − ½ ln det(A/(N−1)) − Σ β_k ln(std_k √2π) (− ½ ln det C).

    Exact for linear F and H. ``cost`` is J at its minimum, ``singular_values`` are those of S there. With β ≠ 1 it is
    the evidence of the tempered likelihood. Source: MacKay (2003), Information Theory, Inference and Learning
    Algorithms, chapter 28.
    """
    log_det = float(np.sum(np.log1p(singular_values**2 / (n_members - 1))))
    return float(-cost - 0.5 * log_det - observations.log_normalisation())


def change_words(names: str, log_factor: float) -> str:
    """The verdict of the evidence on parameters that vary, in words: ``log_factor`` is ln p(y | they vary) − ln p(y |
    constant).

    Where they are constant, a Bayes factor of :data:`DECISIVE` or more comes up in at most one set of data in as many.
    """
    if math.isnan(log_factor):
        return f"the evidence for a change of {names} is not known: no fit with constant values could be made"
    against = f"(log evidence {log_factor:+.1f} against constant values)"
    if log_factor > math.log(DECISIVE):
        return f"{names}: the data speak for a change {against}"
    if log_factor < -math.log(DECISIVE):
        return f"{names}: the data speak for constant values {against}"
    return f"{names}: the data do not tell whether there is a change {against}"


@lru_cache(maxsize=256)  # every start and every examination asks for the same few
def chi2_interval(degrees: float, tail: float = TAIL) -> tuple[float, float]:
    """Interval of χ² with ``degrees`` degrees of freedom (need not be whole), the probability ``tail`` to each side."""
    from scipy.special import gammaincinv  # scipy is not needed to import the package

    return float(2 * gammaincinv(degrees / 2, tail)), float(2 * gammaincinv(degrees / 2, 1 - tail))


def effective_share(log_weights: Array) -> float:
    """Effective sample size of importance weights relative to their number: 1 where all are equal.

    ``log_weights`` (B,) up to a constant, −inf for none. The √B largest are cut to the smallest of them (Ionides 2008,
    J. Comput. Graph. Stat. 17, 295), which keeps one draw in a tail from deciding.
    """
    cap = np.sort(log_weights)[-max(3, math.isqrt(len(log_weights)))]
    weights = np.exp(np.minimum(log_weights, cap) - cap)
    return float(weights.sum() ** 2 / np.sum(weights**2) / len(weights))


def gaussianity(members: Array, centre: Array, costs: Array) -> float:
    """How well the posterior ensemble, as a Gaussian, agrees with the posterior at its own members.

    ``members`` (N, n) and the ``centre`` (n,) of their Gaussian, transformed; ``costs`` J (N,) of the members. With log
    weights ½ z² − J, z the distance in the ensemble's covariance, the :func:`effective_share` of the weights is 1 for a
    Gaussian posterior. NaN with fewer members alive than n + 2.
    """
    alive = np.isfinite(costs)
    anomalies = members - centre
    if int(alive.sum()) < members.shape[1] + 2:
        return math.nan
    about_mean = members - np.add.reduce(members, axis=0) / len(members)
    scale = np.maximum(about_mean.std(axis=0, ddof=1), np.finfo(float).tiny)  # units differ by many powers of ten
    about_mean, anomalies = about_mean / scale, anomalies / scale
    correlation = about_mean.T @ about_mean / (len(members) - 1)
    squares = np.einsum("ij,ji->i", anomalies, np.linalg.pinv(correlation, hermitian=True) @ anomalies.T)
    return effective_share(np.where(alive, 0.5 * squares - costs, -np.inf))


def off(ensemble: Array, mean: Array, std: Array) -> tuple[float, float]:
    """How far members (N, n) are from this mean and standard deviation (n,): the largest distance of their mean in
    standard deviations, and the ratio of theirs to these where it is farthest from 1.
    """
    ratio = np.maximum(ensemble.std(axis=0, ddof=1) / std, np.finfo(float).tiny)  # of members that are all the same
    shift = np.max(np.abs(ensemble.mean(axis=0) - mean) / std)
    return float(shift), float(ratio[np.argmax(np.abs(np.log(ratio)))])


def is_non_gaussian(shape: Mapping[str, float], doubted: bool = False) -> bool:
    """True if mean or spread of the ensemble are not the posterior's, from
    :func:`~en4dvar.sampling.refine.examine_shape` and :func:`~en4dvar.sampling.refine.examine_tails`. ``doubted``: a
    parameter is the scale of others, so that no posterior is Gaussian, or an approximate scheme agrees little with J;
    an emulator may say that it is.
    """
    if shape.get("emulator_fit", 0.0) >= EMULATED_ENOUGH:
        return shape["mean_shift"] > MEAN_OFF or abs(shape["spread_ratio"] - 1) > SPREAD_OFF
    tails = any(key.startswith(("tail_mean", "tail_q")) for key in shape)
    return doubted or shape.get("gaussian_fit", 1.0) < GAUSSIAN_ENOUGH or tails


def active_members(failures: Sequence[str]) -> Mask:
    """(N,) True where no reason of failure is given."""
    return np.array([reason == "" for reason in failures], dtype=bool)


def common_reasons(failures: Sequence[str], most: int = 3) -> str:
    counts = Counter(reason for reason in failures if reason)
    return "; ".join(f"{reason} ({count}×)" for reason, count in counts.most_common(most))


def member_quantiles(values: Array, levels: Sequence[float], axis: int | None = None) -> Any:
    """Quantiles (L, …) of what the members along ``axis`` are draws of; NaN is no member.

    The p-quantile lies at the place p (N + 1/4) + 3/8 among N members in order, where a Gaussian's is on average (Blom
    1958, *Statistical Estimates and Transformed Beta-Variables*). Interpolation between the smallest and the largest,
    numpy's default, made 90 % intervals of 48 members that hold 86 to 88 % of truths (``en4dvar calibrate``).
    """
    if np.isnan(values).any():  # one instant after the other
        return np.nanquantile(values, levels, axis=axis, method=METHOD)
    return np.quantile(values, levels, axis=axis, method=METHOD)
