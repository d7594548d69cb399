r"""Errors beside a discrepancy of the model that is correlated in time: y = m + δ + ε.

With ε as of R = D C D and δ a Gaussian process of covariance A (:class:`Kernel`), whose amplitude a
and length ℓ are parameters, δ is marginalised: y − m has the covariance R + A = L Lᵀ, v = L⁻¹(y − m),

    J_o = β [ ½ vᵀv + Σ ln(L_kk/std_k) ].

With M_j = L⁻¹ ∂_j(R + A) L⁻ᵀ the score of a direction j that moves the covariance is ½ (vᵀM_j v − tr M_j), the Fisher
information F_ij = ½ tr(M_i M_j) = Q Λ Qᵀ; rows √Λ Qᵀ of S with Qᵀ score/√Λ of d give both, beside the rows L⁻¹ ∂m.

Sources: Kennedy & O'Hagan (2001), J. R. Stat. Soc. B 63, 425 (discrepancy); Mardia & Marshall (1984), Biometrika 71,
135 (score and information).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from en4dvar.data.noise.correlated import AnyCorrelation, CorrelatedNoise, Correlation
from en4dvar.data.noise.gaussian import Linearisation, Noise, Predicted
from en4dvar.data.noise.losses import HuberNoise
from en4dvar.data.noise.state_space import boxed, innovations
from en4dvar.model.state import Array
from en4dvar.priors.dependence import KERNELS

AT_ONCE = 1 << 15  # elements of covariance matrices in one call: they stay in the processor's cache
BORDER = 1e300  # beside it every square of a whitened residual is nothing
SAME = 1e-12  # relative eigenvalue of an information that counts as none
NUGGET = 1e-10  # of the amplitude squared, on the diagonal: smooth kernels of close readings are singular to rounding
SMOOTHNESS = {"exponential": 0.5, "matern-3/2": 1.5, "matern-5/2": 2.5}  # name → ν


@dataclass(frozen=True)
class Kernel:
    """cov(δ, δ') = a² g g' k(|t − t'|/ℓ) with a Matérn correlation k of smoothness ν, at ``times`` (K,) that do not
    decrease.

    ν = ½ is exp(−|t − t'|/ℓ), whose paths are continuous and nowhere smooth; those of ν = 3/2 have one derivative,
    those of 5/2 two. g = √(1 + (ṁ/``grows_beyond``)²) grows with the rate of the observable, since a model that is
    early or late errs most where that is fast; g = 1 by default. Source: Rasmussen & Williams (2006), Gaussian
    Processes for Machine Learning, § 4.2.1.

    Raises ValueError: another ν, or ``grows_beyond`` not positive.
    """

    times: Array
    smoothness: float = 0.5
    grows_beyond: float = math.inf

    def __post_init__(self) -> None:
        if self.smoothness not in SMOOTHNESS.values():
            raise ValueError(f"the kernel of a discrepancy has smoothness 0.5, 1.5 or 2.5, not {self.smoothness:g}")
        if not self.grows_beyond > 0:
            raise ValueError("the rate beyond which a discrepancy grows must be positive")

    @property
    def grows(self) -> bool:
        """True if it depends on the rate."""
        return math.isfinite(self.grows_beyond)

    @cached_property
    def steps(self) -> Array:
        """From each time to the next (K − 1,)."""
        return np.diff(self.times)

    @property
    def nugget(self) -> float:
        """Of the amplitude squared, on the diagonal."""
        return NUGGET if self.smoothness > 0.5 else 0.0

    @cached_property
    def lags(self) -> Array:
        """|t − t'| (K, K)."""
        return np.abs(np.subtract.outer(self.times, self.times))

    def correlation(self, length: Array) -> Array:
        """k (…, K, K) for lengths ℓ (…,), with the :data:`NUGGET` where k is smooth."""
        (kernel,) = (KERNELS[name] for name, nu in SMOOTHNESS.items() if nu == self.smoothness)
        k = kernel(self.lags / length[..., None, None])
        diagonal = np.arange(len(self.times))
        k[..., diagonal, diagonal] = 1 + self.nugget
        return np.asarray(k)

    def log_length_slope(self, length: Array) -> Array:
        """∂k/∂ln ℓ (…, K, K)."""
        x = math.sqrt(2 * self.smoothness) * self.lags / length[..., None, None]
        factor = {0.5: x, 1.5: x * x, 2.5: x * x * (1 + x) / 3}[self.smoothness]
        return np.asarray(factor * np.exp(-x))

    def growth(self, rates: Array | None) -> Array:
        """g (…, K); 1 without rates."""
        if rates is None or not self.grows:
            return np.ones(len(self.times))
        return np.asarray(np.sqrt(1 + (rates / self.grows_beyond) ** 2))

    def log_growth_slope(self, rates: Array) -> Array:
        """∂ln g/∂ṁ (…, K)."""
        return np.asarray(rates / (self.grows_beyond**2 + rates**2)) if self.grows else np.zeros_like(rates)


@dataclass(frozen=True)
class Direction:
    """A way to move R + A: derivatives ∂R and ∂A (K, K), and how far each of the coordinates moves along it (N,)."""

    errors: Array
    discrepancy: Array
    coordinates: Array

    def change(self, light: Array | float) -> Array:
        """∂(R/w + A) (K, K) where readings count by w, ``light`` (K,) or one number."""
        return np.asarray(self.errors / np.reshape(light, (-1, 1)) + self.discrepancy)


@dataclass(frozen=True)
class DiscrepancyNoise(Noise):
    """Gaussian errors, correlated where there is a ``correlation``, beside a discrepancy with a ``kernel``."""

    kernel: Kernel
    correlation: AnyCorrelation | None = None

    discrepant: ClassVar[bool] = True
    independent = False
    expected_light = 1.0  # E[ρ'']

    def check(self, weights: Array) -> None:
        super().check(weights)
        if self.correlation is not None:
            self.correlation.check_size(len(weights))
        if self.kernel.times.shape != weights.shape:
            raise ValueError(f"the kernel of the discrepancy is that of {len(self.kernel.times)} observations")
        if np.any(self.kernel.steps < 0):
            raise ValueError("the times of the kernel of a discrepancy must not decrease")
        if np.ptp(weights) > 0:
            raise ValueError("a discrepancy needs one weight for all observations")

    @property
    def words(self) -> str:
        return f"{', correlated' if self.correlation else ''} + discrepancy"

    @property
    def needs_rates(self) -> bool:
        return self.timed or self.kernel.grows

    @property
    def grows_beyond(self) -> float:  # type: ignore[override]
        return self.kernel.grows_beyond

    def attributes(self) -> dict[str, float]:
        return {"discrepancy_smoothness": self.kernel.smoothness, "discrepancy_grows_beyond": self.grows_beyond}

    def matrices(self) -> dict[str, tuple[Array, str]]:
        return {} if self.correlation is None else self.correlation.record()

    def scaled(self, values: float, times: float) -> "DiscrepancyNoise":
        """With the amplitude times ``values`` and the length times ``times`` the covariance is values² times what it
        was: g is that of a rate values/times as large.
        """
        beyond, of_clock = abs(values / times) * self.grows_beyond, abs(times)
        kernel = replace(self.kernel, times=of_clock * self.kernel.times, grows_beyond=beyond)
        return replace(self, std=abs(values) * self.std, time_std=of_clock * self.time_std, kernel=kernel)

    def covariance_of_errors(self, predicted: Predicted) -> Array:
        """R (…, K, K)."""
        s = self.error_std(predicted)
        c = np.eye(len(self.std)) if self.correlation is None else self.correlation.matrix
        return np.asarray(s[..., :, None] * s[..., None, :] * c)

    def covariance_of_discrepancy(self, predicted: Predicted) -> Array:
        """A (…, K, K)."""
        amplitude, length = self._amplitude_and_length(predicted)
        a = amplitude[..., None] * self.kernel.growth(predicted.rates)
        return np.asarray(a[..., :, None] * a[..., None, :] * self.kernel.correlation(length))

    def total_std(self, predicted: Predicted) -> Array:
        amplitude, _ = self._amplitude_and_length(predicted)
        return np.hypot(self.error_std(predicted), amplitude[..., None] * self.kernel.growth(predicted.rates))

    def frozen(self, predicted: Predicted) -> Noise:
        covariance = self.covariance(predicted)
        std = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(std, std)
        np.fill_diagonal(correlation, 1.0)
        return CorrelatedNoise(std, np.zeros_like(std), Correlation(0.5 * (correlation + correlation.T)))

    def drawn(self, predicted: Predicted, stream: np.random.Generator) -> Array:
        root = np.linalg.cholesky(self.covariance_of_discrepancy(predicted))
        missed = np.einsum("...ij,...j->...i", root, stream.standard_normal(predicted.values.shape))
        return np.asarray(super().drawn(predicted, stream) + missed)

    def explained(self, values: Array, predicted: Predicted) -> tuple[Array, Array]:
        """Mean and std (K,) of δ given the residual at one prediction."""
        covariance = self.covariance_of_discrepancy(predicted)
        root = np.linalg.cholesky(self.covariance(predicted, self._light(values, predicted)))
        both = np.column_stack([values - predicted.values, covariance])
        mean, *gain = (covariance @ cho_solve((root, True), both)).T
        variance = np.diag(covariance) - np.diag(np.array(gain))
        return mean, np.sqrt(np.maximum(variance, 0.0))

    def continued(self, values: Array, predicted: Predicted) -> tuple[Array, Array]:
        k = len(values)
        total = self.covariance(predicted)
        total[range(k), range(k)] += self._more_variance(values, predicted)
        gain = cho_solve((np.linalg.cholesky(total[:k, :k]), True), total[:k, k:])
        mean = predicted.values[k:] + (values - predicted.values[:k]) @ gain
        variance = np.diag(total)[k:] - np.sum(total[:k, k:] * gain, axis=0)
        return np.asarray(mean), np.asarray(np.sqrt(np.maximum(variance, self.error_std(predicted)[k:] ** 2)))

    def _more_variance(self, values: Array, predicted: Predicted) -> Array:
        """(K,) of readings that count less than the others; of the first K of those predicted."""
        return np.zeros(len(values))

    def whitened_residual(self, values: Array, predicted: Predicted) -> Array:
        return np.asarray(self._innovations(values, predicted)[0])

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        v, roots = self._innovations(values, predicted)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            total = weights[0] * np.sum(0.5 * v * v + np.log(roots / self.std), axis=-1)
        return np.where(np.isfinite(total), total, np.inf)

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        v, roots = self._innovations(values, predicted)
        return np.asarray(-0.5 * v * v - np.log(roots) - self._log_norm())

    def log_conditional(self, values: Array, predicted: Predicted) -> Array | None:
        """Conditional densities of N(m, R + A), as for correlated errors; NaN where that is singular to rounding."""

        def conditional(runs: Predicted) -> tuple[Array]:
            try:
                precision = np.linalg.inv(self.covariance(runs))
            except np.linalg.LinAlgError:
                return (np.full_like(runs.values, np.nan),)
            scaled = np.einsum("bij,bj->bi", precision, values - runs.values)
            own = np.diagonal(precision, axis1=1, axis2=2)
            return (0.5 * (np.log(own) - scaled**2 / own) - self._log_norm(),)

        return np.asarray(self._in_parts(predicted, 1, conditional)[0])

    def whiten(self, values: Array, weights: Array, at: Linearisation) -> tuple[Array, Array]:
        p, light = at.prediction, self._light(values, at.prediction)
        covariances = np.stack([self.covariance(p, w) for w in (light, self.expected_light)])
        root, expected = np.asarray(np.linalg.cholesky(covariances), dtype=float)
        white = solve_triangular(root, np.column_stack([values - p.values, at.anomalies.T]), lower=True)
        u, directions = solve_triangular(root, white[:, 0], lower=True, trans="T"), self._directions(at)
        changes = [both_sides(expected, direction.change(self.expected_light)) for direction in directions]
        of_each = zip(directions, changes, strict=True)
        score = [0.5 * (u @ direction.change(light) @ u - np.trace(change)) for direction, change in of_each]
        return augmented(weights, white, directions, changes, np.array(score))

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        root = np.linalg.cholesky(self.covariance(at, self._light(values, at)))
        return np.asarray(weights[0] * cho_solve((root, True), vectors.T).T)

    def whitened_rows(self, values: Array, rows: Array, predicted: Predicted) -> Array:
        """L⁻¹c (B, M, K) of rows c (M, K), for R/w + A = LLᵀ of runs (B,)."""
        light = self._light(values, predicted)
        if self.correlation is not None:
            root = np.linalg.cholesky(self.covariance(predicted, light))
            return np.linalg.solve(root, np.broadcast_to(rows.T, (len(root), *rows.T.shape))).swapaxes(1, 2)
        _, s, a, length = self._in_time(values, predicted)
        each = (np.repeat(part, len(rows), axis=0) for part in (s**2 / light, a, length))
        return np.asarray(self._filtered(np.tile(rows, (len(s), 1)), *each)[0].reshape(len(s), *rows.shape))

    def _correlated(self, v: Array) -> Array:
        return v if self.correlation is None else self.correlation.correlated(v)

    def _amplitude_and_length(self, predicted: Predicted) -> tuple[Array, Array]:
        if predicted.discrepancy is None:
            raise ValueError("predictions lack amplitude and length of the discrepancy")
        return np.asarray(predicted.discrepancy[..., 0]), np.asarray(predicted.discrepancy[..., 1])

    def _light(self, values: Array, predicted: Predicted) -> Array:
        return np.ones(predicted.values.shape)

    def covariance(self, predicted: Predicted, light: Array | float = 1.0) -> Array:
        """R/w + A (…, K, K), w how much readings count: ``light`` (…, K), or one number."""
        errors = self.covariance_of_errors(predicted) / np.expand_dims(light, -1)
        return np.asarray(errors + self.covariance_of_discrepancy(predicted))

    def _directions(self, at: Linearisation) -> list[Direction]:
        """Directions in which the covariance changes: the parameters of the errors, and those of each coordinate."""
        p = at.prediction
        errors, discrepancy = self.covariance_of_errors(p), self.covariance_of_discrepancy(p)
        directions, nothing = [], np.zeros_like(errors)
        if at.log_scale_anomalies is not None:
            directions.append(Direction(2 * errors, nothing, at.log_scale_anomalies))
        if at.log_discrepancy_anomalies is not None:
            amplitude, length = self._amplitude_and_length(p)
            a = amplitude * self.kernel.growth(p.rates)
            of_length = np.outer(a, a) * self.kernel.log_length_slope(length)
            directions.append(Direction(nothing, 2 * discrepancy, at.log_discrepancy_anomalies[:, 0]))
            directions.append(Direction(nothing, of_length, at.log_discrepancy_anomalies[:, 1]))
        log_s = self._log_std_anomalies(replace(at, log_scale_anomalies=None))
        if log_s is not None and p.rates is not None and at.rate_anomalies is not None:
            log_g = self.kernel.log_growth_slope(p.rates) * at.rate_anomalies
            for s, g, unit in zip(log_s, log_g, np.eye(len(log_s)), strict=True):
                directions.append(Direction(errors * np.add.outer(s, s), discrepancy * np.add.outer(g, g), unit))
        return directions

    def _in_parts(self, predicted: Predicted, arrays: int, evaluate: Callable[[Predicted], Sequence[Array]]) -> Array:
        """(arrays, …, K) of what ``evaluate`` gives of some of the runs at a time."""
        runs = in_rows(predicted)
        joined = np.empty((arrays, *runs.values.shape))
        chunk = max(1, AT_ONCE // runs.values.shape[-1] ** 2)
        for first in range(0, len(runs.values), chunk):
            part = slice(first, first + chunk)
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                joined[:, part] = evaluate(runs[part])
        return joined.reshape(arrays, *predicted.values.shape)

    def _innovations(self, values: Array, predicted: Predicted) -> Array:
        """v and the diagonal of L (2, …, K); NaN where a prediction is not finite or R/w + A is all but singular."""
        if self.correlation is not None:
            return self._in_parts(predicted, 2, lambda runs: whitened(values - runs.values, self.covariance(runs)))
        with np.errstate(over="ignore", invalid="ignore"):
            residual, s, a, length = self._in_time(values, predicted)
            variance = s**2 / self._light(values, predicted).reshape(s.shape)
            return self._filtered(residual, variance, a, length).reshape(2, *predicted.values.shape)

    def _in_time(self, values: Array, predicted: Predicted) -> tuple[Array, Array, Array, Array]:
        """y − m, s and a g (B, K) of the runs, and ℓ (B,)."""
        runs = in_rows(predicted)
        amplitude, length = self._amplitude_and_length(runs)
        a = amplitude[:, None] * self.kernel.growth(runs.rates)
        residual, s, a = np.broadcast_arrays(values - runs.values, self.error_std(runs), a)
        return residual, s, a, length

    def _filtered(self, residual: Array, variance: Array, a: Array, length: Array) -> Array:
        """v and the diagonal of L (2, B, K) for independent errors of this ``variance`` (B, K), in O(K) a run."""
        k = self.kernel
        return innovations(residual, variance + k.nugget * a**2, a, length, k.steps, k.smoothness)


@dataclass(frozen=True)
class RobustDiscrepancyNoise(DiscrepancyNoise):
    r"""Independent errors with exponential tails beyond ``threshold`` std, beside a discrepancy.

    δ cannot be integrated out of Huber's density, so it is marginalised by Laplace's approximation at its mode,

        J_o = β { min_δ [ Σ ρ((r − δ)/s) + ½ δᵀA⁻¹δ ] + ½ ln det(S²/κ + A) + ½ K ln κ − Σ ln std },     r = y − m,

    with the expected curvature κ = E[ρ''] in place of that at each reading, which jumps where one crosses the
    threshold. It is exact for Gaussian errors (c → ∞) and without a discrepancy. At the minimum u = A⁻¹δ = ρ'(v)/s with
    v = (r − δ)/s; u solves a quadratic problem in the box |u| ≤ c/s, found along the readings
    (:mod:`~en4dvar.data.noise.state_space`). Then ∂J_o/∂m = −u, and rows of d and S are those of S²/w + A, w = ρ'(v)/v.
    """

    threshold: float = math.inf

    @cached_property
    def huber(self) -> HuberNoise:
        """The same errors without a discrepancy."""
        return HuberNoise(self.std, self.time_std, self.threshold)

    def check(self, weights: Array) -> None:
        super().check(weights)
        self.huber.check(weights)

    @property
    def words(self) -> str:
        return f"{self.huber.words} + discrepancy"

    @property
    def counts_within(self) -> float:
        return self.threshold

    @property
    def expected_light(self) -> float:  # type: ignore[override]
        return self.huber.expected_curvature

    def attributes(self) -> dict[str, float]:
        return {**self.huber.attributes(), **super().attributes()}

    def _light(self, values: Array, predicted: Predicted) -> Array:
        _, errors, s, *_ = self._at_mode(values, predicted)
        most = self.threshold * s
        return np.asarray(most / np.maximum(np.abs(errors), most))

    def _more_variance(self, values: Array, predicted: Predicted) -> Array:
        first = slice(len(values))
        kernel = replace(self.kernel, times=self.kernel.times[first])
        within = replace(self, std=self.std[first], time_std=self.time_std[first], kernel=kernel)
        there = predicted.among(first)
        return np.asarray(within.error_std(there) ** 2 * (1 / within._light(values, there) - 1))

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        terms = self._terms(values, predicted)
        with np.errstate(over="ignore", invalid="ignore"):
            total = weights[0] * np.sum(terms - np.log(self.std), axis=-1)
        return np.where(np.isfinite(total), total, np.inf)

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        """Shares of the observations (…, K): a division of the joint density; single terms have no meaning."""
        return -self._terms(values, predicted) - self._log_norm()

    def log_conditional(self, values: Array, predicted: Predicted) -> None:
        """None: the joint density is an approximation that knows no reading by itself."""

    def _white(self, stream: np.random.Generator, shape: tuple[int, ...]) -> Array:
        return self.huber._white(stream, shape)

    def _log_norm(self) -> float:
        return self.huber._log_norm()

    def _terms(self, values: Array, predicted: Predicted) -> Array:
        """Terms of J_o (…, K), β and ln std apart; NaN where a prediction is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            u, errors, s, delta, roots = self._at_mode(values, predicted)
            terms = self.huber._loss(errors / s) + 0.5 * u * delta + np.log(roots)
            return np.asarray(terms + 0.5 * math.log(self.expected_light))

    def _at_mode(self, values: Array, predicted: Predicted) -> Array:
        """u, r − δ, s and δ at the mode in δ, and the diagonal of the root of S²/κ + A (5, …, K)."""
        with np.errstate(over="ignore", invalid="ignore"):
            k, (residual, s, a, length) = self.kernel, self._in_time(values, predicted)
            u, delta = boxed(residual, s, k.nugget * a**2, a, length, k.steps, k.smoothness, self.threshold)
            _, roots = self._filtered(residual, s**2 / self.expected_light, a, length)
            return np.reshape([u, residual - delta, s, delta, roots], (5, *predicted.values.shape))


def in_rows(predicted: Predicted) -> Predicted:
    """The same with one leading dimension."""
    leading = predicted.values.ndim - 1
    return predicted.each(lambda part: np.reshape(part, (-1, *np.shape(part)[leading:])))


def whitened(residuals: Array, covariances: Array) -> tuple[Array, Array]:
    """L⁻¹r and the diagonal of L, each (B, K), for residuals (B, K) and covariances (B, K, K); NaN where there is no L.
    The Cholesky factor of a covariance that is bordered by the residual has L⁻¹r as its last row.
    """
    count, k = residuals.shape
    bordered = np.empty((count, k + 1, k + 1))
    bordered[:, :k, :k] = covariances
    bordered[:, k, :k] = bordered[:, :k, k] = residuals
    bordered[:, k, k] = BORDER
    known = np.isfinite(bordered).all(axis=(1, 2))
    bordered[~known] = np.eye(k + 1)
    try:
        roots = np.linalg.cholesky(bordered)
    except np.linalg.LinAlgError:
        roots = np.stack([_root_or_nan(matrix) for matrix in bordered])
    roots[~known] = np.nan
    return roots[:, k, :k], np.diagonal(roots, axis1=1, axis2=2)[:, :k]


def _root_or_nan(matrix: Array) -> Array:
    try:
        return np.asarray(np.linalg.cholesky(matrix), dtype=float)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


def both_sides(root: Array, matrix: Array) -> Array:
    """L⁻¹ B L⁻ᵀ of a symmetric B (K, K)."""
    half = solve_triangular(root, matrix, lower=True)
    return np.asarray(solve_triangular(root, half.T, lower=True))


def augmented(
    weights: Array, white: Array, directions: Sequence[Direction], changes: Sequence[Array], score: Array
) -> tuple[Array, Array]:
    """d and S of the whitened residual and anomalies (K, 1 + N), with the rows of what moves the covariance below."""
    # Rows (r, D) and their right-hand side (r,): rowsᵀrows is the information of D directions, rowsᵀside the score
    flat = np.array([change.ravel() for change in changes])
    values, vectors = np.linalg.eigh(0.5 * flat @ flat.T)
    kept = values > SAME * values[-1]
    root = np.sqrt(values[kept])
    rows, side = root[:, None] * vectors[:, kept].T, (score @ vectors[:, kept]) / root
    moved = rows @ np.stack([direction.coordinates for direction in directions])
    d, sensitivity = np.concatenate([white[:, 0], side]), np.concatenate([white[:, 1:], moved])
    return np.sqrt(weights[0]) * d, np.sqrt(weights[0]) * sensitivity
