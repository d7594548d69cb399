"""Bootstrap particle filter: the members are weighed by their likelihoods, resampled, and jittered.

    ω_i ∝ exp(−½ ‖d_i‖²),   d_i = d − S_i the whitened innovation of member i.

No Gaussian is assumed and nothing is linear; the price is a number of members that grows exponentially with that of the
observations. Systematic resampling makes N equal members of them at every cycle. Copies would stay copies where the
model is deterministic, so that each is moved, the more of them are copies: by h = ``jitter`` √(1 − N_e/N), with
N_e = 1/Σ ω_i², towards the mean, by √(1 − h²), and by a draw from the kernel N(0, h² P), P the covariance of the
weighted members, without the mean of the draws. Mean and covariance stay; many weak readings do not merge two modes.

Sources: Gordon, Salmond & Smith (1993), IEE Proc. F 140, 107; jitter: Musso, Oudjane & Le Gland (2001) and, with the
shrinkage, Liu & West (2001), in Doucet et al., Sequential Monte Carlo Methods in Practice, ch. 12 and 10.
"""

import math
from dataclasses import dataclass
from typing import Annotated, cast

import numpy as np
from annotated_types import Ge, Le
from scipy.special import ndtr

from en4dvar.ensemble.linalg import centre, shares_of, systematic
from en4dvar.model.state import Array, Indices
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Step, Weights
from en4dvar.schemes.filters import ETKF


@dataclass(frozen=True)
class BootstrapFilter(ETKF):
    """The filter; it takes no localisation."""

    words = "weighed and resampled members"

    jitter: Annotated[
        float, Ge(0), Le(1), "What a resampled member is moved by at most, in standard deviations of the posterior."
    ] = 0.2

    on = ("series",)
    resamples = True

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Resampled members as rows of weights: a member is x̄ + X_a(i), one that has survived."""
        n = len(weights.w)
        shares = likelihood_shares(evaluation)
        start = float(ndtr(draw("resampling", 1)[0, 0]))
        index = systematic(shares, n, start)
        w = np.bincount(index, minlength=n) / n
        effective = 1 / float(shares @ shares)
        jitter = self.jitter * math.sqrt(max(1 - effective / n, 0.0))  # as much as members have become copies
        transform = cast(Array, Resampled(index, w, shares, jitter, draw))
        return Step(Weights(w, transform), math.sqrt(n - 1) * float(np.linalg.norm(w)), effective)


@dataclass(frozen=True)
class Resampled:
    """The transform that takes the members of these ``index`` (N,), about their mean of weights ``w`` (N,), and moves
    them by draws of the covariance that ``shares`` (N,) give, ``jitter`` times its root, as much nearer to the mean.
    """

    index: Indices
    w: Array
    shares: Array
    jitter: float
    draw: Draw

    def __matmul__(self, anomalies: Array) -> Array:
        moved = anomalies[self.index] - self.w @ anomalies
        if not self.jitter:
            return np.asarray(moved)
        spread = np.sqrt(self.shares)[:, None] * (anomalies - self.shares @ anomalies)
        root = np.linalg.qr(spread, mode="r")
        draws = self.jitter * centre(self.draw("jitter", len(root)))[1] @ root
        return np.asarray(math.sqrt(1 - self.jitter**2) * moved + draws)

    @property
    def dense(self) -> Array:
        """As a matrix (N, N), without the jitter, which earlier states have no part in."""
        return np.asarray(np.eye(len(self.w))[self.index] - self.w)


def likelihood_shares(evaluation: Evaluation) -> Array:
    """Likelihoods (N,) of the members, of sum 1, relative to the largest, so that one is left however far all are."""
    return shares_of(-0.5 * np.sum((evaluation.d[:, None] - evaluation.S) ** 2, axis=0))
