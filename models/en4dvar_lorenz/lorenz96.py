r"""Lorenz-96: \(\dot x_i = (x_{i+1} − x_{i−2}) x_{i−1} − x_i + F\) on a circle.

Source: Lorenz (1996), Predictability: a problem partly solved, Proc. ECMWF Seminar.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from numba import njit
from pydantic import BaseModel, ConfigDict
from pydantic import Field as Setting

from en4dvar import Field
from en4dvar_lorenz.autonomous import Autonomous, dimensionless
from en4dvar_lorenz.rk4 import rk4


class Lorenz96Settings(BaseModel):
    """``size``: number of variables; at time zero the first is 1, the others 0. ``step``: longest integration step."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    size: Annotated[int, Setting(ge=4)] = 40
    step: Annotated[float, Setting(gt=0)] = 0.05


@njit
def tendency(x: np.ndarray, dx: np.ndarray) -> None:
    n = x.shape[0] - 1
    f = x[n]
    dx[0] = (x[1] - x[n - 2]) * x[n - 1] - x[0] + f
    dx[1] = (x[2] - x[n - 1]) * x[0] - x[1] + f
    for i in range(2, n - 1):
        dx[i] = (x[i + 1] - x[i - 2]) * x[i - 1] - x[i] + f
    dx[n - 1] = (x[0] - x[n - 3]) * x[n - 2] - x[n - 1] + f
    dx[n] = 0.0


class Lorenz96(Autonomous):
    """A field on a circle of latitude, chaotic at the default forcing."""

    Settings = Lorenz96Settings
    parameters = (dimensionless("F", "forcing", "$F$", "Lorenz (1996)"),)
    defaults: ClassVar[Mapping[str, float]] = {"F": 8.0}
    integrate = staticmethod(rk4(tendency))

    @classmethod
    def from_settings(cls, settings: Lorenz96Settings) -> Lorenz96:
        return cls((Field("x", settings.size),), np.eye(settings.size)[0], settings.step)
