"""A series of observation vectors for sequential assimilation, and the whitening of its errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from en4dvar.noise import Correlation
from en4dvar.state import Array


@dataclass(frozen=True)
class CycleSeries:
    """Observations ``values`` (K, p) at increasing ``times`` (K,) > 0 with errors R_k = D_k C D_k, D_k = diag(std_k).

    ``std`` is (p,) or (K, p). ``correlation`` C (p, p), full or block diagonal, is that of the errors of one instant;
    None: independent. Errors of different instants are independent.

    Raises
    ------
    ValueError: shapes that do not fit, times that do not increase from zero, std that is not positive.
    """

    times: Array
    values: Array
    std: Array
    correlation: Correlation | None = None

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.times.shape != self.values.shape[:1]:
            raise ValueError(f"values {self.values.shape} do not match times {self.times.shape}")
        if self.std.shape not in (self.values.shape, self.values.shape[1:]):
            raise ValueError(f"std {self.std.shape} does not match values {self.values.shape}")
        if not (np.all(np.diff(self.times, prepend=0.0) > 0) and np.all(self.std > 0)):
            raise ValueError("times must increase from zero and std must be positive")
        if self.correlation is not None:
            self.correlation.check_size(self.values.shape[1])

    def whiten(self, k: int, reference: Array, anomalies: Array) -> tuple[Array, Array]:
        """d = R_k^{-1/2}(y_k − reference) (p,) and S = R_k^{-1/2} anomaliesᵀ (p, N) of anomalies (N, p)."""
        std = self.std if self.std.ndim == 1 else self.std[k]
        d, s = (self.values[k] - reference) / std, (anomalies / std).T
        return (
            (d, s) if self.correlation is None else (self.correlation.decorrelated(d), self.correlation.decorrelated(s))
        )
