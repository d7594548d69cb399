"""Filters: a window without length, analysed once; nothing is iterated and no state is smoothed. They differ from the
ETKF in their analysis alone; the baselines of a series, which a filter must beat to have earned its cost, in what is
done with it; and ES-MDA in that it analyses the same observations several times.
"""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, cast

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Gt, MinLen
from scipy.special import ndtr

from en4dvar.ensemble.linalg import Hessian, LowRank, centre
from en4dvar.model.state import Array
from en4dvar.schemes.base import Draw, Evaluation, GaussNewtonStep, Scheme, Step, Weights, gauss_newton, mda_inflations


@dataclass(frozen=True)
class ETKF(Scheme):
    """The ensemble transform Kalman filter, deterministic, with the symmetric square root.

    One Gauss–Newton step from the prior at the time of the observations,

        w = A⁻¹ Sᵀ d,   T = √(N−1) A^{-1/2},   A = (N−1) I + SᵀS.

    Filters with another analysis say so in :meth:`advance`. Sources: Bishop, Etherton & Majumdar (2001), Mon. Wea. Rev.
    129, 420; symmetric root: Hunt, Kostelich & Szunyogh (2007), Physica D 230, 112.
    """

    words: ClassVar[str] = "symmetric square root"
    on: ClassVar[tuple[str, ...]] = ("window", "series")
    filters: ClassVar[bool] = True


@dataclass(frozen=True)
class DEnKF(ETKF):
    """The deterministic ensemble Kalman filter.

    The mean moves by the Kalman gain K, the anomalies by half of it, which is the square root to first order in KH and
    otherwise keeps more spread, as some inflation would:

        w = A⁻¹ Sᵀ d,   T = I − ½ A⁻¹ SᵀS,   A = (N−1) I + SᵀS.

    Source: Sakov & Oke (2008), Tellus A 60, 361.
    """

    words: ClassVar[str] = "deterministic"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Weights of the analysis."""
        step = gauss_newton(weights.w, evaluation)
        # A⁻¹ SᵀS = I − (N−1) A⁻¹ = I − T²
        transform = 0.5 * (np.eye(len(weights.w)) + step.transform @ step.transform)
        return Step(Weights(step.w + step.direction, transform), step.norm)


@dataclass(frozen=True)
class ESRF(ETKF):
    """The deterministic ensemble square-root filter, serial: one observation after the other.

    Whitened observations are independent, so that each is a scalar update of what the earlier ones left. With the
    anomalies of its prediction v = T s, s the row of S, and D = N − 1 + vᵀv,

        w ← w + Tᵀ v (d − sᵀw) / D,   T ← T − v vᵀT / (D + √((N−1) D)).

    No matrix is decomposed. Mean and covariance are those of one analysis with all observations; the members differ
    from those of the symmetric root by a rotation. Source: Whitaker & Hamill (2002), Mon. Wea. Rev. 130, 1913, eqs.
    10–13.
    """

    words: ClassVar[str] = "serial square root"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Weights of the analysis."""
        w, transform, prior_precision = weights.w.copy(), weights.T.copy(), len(weights.w) - 1.0
        for d, s in zip(evaluation.d, evaluation.S, strict=True):
            v = transform @ s
            total = prior_precision + float(v @ v)
            gain = v @ transform / total
            w += gain * (d - float(s @ w))
            transform -= np.outer(v, gain / (1 + math.sqrt(prior_precision / total)))
        moved, seen = w - weights.w, evaluation.S @ (w - weights.w)
        return Step(Weights(w, transform), math.sqrt(prior_precision * float(moved @ moved) + float(seen @ seen)))


def perturbed_transform(hessian: Hessian, S: Array, noise: Array, T: Array) -> Array:
    """T (N, N) after an update with whitened anomalies S (K', N) per row of T and perturbations ``noise`` (N, K')."""
    # anomalies of the members' innovations: −S_i of the predictions and the perturbations
    innovations = noise - noise.mean(axis=0) - S.T
    if len(S) < S.shape[1]:  # the cheaper order of the same product
        return np.asarray(T + innovations @ (hessian.solve(S) @ T))
    return np.asarray(T + hessian.solve(innovations @ S) @ T)


