r"""Lotka–Volterra: prey \(\dot u = αu − βuv\), predators \(\dot v = −γv + δuv\), with the populations at time zero.

Sources: Lotka (1925), Elements of Physical Biology; Volterra (1926), Nature 118, 558.
"""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numba import njit
from pydantic import Field as Setting

from en4dvar import Field, Observable, Parameter, StateField, StateLayout
from en4dvar_lorenz.autonomous import Analytic, Logarithm, Settings
from en4dvar_lorenz.rk4 import kept, rk4

SOURCE = "Lotka (1925), Volterra (1926)"


class LotkaVolterraSettings(Settings):
    """Integration of Lotka–Volterra."""

    step: Annotated[float, Setting(gt=0)] = 0.02
    """Longest integration step."""


@njit
def tendency(x: np.ndarray, dx: np.ndarray) -> None:
    prey, predator = x[0], x[1]
    dx[0] = (x[2] - x[3] * predator) * prey
    dx[1] = (x[5] * prey - x[4]) * predator
    dx[2] = dx[3] = dx[4] = dx[5] = 0.0


@kept
def integrate(start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
    return rk4(tendency, start, times, longest)


def _positive(name: str, label: str, symbol: str) -> Parameter:
    return Parameter(name, "1", "lognormal", (0.0, np.inf), label, symbol, source=SOURCE)


class LotkaVolterra(Analytic):
    """Prey and predators, in units of your own (of number and of time), and the logarithms of both."""

    Settings = LotkaVolterraSettings
    parameters = (
        _positive("alpha", "growth rate of the prey", r"$\alpha$"),
        _positive("beta", "prey taken by a predator", r"$\beta$"),
        _positive("gamma", "death rate of the predators", r"$\gamma$"),
        _positive("delta", "growth of the predators by prey", r"$\delta$"),
        _positive("prey_0", "prey at time zero", "$u_0$"),
        _positive("predator_0", "predators at time zero", "$v_0$"),
    )
    layout = StateLayout(tuple(map(Field, ("prey", "predator", "alpha", "beta", "gamma", "delta"))))
    observables = (
        Observable("prey", "1", StateField("prey"), "$u$", positive=True),
        Observable("predator", "1", StateField("predator"), "$v$", positive=True),
        Observable("ln_prey", "1", Logarithm("prey"), r"$\ln u$", label="log prey"),
        Observable("ln_predator", "1", Logarithm("predator"), r"$\ln v$", label="log predators"),
    )
    path_parameters = ("alpha", "beta", "gamma", "delta")
    integrate = staticmethod(integrate)

    def __init__(self, step: float):
        self.longest_step = step

    @classmethod
    def from_settings(cls, settings: LotkaVolterraSettings) -> "LotkaVolterra":
        return cls(settings.step)

    def initial_state(self, theta: Mapping[str, float]) -> np.ndarray:
        return self.layout.pack({**theta, "prey": theta["prey_0"], "predator": theta["predator_0"]})
