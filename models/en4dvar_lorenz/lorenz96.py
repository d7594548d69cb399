r"""Lorenz-96: \(\dot x_i = (x_{i+1} − x_{i−2}) x_{i−1} − x_i + F\) on a circle.

Source: Lorenz (1996), Predictability: a problem partly solved, Proc. ECMWF Seminar.
"""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numba import njit
from pydantic import Field as Setting

from en4dvar import Field
from en4dvar_lorenz.autonomous import Analytic, Settings, dimensionless
from en4dvar_lorenz.rk4 import kept, rk4


class Lorenz96Settings(Settings):
    """Size and integration of Lorenz-96."""

    size: Annotated[int, Setting(ge=4)] = 40
    """Number of variables; at time zero the first is 1, the others are 0."""
    step: Annotated[float, Setting(gt=0)] = 0.05
    """Longest integration step."""


@njit
def tendency(x: np.ndarray, dx: np.ndarray) -> None:
    n, forcing = len(x) - 1, x[-1]
    second, last, here = x[n - 2], x[n - 1], x[0]  # x_{i−2}, x_{i−1}, x_i of the circle
    for i in range(n):
        following = x[i + 1] if i < n - 1 else x[0]
        dx[i] = (following - second) * last - here + forcing
        second, last, here = last, here, following
    dx[n] = 0.0


@kept
def integrate(start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
    return rk4(tendency, start, times, longest)


class Lorenz96(Analytic):
    """A field on a circle of latitude, chaotic at the default forcing."""

    dense = False  # as of Lorenz-63
    Settings = Lorenz96Settings
    parameters = (dimensionless("F", "forcing", "$F$", "Lorenz (1996)"),)
    defaults: Mapping[str, float] = {"F": 8.0}
    integrate = staticmethod(integrate)

    @classmethod
    def from_settings(cls, settings: Lorenz96Settings) -> "Lorenz96":
        return cls((Field("x", settings.size),), np.eye(settings.size)[0], settings.step)
