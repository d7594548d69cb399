"""Observations (y, t, R) of one data set and the Gaussian error model that turns predictions into a cost.

The error of observation k is ``s_k² = std_k² + (ẏ_k · time_std_k)²``: a measured value and, where given, the instant
it was measured at. With ``time_std`` the variance depends on the state through the rate ẏ, so the normalisation
``ln s_k`` belongs to the cost and the Gauss–Newton step is Fisher scoring (see :mod:`en4dvar.likelihood`). With
``correlation`` C the covariance is R = D C D, D = diag(s): block or full.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from en4dvar.errors import DataError
from en4dvar.state import Array


@dataclass(frozen=True)
class Observations:
    """One data set.

    Attributes
    ----------
    times: (K,) strictly increasing, in the model's time unit (seconds for the bubble), from the model's time zero.
    values: (K,) finite, in the observable's unit.
    std: (K,) observation-error standard deviation, > 0.
    time_std: (K,) standard deviation of the observation times, ≥ 0.
    weights: (K,) β_k ≥ 0; 1 counts an observation fully (``weights: sum``), 1/K is ``weights: mean``.
    name: of the data set. source: where it was read from (for the record).
    correlation: (K, K) of the errors, symmetric, positive definite, ones on the diagonal; None: independent.
    huber: threshold c > 0 of the robust cost in standard deviations; None: Gaussian errors.
    scalars: further numbers found beside the series (e.g. an equilibrium radius), as read, no units applied.
    """

    times: Array
    values: Array
    std: Array
    time_std: Array
    weights: Array
    name: str = "data"
    source: str = ""
    scalars: Mapping[str, float] = field(default_factory=dict)
    correlation: Array | None = None
    huber: float | None = None

    def __post_init__(self) -> None:
        k = len(self.times)
        for key in ("values", "std", "time_std", "weights"):
            if np.shape(getattr(self, key)) != (k,):
                raise DataError(
                    f"{self.source or self.name}: {key} has shape {np.shape(getattr(self, key))}, not ({k},)"
                )
        if k < 3:
            raise DataError(f"{self.source or self.name}: {k} usable observations in the window; at least 3 are needed")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise DataError(f"{self.source or self.name}: observations must be finite")
        if not np.all(np.diff(self.times) > 0):
            where = int(np.flatnonzero(np.diff(self.times) <= 0)[0])
            a, b = self.times[where], self.times[where + 1]
            raise DataError(f"{self.source or self.name}: times must increase; {a:g} is followed by {b:g}")
        if not (np.all(self.std > 0) and np.all(self.time_std >= 0) and np.all(self.weights >= 0)):
            raise DataError(f"{self.source or self.name}: std must be positive, time_std and weights not negative")
        if self.huber is not None and not self.huber > 0:
            raise DataError(f"{self.source or self.name}: the threshold of the robust cost must be positive")
        if self.correlation is not None:
            self._check_correlation(self.correlation)

    def _check_correlation(self, c: Array) -> None:
        where, k = self.source or self.name, len(self)
        if np.shape(c) != (k, k):
            raise DataError(f"{where}: correlation has shape {np.shape(c)}, not ({k}, {k})")
        if not (np.all(np.isfinite(c)) and np.array_equal(c, c.T) and np.allclose(np.diag(c), 1, rtol=0, atol=1e-12)):
            raise DataError(
                f"{where}: the correlation of the observation errors must be symmetric with a unit diagonal"
            )
        if np.ptp(self.weights) > 0:
            raise DataError(f"{where}: correlated observation errors need one weight for all observations")
        if self.huber is not None:
            raise DataError(f"{where}: a robust cost needs independent observation errors")
        try:
            np.linalg.cholesky(c)
        except np.linalg.LinAlgError:
            raise DataError(f"{where}: the covariance of the observation errors is not positive definite") from None

    @cached_property
    def timed(self) -> bool:
        """Whether any observation carries a timing error."""
        return bool(np.any(self.time_std > 0))

    @cached_property
    def used(self) -> npt.NDArray[np.intp]:
        """Which have a weight β > 0."""
        return np.flatnonzero(self.weights > 0)

    @cached_property
    def root_weights(self) -> Array:
        """√β (K,)."""
        return np.sqrt(self.weights)

    @cached_property
    def whitening(self) -> Array:
        """L⁻¹ (K, K), lower triangular, with C = L Lᵀ; the identity for independent errors."""
        if self.correlation is None:
            return np.eye(len(self))
        root = np.linalg.cholesky(self.correlation)
        return np.asarray(np.tril(np.linalg.solve(root, np.eye(len(self)))))

    @cached_property
    def scale_root(self) -> Array:
        """B (K, K), lower triangular, with B Bᵀ = I + C∘C⁻¹, the Fisher information of ln s."""
        c = np.eye(len(self)) if self.correlation is None else self.correlation
        return np.asarray(np.linalg.cholesky(np.eye(len(self)) + c * (self.whitening.T @ self.whitening)))

    def __len__(self) -> int:
        return len(self.times)
