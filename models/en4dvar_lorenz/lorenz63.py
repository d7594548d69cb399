r"""Lorenz-63: \(\dot x = σ(y − x),\; \dot y = ρx − y − xz,\; \dot z = xy − βz\).

Source: Lorenz (1963), J. Atmos. Sci. 20, 130.
"""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numba import njit
from pydantic import Field as Setting

from en4dvar import Field
from en4dvar_lorenz.autonomous import Analytic, Settings, dimensionless
from en4dvar_lorenz.rk4 import kept, rk4

SOURCE = "Lorenz (1963)"


class Lorenz63Settings(Settings):
    """Start and integration of Lorenz-63."""

    initial: tuple[float, float, float] = (1.509, -1.531, 25.46)
    """State at time zero."""
    step: Annotated[float, Setting(gt=0)] = 0.01
    """Longest integration step."""


@njit
def tendency(x: np.ndarray, dx: np.ndarray) -> None:
    dx[0] = x[3] * (x[1] - x[0])
    dx[1] = x[0] * (x[4] - x[2]) - x[1]
    dx[2] = x[0] * x[1] - x[5] * x[2]
    dx[3] = dx[4] = dx[5] = 0.0


@kept
def integrate(start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
    return rk4(tendency, start, times, longest)


class Lorenz63(Analytic):
    """Three variables, chaotic at the default parameters."""

    dense = False  # other instants are other steps, of which chaos makes another path
    Settings = Lorenz63Settings
    parameters = (
        dimensionless("sigma", "Prandtl number", r"$\sigma$", SOURCE),
        dimensionless("rho", "relative Rayleigh number", r"$\rho$", SOURCE),
        dimensionless("beta", "aspect parameter", r"$\beta$", SOURCE),
    )
    defaults: Mapping[str, float] = {"sigma": 10.0, "rho": 28.0, "beta": 8 / 3}
    integrate = staticmethod(integrate)

    @classmethod
    def from_settings(cls, settings: Lorenz63Settings) -> "Lorenz63":
        return cls((Field("x"), Field("y"), Field("z")), settings.initial, settings.step)
