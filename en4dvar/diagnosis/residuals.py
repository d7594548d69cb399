r"""The residuals of a fit, compared with independent numbers of one variance, which they should be.

Whitened residuals e (K,) at the minimum of J are not independent even where model, prior and R are right: the fit has
absorbed a part of the noise. In the linear Gaussian case they are N(0, Q),

    Q = I − S A⁻¹ Sᵀ,     A = (N−1) I + SᵀS,

so that a ratio eᵀFe/eᵀe, which knows no scale, exceeds what was found with the probability that a quadratic form of
known eigenvalues is positive (Imhof 1961, Biometrika 48, 419; Durbin & Watson 1971, ibid. 58, 1). The diagonal of I − Q
is the leverage of each reading: the share of itself in its own prediction.

Readings of weights W = diag(β) pull the fit more or less than their errors do, but err by these. With the rows of S and
what they absorbed, P = S A⁻¹ Sᵀ, times √β as J has them, residuals in the readings' own errors have

    Q = (I − B)(I − B)ᵀ + W^(−½) (P − P²) W^(−½),     B = W^(−½) P W^½,

which is I − P where all weights are one. Readings that hardly count leave the fit to the prior, and are far off.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from en4dvar.model.state import Array, Indices, Mask

FEWEST = 8  # readings below which nothing is said
MOST = 500  # of them are looked at, evenly chosen blocks would tell no more
ROUNDING = 1e-3  # standard deviations: residuals of which none is larger are those of arithmetic, not of readings
FITTED = 0.005  # of the leverage of a reading: what less leaves of its residual is the error of the linearisation
NO_VARIANCE = 1e-12  # of the largest eigenvalue of Q; below it a direction was fitted exactly, to rounding
OF_ERRORS = 0.5  # of the variance of the readings in a direction, beyond which it is of their errors, not of the prior
EVEN = np.linspace(0.0, math.log1p(1e10), 1001)  # of ln (1 + u): with few weights the integrand falls slowly
FREQUENCIES = np.expm1(EVEN)
SIMPSON = EVEN[1] / 3 * (1 + FREQUENCIES) * np.concatenate([[1], np.tile([4, 2], 500)[:-1], [1]])


@dataclass(frozen=True)
class Residuals:
    """Residuals of the K readings that count: whitened ``white`` e (K,), in their own errors, what the fit ``absorbed``
    of their noise, L (K, r) with P = L Lᵀ, and the ``speed`` |ṁ| (K,) of the observable there, of several series in
    units of their errors. ``which`` (K,) are their places in the data; ``series`` (K,) labels those among which
    neighbours follow each other in time. ``dfs``: degrees of freedom for signal of all readings. ``freedom``: ν, where
    the size of the errors is estimated, of the inverse χ² that its square has in the posterior; e is that of its
    geometric mean.
    ``weights`` β (K,); None where all are one.
    """

    white: Array
    absorbed: Array
    speed: Array
    which: Indices
    series: Indices
    dfs: float
    freedom: float | None = None
    weights: Array | None = None

    @classmethod
    def of(
        cls,
        white: Array,
        sensitivity: Array,
        prior_precision: float,
        speed: Array,
        which: Indices,
        series: Indices | None = None,
        freedom: float | None = None,
        weights: Array | None = None,
    ) -> "Residuals":
        """From whitened sensitivities S (K, r), all rows of which take part in A, and N − 1. ``white`` (K',) and
        ``sensitivity`` (K'', r) are those of the observations, times √β, and, below, of what moves R.
        """
        k = len(speed)
        prior = math.sqrt(prior_precision) * np.eye(sensitivity.shape[1])
        # S R⁻¹ with RᵀR = A, which is not formed
        absorbed = np.linalg.qr(np.vstack([sensitivity, prior]))[0][: len(sensitivity)]
        labels = np.zeros(k, dtype=np.intp) if series is None else series
        dfs = float(np.sum(absorbed**2))
        own = None if weights is None or np.all(weights[which] == 1) else weights[which]
        e = white[:k][which] / (1.0 if own is None else np.sqrt(own))
        return cls(e, absorbed[which], speed[which], which, labels[which], dfs, freedom, own)

    @cached_property
    def leverage(self) -> Array:
        """(K,) share of each reading in its own prediction."""
        return np.asarray(np.sum(self.absorbed**2, axis=1))

    @cached_property
    def fitted(self) -> tuple[Array, Array]:
        """F (K, s) and M (s, s) with Q = I + F M Fᵀ."""
        L, identity = self.absorbed, np.eye(self.absorbed.shape[1])
        if self.weights is None:
            return L, -identity
        root = np.sqrt(self.weights)[:, None]
        within = (L * root).T @ (L * root) + identity - L.T @ L
        return np.hstack([L / root, L * root]), np.block([[within, -identity], [-identity, 0 * identity]])

    @cached_property
    def expected(self) -> Array:
        """Q (K, K); of many readings it would fill the memory."""
        F, M = self.fitted
        return np.asarray(np.eye(len(self.white)) + F @ M @ F.T)

    @cached_property
    def chi2_like(self) -> tuple[float, float]:
        """Factor g and degrees of freedom h of the g χ²_h with mean and variance of eᵀe (Satterthwaite 1946, Biometrics
        Bull. 2, 110).
        """
        F, M = self.fitted
        change = M @ (F.T @ F)
        mean = len(self.white) + float(np.trace(change))
        half_variance = mean + float(np.trace(change) + np.sum(change * change.T))
        return half_variance / mean, mean**2 / half_variance

    @cached_property
    def studentised(self) -> Array:
        """Residuals (K,) over their own expected std; 0 of a reading that only its own prediction is fitted to."""
        F, M = self.fitted
        left = 1 + np.sum(F @ M * F, axis=1)
        return np.where(left > FITTED, self.white / np.sqrt(np.maximum(left, FITTED)), 0.0)

    @property
    def enough(self) -> bool:
        """True if there is anything to be said."""
        size = float(np.max(np.abs(self.white), initial=0.0))
        return FEWEST <= len(self.white) <= MOST and ROUNDING < size < math.inf

    @cached_property
    def follows(self) -> Mask:
        """(K − 1,) whether a reading follows the one before it in the same series."""
        return np.asarray(self.series[1:] == self.series[:-1])

    @cached_property
    def lag_one(self) -> float:
        """Autocorrelation of neighbours, Σ e_k e_{k+1}/Σ e²."""
        return float((self.white[1:] * self.follows) @ self.white[:-1] / (self.white @ self.white))

    @cached_property
    def lag_one_chance(self) -> float:
        """Probability of so high an autocorrelation where the model is right; 1 where no reading follows another."""
        if not self.follows.any():
            return 1.0
        neighbours = np.diag(self.follows.astype(float), k=1)
        return self._chance(0.5 * (neighbours + neighbours.T))

    @cached_property
    def runs(self) -> tuple[int, float]:
        """Runs of one sign, and how many are expected of independent residuals."""
        positive = self.white > 0
        n, above = len(positive), int(positive.sum())
        changes, share = (positive[1:] != positive[:-1]) & self.follows, float(np.sum(self.follows)) / max(1, n - 1)
        return 1 + int(np.sum(changes)), 1 + 2 * above * (n - above) / n * share

    @cached_property
    def runs_chance(self) -> float:
        """Probability of so few runs, by the normal approximation (Wald & Wolfowitz 1940, Ann. Math. Stat. 11, 147);
        1 where no reading follows another, or the prior's pull on a fit of other weights gives residuals a sign."""
        if self.weights is not None or not self.follows.any():
            return 1.0
        count, expected = self.runs
        n = len(self.white)
        variance = (expected - 1) * (expected - 2) / (n - 1)
        return 0.5 * math.erfc((expected - count - 0.5) / math.sqrt(2 * variance)) if variance > 0 else 1.0

    @cached_property
    def collapse_chance(self) -> float:
        """Probability of residuals that are so much larger where the observable moves fast."""
        ranks = np.argsort(np.argsort(self.speed)).astype(float)
        return self._chance(np.diag(ranks - ranks.mean())) if np.ptp(self.speed) > 0 else 1.0

    @cached_property
    def outlier(self) -> tuple[int, float]:
        """The reading of the largest studentised residual, its place in the data, and the probability of one so large.

        Of u = Q^{-1/2}e, ν independent normal numbers for a covariance Q of rank ν, each studentised residual is a
        projection, so that its square over uᵀu is Beta(½, (ν − 1)/2); times K for the largest of them (Bonferroni).
        Readings far more exact than the prior leave Q no variance in the directions that the parameters fit. In those
        that mostly the prior lets vary, u says how much wider than the truth the prior is: a square counts as one, and
        residuals are those without these directions. Where the size of the errors is estimated, a posterior of more
        squares than u has, which are u and what the prior knows of that size, takes the place of uᵀu. One of fewer,
        as beside a discrepancy, knows less of the scatter than u does, and does not.
        """
        from scipy.special import betainc, digamma

        values, vectors = np.linalg.eigh(self.expected)
        root = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > OF_ERRORS]
        u, left = self.white @ root / values[values > OF_ERRORS], np.sum(root**2, axis=1)
        squares = np.where(left > FITTED, (root @ u) ** 2 / np.maximum(left, FITTED), 0.0)
        worst, rank = int(np.argmax(squares)), float(np.count_nonzero(values > NO_VARIANCE * values[-1]))
        freedom, total = rank, float(u @ u) + rank - len(u)
        if self.freedom is not None:
            freedom = max(self.freedom, float(len(u)))
            total = max(2 * math.exp(digamma(self.freedom / 2)), float(u @ u))
        if freedom <= 1:  # the residuals have one shape, whose largest part says nothing
            return int(self.which[worst]), 1.0
        share = min(1.0, float(squares[worst]) / total)
        chance = float(1 - betainc(0.5, (freedom - 1) / 2, share))
        return int(self.which[worst]), min(1.0, len(squares) * chance)

    def _chance(self, form: Array) -> float:
        """P(xᵀFx/xᵀx ≥ eᵀFe/eᵀe) for x ~ N(0, Q)."""
        ratio = float(self.white @ form @ self.white / (self.white @ self.white))
        values, vectors = np.linalg.eigh(self.expected)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return positive_chance(np.linalg.eigvalsh(root.T @ (form - ratio * np.eye(len(form))) @ root))


def positive_chance(weights: Array) -> float:
    """P(Σ λ_k z_k² > 0) of independent normal z for weights λ (K,), by Imhof's integral.

    >>> round(positive_chance(np.array([1.0, -1.0])), 6), round(positive_chance(np.array([1.0, 1.0, -1.0])), 4)
    (0.5, 0.7071)
    """
    scaled = weights / np.linalg.norm(weights)  # the integrand falls within a few units of u where weights are many
    u = FREQUENCIES[1:]
    angle = 0.5 * np.arctan(np.outer(u, scaled)).sum(axis=1)
    fall = np.exp(-0.25 * np.log1p(np.outer(u, scaled) ** 2).sum(axis=1))
    area = float(SIMPSON[0] * 0.5 * scaled.sum() + SIMPSON[1:] @ (np.sin(angle) * fall / u))
    return min(1.0, max(0.0, 0.5 + area / math.pi))
