"""The compiled loops of this package, each used once."""

from collections.abc import Callable

import numpy as np

from en4dvar.data.noise import noise_of
from en4dvar.data.noise.state_space import boxed, innovations
from en4dvar.data.observations import Observations
from en4dvar.sampling.sweep import best_over_shifts, targets


def examples() -> dict[str, Callable[[], object]]:
    """Name of each kernel, in words, and a call that compiles it; for ``en4dvar warm-up``."""
    return {"sweep, nearest neighbours": _nearest, "discrepancy": _discrepancy}


def _discrepancy() -> None:
    unit = np.ones((1, 3))
    innovations(unit, unit, unit, np.ones(1), np.ones(2), 1.5)
    boxed(unit, unit, unit, unit, np.ones(1), np.ones(2), 1.5, 1.0)


def _nearest() -> None:
    times = np.linspace(0.0, 1.0, 5)
    aims = targets([Observations(times, times, noise_of(np.ones(5)), np.ones(5))], shift=0.1, step=0.05)
    best_over_shifts(np.zeros((1, len(aims.grid))), aims)
