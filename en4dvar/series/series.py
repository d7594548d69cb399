"""A series of observation vectors for sequential assimilation, and the whitening of its errors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from en4dvar.data.noise import Correlation
from en4dvar.model.state import Array


@dataclass(frozen=True)
class CycleSeries:
    """Observations ``values`` (K, p) at increasing ``times`` (K,) ≥ 0 with errors R_k = D_k C D_k, D_k = diag(std_k).

    NaN among the values is no observation. ``std`` is (p,) or (K, p). ``correlation`` C (p, p), full or block diagonal,
    is that of the errors of one instant; None: independent. Errors of different instants are independent. ``names``
    (p,) are those of what was observed, for the record.

    Raises
    ------
    ValueError: shapes that do not fit, times that do not increase from zero, std that is not positive.
    """

    times: Array
    values: Array
    std: Array
    correlation: Correlation | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.times.shape != self.values.shape[:1]:
            raise ValueError(f"values {self.values.shape} do not match times {self.times.shape}")
        if self.std.shape not in (self.values.shape, self.values.shape[1:]):
            raise ValueError(f"std {self.std.shape} does not match values {self.values.shape}")
        if not (np.all(np.diff(self.times) > 0) and np.all(self.times[:1] >= 0) and np.all(self.std > 0)):
            raise ValueError("times must increase from zero and std must be positive")
        if self.correlation is not None:
            self.correlation.check_size(self.values.shape[1])

    def whiten(self, k: int, reference: Array, anomalies: Array) -> tuple[Array, Array]:
        """d = R_k^{-1/2}(y_k − reference) (p,) and S = R_k^{-1/2} anomaliesᵀ (p, N) of anomalies (N, p).

        Rows of what was not observed are zero.
        """
        std = self.std if self.std.ndim == 1 else self.std[k]
        d, s = (self.values[k] - reference) / std, (anomalies / std).T
        there = self._there[k]
        if there.all():
            return (d, s) if self.correlation is None else (
                self.correlation.decorrelated(d), self.correlation.decorrelated(s.T).T
            )  # fmt: skip
        whitened = np.zeros_like(d), np.zeros_like(s)
        if there.any():
            among = None if self.correlation is None else Correlation(self.correlation.matrix[np.ix_(there, there)])
            for whole, part in zip(whitened, (d[there], s[there]), strict=True):
                whole[there] = part if among is None else among.decorrelated(part.T).T
        return whitened

    @cached_property
    def _there(self) -> npt.NDArray[np.bool_]:
        return np.isfinite(self.values)
