"""The compiled models, integrated once over a short time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from en4dvar_lorenz.lorenz63 import Lorenz63, Lorenz63Settings
from en4dvar_lorenz.lorenz96 import Lorenz96, Lorenz96Settings
from en4dvar_lorenz.lotka_volterra import LotkaVolterra, LotkaVolterraSettings

Model = Lorenz63 | Lorenz96 | LotkaVolterra


def examples() -> dict[str, Callable[[], object]]:
    """What is compiled, in words, and a call that does; for ``en4dvar warm-up``."""
    return {
        "Lorenz-63": partial(_integrate, Lorenz63.from_settings(Lorenz63Settings())),
        "Lorenz-96": partial(_integrate, Lorenz96.from_settings(Lorenz96Settings())),
        "Lotka-Volterra": partial(_integrate, LotkaVolterra.from_settings(LotkaVolterraSettings())),
    }


def _integrate(model: Model) -> None:
    start = model.initial_state({p.name: 1.0 for p in model.parameters})
    model.trajectories(start[None], np.array([0.1]))
