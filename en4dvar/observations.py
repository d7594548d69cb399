"""Observations (y, t, R) of one data set.

The error of observation k is ``s_k² = std_k² + (ẏ_k · time_std_k)²``: a measured value and, where given, the instant
it was measured at. With ``time_std`` the variance depends on the state through the rate ẏ, so the normalisation
``ln s_k`` belongs to the cost and the Gauss–Newton step is Fisher scoring (see :mod:`en4dvar.noise`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from en4dvar.caution import Caution
from en4dvar.errors import DataError
from en4dvar.noise import Linearisation, Noise, Predicted
from en4dvar.prior import LARGEST
from en4dvar.state import Array


@dataclass(frozen=True)
class Observations:
    """One data set.

    Attributes
    ----------
    times: (K,) strictly increasing, in the model's time unit (seconds for the bubble), from the model's time zero.
    values: (K,) finite, in the observable's unit.
    noise: the observation errors (:func:`en4dvar.noise.noise_of` makes them of std, timing error and correlation).
    weights: (K,) β_k ≥ 0; 1 counts an observation fully (``weights: sum``), 1/K is ``weights: mean``.
    name: of the data set. source: where it was read from (for the record).
    scalars: further numbers found beside the series (e.g. an equilibrium radius), as read, no units applied.
    doubts: what makes the times of the file implausible.

    Raises
    ------
    DataError: shapes do not fit, fewer than 3 observations, or one of the above does not hold.
    """

    times: Array
    values: Array
    noise: Noise
    weights: Array
    name: str = "data"
    source: str = ""
    scalars: Mapping[str, float] = field(default_factory=dict)
    doubts: tuple[Caution, ...] = ()

    def __post_init__(self) -> None:
        where, k = self.source or self.name, len(self.times)
        for key in ("values", "weights"):
            if np.shape(getattr(self, key)) != (k,):
                raise DataError(f"{where}: {key} has shape {np.shape(getattr(self, key))}, not ({k},)")
        if k < 3:
            raise DataError(f"{where}: {k} usable observations in the window; at least 3 are needed")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise DataError(f"{where}: observations must be finite")
        largest = float(np.max(np.abs([self.times, self.values])))
        if not largest < LARGEST:
            raise DataError(f"{where}: {largest:g} among the observations; is the unit right? (less than {LARGEST:g})")
        if not np.all(np.diff(self.times) > 0):
            at = int(np.flatnonzero(np.diff(self.times) <= 0)[0])
            raise DataError(f"{where}: times must increase; {self.times[at]:g} is followed by {self.times[at + 1]:g}")
        if not np.all(self.weights >= 0):
            raise DataError(f"{where}: weights must not be negative")
        try:
            self.noise.check(self.weights)
        except ValueError as error:
            raise DataError(f"{where}: {error}") from None
        smallest, std = float(self.std.min()), float(self.std.max())
        if not (std < LARGEST and largest < LARGEST * smallest and smallest * LARGEST > 1):
            raise DataError(
                f"{where}: an error std of {smallest if std < LARGEST else std:g} beside observations up to "
                f"{largest:g}: their ratio is too large; is the unit right?"
            )

    @property
    def std(self) -> Array:
        """(K,) error std of the readings alone."""
        return self.noise.std

    @cached_property
    def used(self) -> npt.NDArray[np.intp]:
        """Which have a weight β > 0."""
        return np.flatnonzero(self.weights > 0)

    def cost(self, predicted: Predicted) -> Array:
        """J_o (…,) of predictions (…, K); +inf where one is not finite."""
        return self.noise.cost(self.values, self.weights, predicted)

    def log_likelihood(self, predicted: Predicted) -> Array:
        """Normalised log density of each observation (…, K) in its own unit, unweighted."""
        return self.noise.log_likelihood(self.values, predicted)

    def log_conditional(self, predicted: Predicted) -> Array | None:
        """Log density of each observation given all others (…, K), unweighted; None where the errors have none."""
        return self.noise.log_conditional(self.values, predicted)

    def log_normalisation(self) -> float:
        """What −Σ β_k ln p(y_k) exceeds J_o by."""
        return self.noise.log_normalisation(self.weights)

    def whiten(self, at: Linearisation) -> tuple[Array, Array]:
        """Whitened innovation d (K',) and whitened anomalies S (K', N); see :meth:`en4dvar.noise.Noise.whiten`."""
        return self.noise.whiten(self.values, self.weights, at)

    def precision_times(self, at: Predicted, vectors: Array) -> Array:
        """β R⁻¹ applied to vectors (…, K), R at a prediction."""
        return self.noise.precision_times(self.values, self.weights, at, vectors)

    def chi2_per_observation(self, predicted: Predicted) -> Array:
        """(y − m)ᵀR⁻¹(y − m) per observation with β > 0 (…,), for predictions (…, K); NaN where there is none.

        With a robust cost each square is v ρ'(v), whose expectation under the density of ρ is 1 as well.
        """
        squares = self.noise.squares(self.values, predicted).take(self.used, axis=-1)
        return np.asarray(np.add.reduce(squares, axis=-1) / (len(self.used) or np.nan))

    def __len__(self) -> int:
        return len(self.times)
