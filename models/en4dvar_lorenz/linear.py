r"""Linear models: a straight line in time, and uncoupled damped oscillators, \(\dot z_j = (iω_j − γ) z_j\) with
\(ω_j = j\), solved exactly.

What is expected of data on the line has a closed form. The state of the oscillators is (Re z_1, Im z_1, Re z_2, …);
with Gaussian errors the Kalman filter and smoother are exact here.
"""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import Field as Setting

from en4dvar import Field
from en4dvar_lorenz.autonomous import Autonomous, Settings, dimensionless


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


class LinearSettings(Settings):
    """Size of the linear model."""

    oscillators: Annotated[int, Setting(ge=1)] = 4
    """Number of oscillators; at time zero all have z = 1."""


def oscillate(start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
    """States (N, n) at times (N, K) → (N, K, n), in closed form; there is no step to choose."""
    z = np.ascontiguousarray(start[:, :-1]).view(complex)
    rates = 1j * np.arange(1, z.shape[1] + 1) - start[:, -1:]
    paths = z[:, None] * np.exp(rates[:, None] * times[:, :, None])
    constant = np.broadcast_to(start[:, None, -1:], (*times.shape, 1))
    return np.concatenate([paths.view(float), constant], axis=-1)


class Linear(Autonomous):
    """Oscillators with a common damping rate."""

    Settings = LinearSettings
    parameters = (dimensionless("gamma", "damping rate", r"$\gamma$", ""),)
    defaults: Mapping[str, float] = {"gamma": 0.0}
    integrate = staticmethod(oscillate)

    @classmethod
    def from_settings(cls, settings: LinearSettings) -> "Linear":
        return cls((Field("x", 2 * settings.oscillators),), [1.0, 0.0] * settings.oscillators, np.inf)