@dataclass(frozen=True)
class EnKF(ETKF):
    """The stochastic ensemble Kalman filter, every member analysed with its own perturbed observations.

        δ_i = A⁻¹ Sᵀ (d_i + z_i),   A = (N−1) I + SᵀS,   z_i ~ N(0, I)

    along the anomalies, d_i the whitened innovation of member i. The z_i are centred, so that the mean moves by the
    Kalman gain without sampling noise, and scaled by √(N/(N−1)), so that their sample covariance has no bias. Sources:
    Burgers, van Leeuwen & Evensen (1998), Mon. Wea. Rev. 126, 1719; Evensen (2003), Ocean Dynamics 53, 343.
    """

    words: ClassVar[str] = "perturbed observations"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Weights of the analysis."""
        hessian, n = Hessian.of(evaluation.S), len(weights.w)
        shift = hessian.solve(evaluation.d @ evaluation.S)
        noise = math.sqrt(n / (n - 1)) * draw("perturbed observations")
        if len(evaluation.S) < n:
            innovations = noise - noise.mean(axis=0) - evaluation.S.T
            transform = cast(Array, LowRank(innovations, hessian.solve(evaluation.S)))  # T = I before
        else:
            transform = perturbed_transform(hessian, evaluation.S, noise, weights.T)
        return Step(Weights(weights.w + shift, transform), hessian.norm(shift))


@dataclass(frozen=True)
class EnKFN(ETKF):
    r"""The finite-size ensemble Kalman filter, which finds the inflation that sampling errors call for: it needs no
    other where the model is right.

    Mean and covariance of the forecast are known only from N members. Integrated over what they may be, the prior is a
    Student's t in weight space,

        J(w) = ½ ‖d − Sw‖² + ½ (N+1) ln(ε_N + ‖w‖²),   ε_N = 1 + 1/N,

    whose minimum is that of ½ ‖d − Sw‖² + ½ ζ ‖w‖² with the precision ζ that minimises the dual cost

        D(ζ) = ½ dᵀ (I + SSᵀ/ζ)⁻¹ d + ½ ε_N ζ + ½ (N+1) ln((N+1)/ζ) − ½ (N+1),   0 < ζ ≤ (N+1)/ε_N.

    The transform is a root of (N−1) H⁻¹ with the Hessian of J at its minimum, H = SᵀS + ζ I − 2 ζ²/(N+1) w wᵀ.

    Sources: Bocquet (2011), Nonlin. Processes Geophys. 18, 735; dual: Bocquet & Sakov (2012), Nonlin. Processes
    Geophys. 19, 383, § 3; Bocquet, Raanes & Hannart (2015), Nonlin. Processes Geophys. 22, 645.
    """

    words: ClassVar[str] = "finite size"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Weights of the analysis."""
        n_members = len(weights.w)
        hessian = Hessian.of(evaluation.S)  # its rows are orthogonal, of lengths σ: SᵀS = rowsᵀ rows
        squares = hessian.singular_values**2
        slope = evaluation.d @ evaluation.S
        # of dᵀd only the part that S can explain, (rows Sᵀd)² / σ⁴ in each direction, depends on ζ
        informed = squares > np.finfo(float).eps * max(1.0, float(squares.max(initial=0.0)))
        projected = np.zeros_like(squares)
        projected[informed] = (hessian.rows[informed] @ slope) ** 2 / squares[informed] ** 2
        zeta = finite_size_precision(projected, squares, n_members)
        w = hessian.solve(slope, damping=zeta / hessian.prior_precision - 1)
        seen = hessian.rows @ w
        length = float(seen @ seen) + zeta * float(w @ w) - 2 * zeta**2 / (n_members + 1) * float(w @ w) ** 2
        return Step(Weights(w, finite_size_transform(hessian, zeta, w)), math.sqrt(max(0.0, length)))


def finite_size_transform(hessian: Hessian, zeta: float, w: Array) -> Array:
    """T = √(N−1) (I + b z zᵀ) G^{-1/2}, a root of (N−1) H⁻¹, with G = SᵀS + ζ I and z = G^{-1/2} w.

    H = G^{1/2} (I − c z zᵀ) G^{1/2}, c = 2 ζ²/(N+1), takes one decomposition. 1ᵀT ∝ 1ᵀ, as z ⟂ 1.
    """
    root = np.sqrt(hessian.singular_values**2 + zeta)
    shrink = 1 / (math.sqrt(zeta) * root * (math.sqrt(zeta) + root))  # (1/√ζ − 1/root) / σ²
    inverse_root = np.eye(len(w)) / math.sqrt(zeta) - (hessian.rows.T * shrink) @ hessian.rows
    z = inverse_root @ w
    square = float(z @ z)
    c = 2 * zeta**2 / (len(w) + 1)
    kept = math.sqrt(max(1 - c * square, np.finfo(float).eps))  # positive at a minimum but for rounding
    stretch = c / (kept * (1 + kept))  # (1/kept − 1) / |z|²
    scaled = inverse_root + np.outer(stretch * z, z @ inverse_root)
    return np.asarray(math.sqrt(hessian.prior_precision) * scaled)


