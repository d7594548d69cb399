"""Dense algebra of an ensemble: centring, its span, weights of members, the Gauss–Newton Hessian, the analysis update.

Nothing here is larger than (N, n) or (K', N); no n×n matrix is ever formed.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from en4dvar.model.state import Array, Indices

GRAM_LIMIT = 100.0
LARGEST = 1.0  # bound (Σ λ⁴)^{1/4} of the eigenvalues of a Hessian near its prior, relative to it
SMALLEST_SIDE = 16  # of S: below, the decomposition of the smaller Gram matrix is as fast
GROUP = 4  # powers of M, from 0, that the series of an inverse root is evaluated with
NARROW = 0.05  # posterior standard deviations: along a longer step of a bundle a model may bend
LEAST = 1e-3  # of ε: a shorter step is lost in rounding
FEW = 512  # members up to which a transform is a matrix (2 MB); beyond, time and memory grow with N, not N²


def centre(ensemble: Array) -> tuple[Array, Array]:
    """Mean (n,) and anomalies (N, n) of members as rows (N, n)."""
    mean = np.add.reduce(ensemble, axis=0) / len(ensemble)  # .mean() to the bit, without its overhead
    return mean, ensemble - mean


def apply_weights(ensemble: Array, rows: Array) -> Array:
    """Analysis ensemble 1 x̄ᵀ + rows · X (M, n) of members (N, n) with mean x̄ and anomalies X; ``rows`` (M, N)."""
    mean, anomalies = centre(ensemble)
    analysed = np.asarray(rows @ anomalies)
    analysed += mean
    return analysed


def anomaly_basis(anomalies: Array) -> Array:
    """Orthonormal columns U (N, r) that span the column space of the anomalies X (N, n), r = rank X ≤ min(n, N − 1).

    Row i is member i in the coordinates of the ensemble. U Uᵀ projects weights on those that move the state: what it
    removes, the null space of Xᵀ, has no effect on x̄ + Xᵀw. Columns are scaled first, so units do not matter; the
    largest entry of each is positive.
    """
    scale = np.sqrt(np.mean(anomalies**2, axis=0))
    u, s, _ = np.linalg.svd(anomalies / np.where(scale > 0, scale, 1.0), full_matrices=False)
    rank = int(np.sum(s > s[0] * max(anomalies.shape) * np.finfo(float).eps)) if s[0] > 0 else 0
    u = u[:, :rank]
    return np.asarray(u * np.sign(u[np.abs(u).argmax(axis=0), np.arange(rank)]))


def min_norm_fit(design: Array, values: Array) -> Array:
    """Minimum-norm least-squares solution C of ``design @ C = values``; (m, r), (m, k) → (r, k)."""
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0])


def sizes(rows: Array) -> Array:
    """Root mean squares (n,) of the columns of ``rows`` (r, n), 1 of one of zeros: over these, units do not matter."""
    of_columns = np.sqrt(np.mean(rows**2, axis=0))
    return np.asarray(np.where(of_columns > 0, of_columns, 1.0))


def least_coordinates(directions: Array, changes: Array) -> Array:
    """The shortest coordinates (…, r) of ``changes`` (…, n), which are these times the ``directions`` (r, n).

    Columns are scaled first, so units do not matter: with a pressure in Pa beside a time in s, all but the pressure
    would be taken for rounding.
    """
    scale = sizes(directions)
    return min_norm_fit((directions / scale).T, (changes / scale).T).T


def bundle_steps(spread: Array, axes: Array, epsilon: float) -> Array:
    """Steps of a bundle as rows (r, r), in units of ε prior standard deviations.

    ``spread`` (r,) are standard deviations of an ensemble, relative to the prior's, along its ``axes`` (r, r), the
    columns. The steps go along these and are at most :data:`NARROW` of them: where readings are exact, ε prior standard
    deviations are many posterior ones. They are the identity where none needs to be shorter.
    """
    shares = NARROW * spread / epsilon
    return np.eye(len(axes)) if np.all(shares >= 1) else np.clip(shares, LEAST, 1)[:, None] * axes.T


def with_moments(members: Array, mean: Array, root: Array) -> Array:
    """Members (N, n), N > n, mapped linearly so that ``mean`` (n,) is theirs, and their covariance RᵀR of a ``root`` R
    (n, n). No covariance is formed, of which rounding would lose more.
    """
    orthogonal, own = np.linalg.qr(members - members.mean(axis=0))
    signs = np.copysign(math.sqrt(len(members) - 1), np.diag(own) * np.diag(root))  # both roots as Cholesky's
    return np.asarray(mean + (orthogonal * signs) @ root)


def resampled(shares: Array, count: int, stream: np.random.Generator) -> Indices:
    """(count,) indices, each as often as its share says; shares add up to one."""
    return systematic(shares, count, stream.uniform())


def systematic(shares: Array, count: int, start: float) -> Indices:
    """The same by the comb (start + j)/count, 0 < start < 1 (Kitagawa 1996, J. Comput. Graph. Stat. 5, 1).

    >>> systematic(np.array([0.5, 0.0, 0.25, 0.25]), 4, 0.5).tolist()
    [0, 0, 2, 3]
    """
    comb = (np.arange(count) + start) / count
    return np.searchsorted(np.cumsum(shares), comb, side="right").clip(max=len(shares) - 1)


def shares_of(logs: Array) -> Array:
    """Weights (D,) that add up to one, of these logarithms; one must be finite."""
    weights = np.exp(logs - logs.max())
    return np.asarray(weights / weights.sum())


def effective_number(weights: Array) -> float:
    """Number of equally likely draws that are worth as much as draws of these weights, (Σ w)²/Σ w²."""
    return float(weights.sum() ** 2 / np.sum(weights**2))


@dataclass(frozen=True)
class LowRank:
    """I + ``left`` ``right``, of (N, k) and (k, N): a transform of many members, without the matrix (N, N)."""

    left: Array
    right: Array

    def __matmul__(self, columns: Array) -> Array:
        return np.asarray(columns + self.left @ (self.right @ columns))

    @property
    def dense(self) -> Array:
        """As a matrix."""
        return np.asarray(np.eye(len(self.left)) + self.left @ self.right)


@dataclass(frozen=True)
class Hessian:
    """A = (N−1) I + SᵀS through one decomposition of the whitened anomalies S (K', N): every analysis starts here.

    ``rows`` (m, N), m ≤ N, are orthogonal, of lengths ``singular_values`` (m,), and SᵀS = rowsᵀ rows. Nothing below
    divides by a singular value, so those that vanish do no harm. ``axes`` (m, N), where they are at hand, are the rows
    without their lengths: with them :meth:`solve` is exact to rounding however much the observations inform.
    """

    singular_values: Array
    rows: Array
    axes: Array | None = None

    @classmethod
    def of(cls, s: Array, basis: Array | None = None) -> "Hessian":
        """From the smallest matrix that tells.

        With ``basis`` U (N, r), orthonormal columns, S is s Uᵀ: then from the SVD of s (K', r).
        Else from the eigenvectors of the smaller one of SᵀS and SSᵀ, several times faster than the SVD of S, where
        that loses no accuracy: squaring S costs rounding errors of eps · ‖S‖² in A ≥ N − 1, which vanish while the
        observations inform less than ``GRAM_LIMIT`` times the prior.
        """
        if basis is not None:  # further rows of zeros, so that every direction of the basis has an axis
            padded = np.pad(s, ((0, max(0, basis.shape[1] - len(s))), (0, 0)))
            _, sigma, right = np.linalg.svd(padded, full_matrices=False)
            axes = right @ basis.T
            return cls(sigma, sigma[:, None] * axes, axes)
        n_observations, n_members = s.shape
        small = n_observations < n_members
        gram = s @ s.T if small else s.T @ s
        if np.vdot(gram, gram) <= (GRAM_LIMIT * (n_members - 1)) ** 2:  # Frobenius: no less than ‖S‖⁴
            squares, vectors = np.linalg.eigh(gram)
            sigma, vectors = np.sqrt(np.maximum(squares[::-1], 0)), vectors.T[::-1]
            return cls(sigma, vectors @ s if small else sigma[:, None] * vectors)
        _, sigma, right = np.linalg.svd(s, full_matrices=False)
        return cls(sigma, sigma[:, None] * right, right)

    @property
    def prior_precision(self) -> float:
        """N − 1."""
        return float(self.rows.shape[1] - 1)

    def solve(self, g: Array, damping: float = 0.0) -> Array:
        """(A + damping (N−1) I)⁻¹ g for g (N,), or for every row of g (M, N)."""
        base = self.prior_precision * (1 + damping)
        if self.axes is not None:
            along, rest = g @ self.axes.T, g
            for _ in range(2):  # what rounding leaves of g along the axes would be divided by the prior's precision
                rest = rest - (rest @ self.axes.T) @ self.axes
            return np.asarray((along / (base + self.singular_values**2)) @ self.axes + rest / base)
        informed = (g @ self.rows.T) / (base + self.singular_values**2)
        return np.asarray((g - informed @ self.rows) / base)

    def norm(self, delta: Array) -> float:
        """√(δᵀAδ) of a change of the weights (N,): its length in posterior standard deviations."""
        seen = self.rows @ delta
        return math.sqrt(self.prior_precision * float(delta @ delta) + float(seen @ seen))

    @cached_property
    def transform(self) -> Array:
        """T = √(N−1) A^{-1/2} (N, N), the symmetric root: T 1 = 1 when S 1 = 0."""
        return self._thin.dense

    @property
    def economical_transform(self) -> Array | LowRank:
        """T as a matrix where members are few."""
        return self.transform if self.rows.shape[1] <= FEW else self._thin

    @property
    def _thin(self) -> LowRank:
        # 1/√(1+x) − 1 = −x / (√(1+x) (1 + √(1+x))), x = σ²/(N−1)
        root = np.sqrt(1 + self.singular_values**2 / self.prior_precision)
        return LowRank(-self.rows.T * (1 / (self.prior_precision * root * (1 + root))), self.rows)


@dataclass(frozen=True)
class NearPrior:
    """The Hessian of an analysis that stays near its prior: roots by a polynomial, without a decomposition.

    A by its ``transform`` T = √(N−1) A^{-1/2} (N, N), which with M = SᵀS/(N−1) is (I + M)^{-1/2}. Where observations
    inform no direction more than the prior does, M ≤ 1, as in a filter that keeps up with them, a Chebyshev series of
    (1 + x)^{-½} reaches rounding error with 12 to 24 terms, which are a handful of matrix products (Paterson &
    Stockmeyer 1973, SIAM J. Comput. 2, 60): three times faster than the eigenvectors of a matrix of 40 rows. A⁻¹
    follows from T by a product.
    """

    transform: Array

    @classmethod
    def of(cls, s: Array) -> "NearPrior | Hessian":
        """From whitened anomalies S (K', N); a :class:`Hessian` for a long series."""
        n_members = s.shape[1]
        if min(s.shape) < SMALLEST_SIDE:
            return Hessian.of(s)
        information = s.T @ s
        information *= 1 / (n_members - 1)
        square = information @ information
        bound = float(np.vdot(square, square)) ** 0.25
        if not bound <= LARGEST:
            return Hessian.of(s)
        upper = 2.0 ** (0.5 * max(-6, math.ceil(2 * math.log2(bound)))) if bound > 0 else 0.125
        return cls(_inverse_root(information, square, upper))

    @property
    def prior_precision(self) -> float:
        """N − 1."""
        return float(len(self.transform) - 1)

    def solve(self, g: Array) -> Array:
        """A⁻¹ g for g (N,), or for every row of g (M, N)."""
        return np.asarray((self.transform @ (self.transform @ g.T)).T / self.prior_precision)


@lru_cache(maxsize=16)
def _series(upper: float) -> Array:
    """Coefficients (blocks, GROUP) of (1 + x)^{-1/2} on [0, upper] in powers of x, to rounding.

    That of degree d in Chebyshev polynomials is of the order of ρ^{−d}, ρ the sum of the semi-axes of the ellipse with
    the foci 0 and ``upper``, scaled to ±1, through the singularity at x = −1.
    """
    degree = -math.log(np.finfo(float).eps) / math.acosh(1 + 2 / upper) + 2
    blocks = math.ceil((degree + 1) / GROUP)
    interval = [0, upper]
    series = Chebyshev.interpolate(lambda x: 1 / np.sqrt(1 + x), GROUP * blocks - 1, interval)
    powers = series.convert(interval, Polynomial, interval).coef  # without trailing zeros
    return np.asarray(np.pad(powers, (0, GROUP * blocks - len(powers))).reshape(blocks, GROUP))


def _inverse_root(m: Array, square: Array, upper: float) -> Array:
    """(I + M)^{-1/2} of a symmetric M (N, N) with eigenvalues in [0, upper] and its square."""
    coefficients, n = _series(upper), len(m)
    powers = np.empty((GROUP, n, n))
    powers[0] = 0.0
    powers[0].flat[:: n + 1] = 1.0
    powers[1], powers[2] = m, square
    np.matmul(square, m, out=powers[3])
    beyond = square @ square
    blocks = (coefficients @ powers.reshape(GROUP, -1)).reshape(-1, n, n)
    root = blocks[-1]
    for block in blocks[-2::-1]:
        root = root @ beyond
        root += block
    return np.asarray(root)
