"""A straight line in time, linear in its parameters: what is expected of data on it has a closed form."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from en4dvar import Field
from en4dvar_lorenz.autonomous import Autonomous, dimensionless


def advance(start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
    """States (x, level, slope) (N, 3) at times (N, K) → (N, K, 3), in closed form; there is no step to choose."""
    paths = np.repeat(start[:, None], times.shape[1], axis=1)
    paths[..., 0] += start[:, 2:] * times
    return paths


class Trend(Autonomous):
    """x = level + slope t."""

    parameters = (
        dimensionless("level", "value at time zero", "$x_0$", ""),
        dimensionless("slope", "change per unit of time", "$s$", ""),
    )
    integrate = staticmethod(advance)

    def __init__(self) -> None:
        super().__init__((Field("x"),), [0.0], np.inf)

    def initial_state(self, theta: Mapping[str, float]) -> np.ndarray:
        return np.array([theta["level"], theta["level"], theta["slope"]])