def finite_size_precision(projected: Array, squares: Array, n_members: int) -> float:
    """The minimiser ζ of the dual cost, a zero of its slope 2 dD/d ln ζ.

    ``projected`` (m,) are the squares of d along the left singular vectors of S, ``squares`` (m,) those of its singular
    values.
    """
    from scipy.optimize import brentq

    epsilon = 1 + 1 / n_members

    def slope(log_zeta: float) -> float:
        zeta = math.exp(log_zeta)
        return float(projected @ (zeta * squares / (zeta + squares) ** 2)) + epsilon * zeta - (n_members + 1)

    largest = math.log((n_members + 1) / epsilon)
    smallest = largest - 12
    if slope(smallest) >= 0:
        return math.exp(smallest)
    return math.exp(float(brentq(slope, smallest, largest + 1e-9, xtol=1e-12)))


@dataclass(frozen=True)
class OptimalInterpolation(ETKF):
    """The ETKF's analysis, which is not cycled: one analysis of each observation vector with the free members as its
    prior; the next one starts from them again. With many members its gain is that of the climatological covariance.

    Sources: Gandin (1963), Objective Analysis of Meteorological Fields; as baselines: Raanes (2016), thesis, Oxford.
    """

    words: ClassVar[str] = "one analysis of the free members"
    on: ClassVar[tuple[str, ...]] = ("series",)
    cycled: ClassVar[bool] = False


@dataclass(frozen=True)
class Climatology(OptimalInterpolation):
    """The free members themselves, as if nothing was observed, and their spread; observations are not used. Once they
    have forgotten how they started, they are a sample of the model's climatology. Sources: as above.
    """

    words: ClassVar[str] = "the free members"

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """The weights as they are."""
        return Step(weights, 0.0)


