"""What errors take from the state, and Gaussian ones, independent of each other: the base of every kind.

R depends on predictions, their rates, and the parameters of the errors; a kind says what differs from :class:`Noise`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from en4dvar.model.state import Array, Mask

Where = slice | npt.NDArray[np.intp]  # which readings
_ARCS, _ARC = np.linspace(-12.0, 12.0, 1200, retstep=True)
GRID, WIDTHS = np.sinh(_ARCS), np.cosh(_ARCS) * _ARC  # whitened residuals over which densities are integrated; no 0
LOGS = (-300.0, 300.0)  # of σ, amplitude, length: what a polynomial says far from its runs stays a number


@dataclass(frozen=True)
class Predicted:
    """Predictions with all that R takes from the state, of one run or of many (leading dimensions …).

    ``values`` m (…, K), ``rates`` ṁ (…, K) of the observable or None where R needs none, ``noise_scale`` σ (…,) or
    None where it is neither estimated nor fixed, ``discrepancy`` (…, 2) amplitude and length of the model's discrepancy
    or None where there is none.
    """

    values: Array
    rates: Array | None = None
    noise_scale: Array | None = None
    discrepancy: Array | None = None

    def __getitem__(self, runs: int | slice | Mask) -> "Predicted":
        return self.each(lambda part: part[runs])

    def among(self, where: Where) -> "Predicted":
        """The same of some of the readings."""
        rates = None if self.rates is None else self.rates[..., where]
        return replace(self, values=self.values[..., where], rates=rates)

    def each(self, of: Callable[[Array], Array]) -> "Predicted":
        """What ``of`` makes of each of the arrays."""
        others = (self.rates, self.noise_scale, self.discrepancy)
        return Predicted(of(self.values), *(None if part is None else of(part) for part in others))

    @property
    def stacked(self) -> Array:
        """(B, Ky) of B runs side by side: m, and as far as they are there ṁ, ln σ, ln of amplitude and length."""
        parts = [self.values]
        if self.rates is not None:
            parts.append(self.rates)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.noise_scale is not None:
                parts.append(np.log(self.noise_scale)[:, None])
            if self.discrepancy is not None:
                parts.append(np.log(self.discrepancy))
        return np.hstack(parts) if len(parts) > 1 else parts[0]

    def unstacked(self, columns: Array) -> "Predicted":
        """The inverse of :attr:`stacked` for columns (…, Ky) of the same make, such as those of an emulator."""
        values, rates, *logs = self.parts(columns)
        return Predicted(values, rates, *(None if log is None else np.exp(np.clip(log, *LOGS)) for log in logs))

    def parts(self, columns: Array) -> tuple[Array, Array | None, Array | None, Array | None]:
        """Which of the columns (…, Ky) of :attr:`stacked` belong to m, ṁ, ln σ (…,), and ln of the discrepancy."""
        k, end = self.values.shape[-1], columns.shape[-1]
        discrepancy = None if self.discrepancy is None else columns[..., end - 2 :]
        end -= 0 if discrepancy is None else 2
        scale = None if self.noise_scale is None else columns[..., end - 1]
        return columns[..., :k], None if self.rates is None else columns[..., k : 2 * k], scale, discrepancy


@dataclass(frozen=True)
class Linearisation:
    """Predictions about one point, ``prediction``, and their anomalies per unit of some N coordinates.

    ``anomalies`` ∂m (N, K), ``rate_anomalies`` ∂ṁ (N, K), ``log_scale_anomalies`` ∂ln σ (N,) and
    ``log_discrepancy_anomalies`` (N, 2) of ln amplitude and ln length, the latter three None where the prediction has
    none. Of weights, row i is the change of the prediction when the control vector moves by the prior anomaly of
    member i.
    """

    prediction: Predicted
    anomalies: Array
    rate_anomalies: Array | None = None
    log_scale_anomalies: Array | None = None
    log_discrepancy_anomalies: Array | None = None

    @classmethod
    def of_stacked(cls, like: Predicted, reference: Array, anomalies: Array) -> "Linearisation":
        """From reference (Ky,) and anomalies (N, Ky) of what :attr:`Predicted.stacked` of ``like`` holds."""
        return cls(like.unstacked(reference), *like.parts(anomalies))

    def among(self, where: Where) -> "Linearisation":
        """The same of some of the readings."""
        rates, prediction = self.rate_anomalies, self.prediction.among(where)
        rates = None if rates is None else rates[:, where]
        return replace(self, prediction=prediction, anomalies=self.anomalies[:, where], rate_anomalies=rates)


@dataclass(frozen=True)
class Noise:
    """Gaussian errors, independent of each other: C = 1, ρ(v) = ½ v².

    ``std`` (K,) > 0 in the observable's unit, ``time_std`` (K,) ≥ 0 of the observation times. Arguments of the methods:
    observed values y (K,), weights β (K,), and predictions (…, K).
    """

    std: Array
    time_std: Array

    scale_information = 2.0  # of ln σ in one observation
    independent = True  # errors are, so that each whitened row belongs to a single reading
    grows_beyond = math.inf  # rate of the observable beyond which a discrepancy grows in proportion to it
    discrepant: ClassVar[bool] = False  # whether amplitude and length of a discrepancy belong to the parameters

    def check(self, weights: Array) -> None:
        """Raise :class:`ValueError` where the errors of K observations with these weights (K,) are not well defined."""
        for key in ("std", "time_std"):
            if isinstance(getattr(self, key), list | tuple):
                raise ValueError(f"{key} is no array; give np.array({key})")
            if np.shape(getattr(self, key)) != weights.shape:
                raise ValueError(f"{key} has shape {np.shape(getattr(self, key))}, not {weights.shape}")
        if not (np.all(self.std > 0) and np.all(self.time_std >= 0)):
            raise ValueError("std must be positive, time_std not negative")

    @property
    def words(self) -> str:
        """The kind of these errors in a summary, behind their std."""
        return ""

    @cached_property
    def timed(self) -> bool:
        """True if any observation carries a timing error."""
        return bool(np.any(self.time_std > 0))

    @property
    def needs_rates(self) -> bool:
        """True if R depends on the rate of the observable."""
        return self.timed

    @property
    def quadratic(self) -> bool:
        """True if J_o is quadratic in the residual, as long as R depends on no state: no robust cost, no bound."""
        return not math.isfinite(self.counts_within)

    @cached_property
    def plain(self) -> bool:
        """True if J_o is ½ Σ β (y − m)²/std² as long as no noise scale is given."""
        return type(self) is Noise and not self.timed

    def error_std(self, predicted: Predicted) -> Array:
        """Total observation-error std s (…, K)."""
        rates, scale = predicted.rates, predicted.noise_scale
        s = self.std if rates is None else np.sqrt(self.std**2 + (rates * self.time_std) ** 2)
        return s if scale is None else np.asarray(s * np.asarray(scale)[..., None])

    def total_std(self, predicted: Predicted) -> Array:
        """Std (…, K) of y − m: that of the errors, with what a discrepancy adds."""
        return self.error_std(predicted)

    def continued(self, values: Array, predicted: Predicted) -> tuple[Array, Array]:
        """Mean and std of the last M of K + M readings, given ``values`` (K,) of the first; one run (K + M,)."""
        rest = slice(len(values), None)
        return predicted.values[rest], self.error_std(predicted)[rest]

    def scaled(self, values: float, times: float) -> "Noise":
        """The same errors of readings that are ``values`` times as large, at times that are ``times`` as long."""
        return replace(self, std=abs(values) * self.std, time_std=abs(times) * self.time_std)

    def frozen(self, predicted: Predicted) -> "Noise":
        """Errors whose std is that at a prediction and depends on no state any more."""
        return replace(self, std=self.error_std(predicted), time_std=np.zeros_like(self.std))

    def whitened_residual(self, values: Array, predicted: Predicted) -> Array:
        """v = R^{-1/2}(y − m) (…, K); with correlated errors v_k holds what is new in y_k."""
        return self._decorrelated((values - predicted.values) / self.error_std(predicted))

    def drawn(self, predicted: Predicted, stream: np.random.Generator) -> Array:
        """Readings (…, K) as they may come of predictions."""
        errors = self._correlated(self._white(stream, predicted.values.shape))
        return np.asarray(predicted.values + self.error_std(predicted) * errors)

    def influence(self, residual: Array) -> Array:
        """ρ'(v)/v (…, K) of whitened residuals, at most 1: how much of a Gaussian observation one counts."""
        return np.ones_like(residual)

    @cached_property
    def expected_curvature(self) -> float | Array:
        """E[ρ''] under the density of ρ: of all readings, or (K,). It is E[ρ'²], which needs no ρ''."""
        whole, squares = np.zeros((2, len(self.std)))
        for v, width in zip(GRID[::4], WIDTHS[::4], strict=True):
            of_each = np.full(len(self.std), v)  # which may differ from reading to reading
            density = np.exp(-self._loss(of_each)) * width
            whole += density
            squares += density * (of_each * self.influence(of_each)) ** 2
        return np.asarray(squares / whole)

    def _curvature(self, light: Array) -> Array:
        """What stands for ρ''(v) (…, K) in SᵀS: its expectation, or ρ'/v of a reading so far off that it counts less.

        Of ρ'/v alone, whose expectation is larger, intervals are too narrow, by 9 % with Huber's ρ.
        """
        return np.minimum(light, self.expected_curvature) if math.isfinite(self.counts_within) else light

    @property
    def counts_within(self) -> float:
        """Standard deviations within which an observation counts in full."""
        return math.inf

    def down_weights(self, values: Array, predicted: Predicted) -> Array | None:
        """:meth:`influence` (K,) at a prediction; None where every observation counts in full in any case."""
        return self._light(values, predicted) if math.isfinite(self.counts_within) else None

    def _light(self, values: Array, predicted: Predicted) -> Array:
        """How much of a Gaussian observation each counts (…, K)."""
        return self.influence(self.whitened_residual(values, predicted))

    def explained(self, values: Array, predicted: Predicted) -> tuple[Array, Array] | None:
        """Mean and std (K,) of the discrepancy given the residual at one prediction; None where there is none."""
        return None

    def squares(self, values: Array, predicted: Predicted) -> Array:
        """v ρ'(v) (…, K): squared residuals, whose expectation is 1 under the density of ρ."""
        v = self.whitened_residual(values, predicted)
        return np.asarray(v * v * self.influence(v))

    def cost(self, values: Array, weights: Array, predicted: Predicted) -> Array:
        """J_o (…,) of predictions; +inf where one is not finite."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            terms = self._loss(self.whitened_residual(values, predicted))
            if predicted.rates is not None or predicted.noise_scale is not None:
                terms = terms + np.log(self.error_std(predicted) / self.std)
            total = np.add.reduce(weights * terms, axis=-1)
        return np.where(np.isfinite(total), total, np.inf)

    def log_likelihood(self, values: Array, predicted: Predicted) -> Array:
        """Normalised log density of each observation (…, K) in its own unit, unweighted (β = 1). With correlated errors
        it is that of an observation given those before it, so that the sum is the joint density.
        """
        v = self.whitened_residual(values, predicted)
        density = -self._loss(v) - np.log(self.error_std(predicted)) - self._log_norm()
        return np.asarray(density - self._log_root())

    def log_conditional(self, values: Array, predicted: Predicted) -> Array | None:
        """Normalised log density (…, K) of each observation given all others; None where the errors have none."""
        return self.log_likelihood(values, predicted)

    def log_normalisation(self, weights: Array) -> float:
        """The excess of −Σ β_k ln p(y_k) over J_o: Σ β_k ln(std_k √2π), with correlated errors + ½ β ln det C."""
        return float(np.sum(weights * (np.log(self.std) + self._log_norm() + self._log_root())))

    def whiten(self, values: Array, weights: Array, at: Linearisation) -> tuple[Array, Array]:
        """Whitened innovation d (K',) and whitened anomalies S (K', N); K' = K, or 2K where s depends on the state."""
        root_weight = np.sqrt(weights)
        s = self.error_std(at.prediction)
        z = (values - at.prediction.values) / s
        v = self._decorrelated(z)
        light = self.influence(v)
        curvature = self._curvature(light)
        row = root_weight * np.sqrt(curvature)
        slope = v if curvature is light else v * light / curvature  # Sᵀd is the gradient in any case
        d, sensitivity = row * slope, self._whitened_anomalies(row, s, at.anomalies)
        log_s = self._log_std_anomalies(at)
        if log_s is None:
            return d, sensitivity
        of_scale, scale_sensitivity = self._scale_rows(root_weight, z, v, log_s)
        return np.concatenate([d, of_scale]), np.concatenate([sensitivity, scale_sensitivity])

    def precision_times(self, values: Array, weights: Array, at: Predicted, vectors: Array) -> Array:
        """β R⁻¹ applied to vectors (…, K), R at the prediction, the influence of each observation included."""
        s = self.error_std(at)
        return np.asarray(vectors * (weights * self.influence((values - at.values) / s) / s**2))

    def whitened_rows(self, values: Array, rows: Array, predicted: Predicted) -> Array:
        """√w L⁻¹ D⁻¹ c (B, M, K) of rows c (M, K), with R and how much readings count, w, of runs (B,)."""
        s, curvature = self.error_std(predicted), self._curvature(self._light(values, predicted))
        return np.asarray(self._decorrelated(rows / s[..., None, :]) * np.sqrt(curvature)[:, None])

    def pulls(self, values: Array, predicted: Predicted) -> Array:
        """How much more the residual of each reading counts than its row does (…, K), so that their product is ρ'."""
        light = self._light(values, predicted)
        curvature = self._curvature(light)
        return np.ones_like(light) if curvature is light else np.asarray(light / curvature)

    def attributes(self) -> dict[str, float]:
        """Numbers that say of which kind the errors are, for the record."""
        return {}

    def matrices(self) -> dict[str, tuple[Array, str]]:
        """Matrices (K, K) that belong to the kind, for the record: name → values and what they are."""
        return {}

    def _white(self, stream: np.random.Generator, shape: tuple[int, ...]) -> Array:
        return stream.standard_normal(shape)

    def _correlated(self, v: Array) -> Array:
        """Lv (…, K)."""
        return np.asarray(v)

    def _decorrelated(self, z: Array) -> Array:
        """L⁻¹z (…, K)."""
        return np.asarray(z)

    def _whitened_anomalies(self, row: Array, s: Array, anomalies: Array) -> Array:
        """diag(row) L⁻¹ ∂m/s (K, N)."""
        return np.asarray((row / s)[:, None] * anomalies.T)

    def _scale_rows(self, root_weight: Array, z: Array, v: Array, log_s: Array) -> tuple[Array, Array]:
        """The rows of d and S that belong to ln s, from anomalies ∂ln s (N, K): its score is v ρ'(v) − 1."""
        root = math.sqrt(self.scale_information)
        of_scale = root_weight * (self.influence(z) * z * z - 1) / root
        return of_scale, root * root_weight[:, None] * log_s.T

    def _log_std_anomalies(self, at: Linearisation) -> Array | None:
        """∂ln s (N, K), or None where s is constant."""
        total, rate = None, at.prediction.rates
        if rate is not None and at.rate_anomalies is not None:
            variance = self.error_std(Predicted(at.prediction.values, rate)) ** 2
            total = (rate * self.time_std**2 / variance) * at.rate_anomalies
        if at.log_scale_anomalies is not None:
            scale = np.broadcast_to(at.log_scale_anomalies[:, None], at.anomalies.shape)
            total = scale if total is None else total + scale
        return None if total is None else np.asarray(total)

    def _loss(self, v: Array) -> Array:
        """ρ (…, K)."""
        return 0.5 * v * v

    def _log_norm(self) -> float:
        """ln ∫ exp(−ρ(v)) dv."""
        return 0.5 * math.log(2 * math.pi)

    def _log_root(self) -> Array | float:
        """ln L_kk (K,)."""
        return 0.0
