"""Filters: the ensemble is analysed once, where it stands; nothing is iterated and no state is smoothed.

With whitened anomalies S and innovation d of the forecast, A = (N−1) I + SᵀS, each says how the weights w of the mean
and the transform T of the anomalies follow. The last two are baselines: what a filter must beat to have earned its
cost. Their members run freely, as if nothing was observed (``cycled`` is false); once they have forgotten how they
started, they are a sample of the model's climatology (as baselines: Raanes 2016, thesis, Oxford).
"""

import math
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np

from en4dvar.ensemble.linalg import Hessian, LowRank
from en4dvar.model.state import Array
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Scheme, Step, Weights, gauss_newton


@dataclass(frozen=True)
class ETKF(Scheme):
    """The ensemble transform Kalman filter, deterministic, with the symmetric square root: one Gauss–Newton step.

        w = A⁻¹ Sᵀ d,   T = √(N−1) A^{-1/2}

    Filters with another analysis say so in :meth:`advance`. Sources: Bishop, Etherton & Majumdar (2001), Mon. Wea. Rev.
    129, 420; symmetric root: Hunt, Kostelich & Szunyogh (2007), Physica D 230, 112.
    """

    words = "symmetric square root"
    on: ClassVar[tuple[str, ...]] = ("window", "series")
    filters = True


@dataclass(frozen=True)
class DEnKF(ETKF):
    """The deterministic ensemble Kalman filter, whose anomalies move by half of the Kalman gain K of the mean.

        w = A⁻¹ Sᵀ d,   T = I − ½ A⁻¹ SᵀS

    That is the square root to first order in KH and otherwise keeps more spread, as some inflation would. Source: Sakov
    & Oke (2008), Tellus A 60, 361.
    """

    words = "deterministic"
    approximate = "moves anomalies by half of the gain, which leaves them wider than the posterior"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        step = gauss_newton(weights.w, evaluation)
        # A⁻¹ SᵀS = I − (N−1) A⁻¹ = I − T²
        transform = 0.5 * (np.eye(len(weights.w)) + step.transform @ step.transform)
        return Step(Weights(step.w + step.direction, transform), step.norm)


@dataclass(frozen=True)
class EnKF(ETKF):
    """The stochastic ensemble Kalman filter, every member analysed with its own perturbed observations.

        δ_i = A⁻¹ Sᵀ (d_i + z_i),   z_i ~ N(0, I)

    along the anomalies, d_i the whitened innovation of member i. The z_i are centred, so that the mean moves by the
    Kalman gain without sampling noise. Divided by N−1 their sample covariance then has the mean I, and that of the
    members after the analysis the mean (N−1) A⁻¹ along the anomalies, as it is of the ETKF: no scale is needed.

    Sources: Burgers, van Leeuwen & Evensen (1998), Mon. Wea. Rev. 126, 1719; Evensen (2003), Ocean Dynamics 53, 343.
    """

    words = "perturbed observations"
    perturbs = True

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        hessian = Hessian.of(evaluation.S)
        shift = hessian.solve(evaluation.d @ evaluation.S)
        transform = perturbed_transform(hessian, evaluation.S, draw("perturbed observations"))  # T = I before
        return Step(Weights(weights.w + shift, cast(Array, transform)), hessian.norm(shift))


def perturbed_transform(hessian: Hessian, S: Array, noise: Array) -> Array | LowRank:
    """By what T (N, N) is multiplied in an update with whitened anomalies S (K', N) per row of T and perturbations
    ``noise`` (N, K').
    """
    # anomalies of the members' innovations: −S_i of the predictions and the perturbations
    innovations = noise - noise.mean(axis=0) - S.T
    if len(S) < S.shape[1]:  # the cheaper order of the same product
        return LowRank(innovations, hessian.solve(S))
    return np.asarray(np.eye(S.shape[1]) + hessian.solve(innovations @ S))


@dataclass(frozen=True)
class ESRF(ETKF):
    """The serial ensemble square-root filter: whitened observations are independent, and come one after the other.

    Each is a scalar update of what the earlier ones left. With the anomalies of its prediction v = T s, s the row of S,
    and D = N − 1 + vᵀv,

        w ← w + Tᵀ v (d − sᵀw) / D,   T ← T − v vᵀT / (D + √((N−1) D)).

    No matrix is decomposed. Mean and covariance are those of one analysis with all observations; the members differ
    from those of the symmetric root by a rotation. Source: Whitaker & Hamill (2002), Mon. Wea. Rev. 130, 1913, eqs.
    10–13.
    """

    words = "serial square root"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        w, transform, prior_precision = weights.w.copy(), weights.T.copy(), len(weights.w) - 1.0
        for d, s in zip(evaluation.d, evaluation.S, strict=True):
            v = transform @ s
            total = prior_precision + float(v @ v)
            gain = v @ transform / total
            w += gain * (d - float(s @ w))
            transform -= np.outer(v, gain / (1 + math.sqrt(prior_precision / total)))
        moved, seen = w - weights.w, evaluation.S @ (w - weights.w)
        return Step(Weights(w, transform), math.sqrt(prior_precision * float(moved @ moved) + float(seen @ seen)))


@dataclass(frozen=True)
class OptimalInterpolation(ETKF):
    """A baseline: one analysis of each observation vector with the mean of the free members as its prior.

    The covariance is the climatological one, of the free members and averaged over the times so far, unless the
    analysis is local. Anomalies are those of the free members, changed as a square-root filter with this covariance
    does (Whitaker & Hamill 2002, eq. 10). Source: Gandin (1963), Objective Analysis of Meteorological Fields.
    """

    words = "one analysis of the free members"
    on = ("series",)
    cycled = False
    climatological = True


@dataclass(frozen=True)
class Climatology(OptimalInterpolation):
    """A baseline: mean and spread of the free members; observations are not used."""

    words = "the free members"
    climatological = False

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        return Step(weights, 0.0)