@dataclass(frozen=True)
class BootstrapFilter(ETKF):
    """The bootstrap particle filter: the members are weighed by their likelihoods, resampled, and jittered. It takes no
    localisation.

        ω_i ∝ exp(−½ ‖d_i‖²),   d_i = d − S_i the whitened innovation of member i.

    No Gaussian is assumed and nothing is linear; the price is a number of members that grows exponentially with that of
    the observations. Systematic resampling makes N equal members of them at every cycle. Copies would stay copies where
    the model is deterministic, so that each is moved by ``jitter`` h: a draw from the kernel N(0, h² P), P the
    covariance of the weighted members, without the mean of the draws. The spread grows by √(1 + h²).

    Sources: Gordon, Salmond & Smith (1993), IEE Proc. F 140, 107; systematic: Kitagawa (1996), J. Comput. Graph. Stat.
    5, 1; jitter: Musso, Oudjane & Le Gland (2001), in Doucet et al., Sequential Monte Carlo Methods in Practice, ch.
    12.
    """

    words: ClassVar[str] = "weighed and resampled members"

    jitter: Annotated[float, Ge(0), "What a resampled member is moved by, in standard deviations of the posterior."] = (
        0.2
    )

    on: ClassVar[tuple[str, ...]] = ("series",)
    resamples: ClassVar[bool] = True

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Resampled members as rows of weights: a member is x̄ + X_a(i), one that has survived."""
        n = len(weights.w)
        shares = likelihood_shares(evaluation)
        start = float(ndtr(draw("resampling", 1)[0, 0]))
        index = systematic(shares, start)
        w = np.bincount(index, minlength=n) / n
        transform = cast(Array, Resampled(index, w, shares, self.jitter, draw))
        return Step(Weights(w, transform), math.sqrt(n - 1) * float(np.linalg.norm(w)), 1 / float(shares @ shares))


@dataclass(frozen=True)
class Resampled:
    """The transform that takes the members of these ``index`` (N,), about their mean of weights ``w`` (N,), and moves
    them by draws of the covariance that ``shares`` (N,) give, ``jitter`` times its root.
    """

    index: npt.NDArray[np.intp]
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
        return np.asarray(moved + self.jitter * centre(self.draw("jitter", len(root)))[1] @ root)

    @property
    def dense(self) -> Array:
        """As a matrix (N, N), without the jitter, which earlier states have no part in."""
        return np.asarray(np.eye(len(self.w))[self.index] - self.w)


def likelihood_shares(evaluation: Evaluation) -> Array:
    """Likelihoods (N,) of the members, of sum 1, relative to the largest, so that one is left however far all are."""
    misfit = np.sum((evaluation.d[:, None] - evaluation.S) ** 2, axis=0)
    likelihood = np.exp(-0.5 * (misfit - misfit.min()))
    return np.asarray(likelihood / likelihood.sum())


def systematic(shares: Array, start: float) -> npt.NDArray[np.intp]:
    """Indices (N,) of the members resampled: the comb (start + j)/N, 0 < start < 1, in the cumulated shares (N,).

    >>> systematic(np.array([0.5, 0.0, 0.25, 0.25]), 0.5).tolist()
    [0, 0, 2, 3]
    """
    comb = (start + np.arange(len(shares))) / len(shares)
    ends = np.cumsum(shares)
    return np.searchsorted(ends / ends[-1], comb)


@dataclass(frozen=True)
class ESMDA(ETKF):
    """The ensemble smoother with multiple data assimilation, for parameters.

    The same observations are assimilated several times, each time with their error covariance inflated by α_a, where
    Σ 1/α_a = 1: in the linear Gaussian case the sequence is one plain update, in a nonlinear one it is gentler. With
    the whitened anomalies S and innovations d_i = R^{-1/2}(y − p_i) of the current ensemble, member i moves by

        δ_i = A⁻¹ Sᵀ (d_i + √α z_i) / α,   A = (N−1) I + SᵀS/α,   z_i ~ N(0, I)        (perturbed)

    along the current anomalies. Perturbations are centred, so that the mean of the ensemble moves by the Kalman gain of
    its moments without sampling noise. ``square-root`` needs none: it moves the mean in the same way and the anomalies
    by the symmetric transform, and is exactly one update for a linear model.

    Sources: Emerick & Reynolds (2013), Computers & Geosciences 55, 3; square root: as the ETKF, applied to αR.

    ``mda_coefficients``: α_a relative to each other; :attr:`inflations` are scaled so that Σ 1/α_a = 1.

    >>> ESMDA((9.333, 7.0, 4.0, 2.0)).inflations.round(2).tolist()
    [9.33, 7.0, 4.0, 2.0]
    """

    words: ClassVar[str] = "multiple data assimilation"

    mda_coefficients: Annotated[
        tuple[Annotated[float, Gt(0)], ...],
        MinLen(1),
        "Inflation of R in each assimilation, scaled so that the inverses sum to one.",
    ] = (4.0, 4.0, 4.0, 4.0)
    mda_form: Annotated[Literal["perturbed", "square-root"], "Analysis: perturbed observations, or a square root."] = (
        "perturbed"
    )

    on: ClassVar[tuple[str, ...]] = ("window",)
    localised_keys: ClassVar[frozenset[str] | None] = frozenset(("mda_coefficients",))

    def __post_init__(self) -> None:
        if not self.mda_coefficients or not all(alpha > 0 for alpha in self.mda_coefficients):
            raise ValueError(f"MDA coefficients must be positive, not {self.mda_coefficients}")

    @property
    def passes(self) -> int:
        """One an inflation."""
        return len(self.mda_coefficients)

    @property
    def inflations(self) -> Array:
        """α_a, one an assimilation."""
        return mda_inflations(self.mda_coefficients)

    def advance(self, weights: Weights, evaluation: Evaluation, iteration: int, draw: Draw) -> Step | GaussNewtonStep:
        """Assimilation number ``iteration``; d is that of the mean prediction, S per unit of the current anomalies."""
        alpha = float(self.inflations[iteration])
        root = np.sqrt(alpha)
        d, S = evaluation.d / root, evaluation.S / root
        hessian = Hessian.of(S)
        shift = hessian.solve(d @ S)
        w, norm = weights.w + shift @ weights.T, hessian.norm(shift)
        if self.mda_form == "square-root":
            return Step(Weights(w, hessian.transform @ weights.T), norm)
        noise = draw(f"ES-MDA {iteration}")
        return Step(Weights(w, perturbed_transform(hessian, S, noise, weights.T)), norm)
