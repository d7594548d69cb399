"""Observations (y, t, R) of one data set and the Gaussian error model that turns predictions into a cost.

The error of observation k is ``s_k² = std_k² + (ẏ_k · time_std_k)²``: a measured value and, where given, the instant it
was measured at. With ``time_std`` the variance depends on the state through the rate ẏ, so the normalisation ``ln s_k`` belongs
to the cost and the Gauss–Newton step is Fisher scoring (see :mod:`en4dvar.likelihood`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

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

    def __post_init__(self) -> None:
        k = len(self.times)
        for key in ("values", "std", "time_std", "weights"):
            if np.shape(getattr(self, key)) != (k,):
                raise DataError(f"{self.source or self.name}: {key} has shape {np.shape(getattr(self, key))}, not ({k},)")
        if k < 3:
            raise DataError(f"{self.source or self.name}: {k} usable observations in the window; at least 3 are needed")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise DataError(f"{self.source or self.name}: observations must be finite")
        if not np.all(np.diff(self.times) > 0):
            where = int(np.flatnonzero(np.diff(self.times) <= 0)[0])
            raise DataError(
                f"{self.source or self.name}: times must increase; {self.times[where]:g} is followed by {self.times[where + 1]:g}"
            )
        if not (np.all(self.std > 0) and np.all(self.time_std >= 0) and np.all(self.weights >= 0)):
            raise DataError(f"{self.source or self.name}: std must be positive, time_std and weights not negative")

    def __len__(self) -> int:
        return len(self.times)
