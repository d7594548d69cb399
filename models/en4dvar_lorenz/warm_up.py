"""The compiled test-beds, each integrated over one interval."""

from collections.abc import Callable
from functools import partial

import numpy as np

from en4dvar_lorenz import lorenz63, lorenz96, lotka_volterra

MODULES = {"Lorenz-63": lorenz63, "Lorenz-96": lorenz96, "Lotka–Volterra": lotka_volterra}


def examples() -> dict[str, Callable[[], object]]:
    """Name of each kernel, in words, and a call that compiles it; for ``en4dvar warm-up``."""
    start, times = np.ones((1, 6)), np.array([[0.01]])
    return {
        f"test-bed, {name}{of}": partial(module.integrate, kind(start), times, 0.01)
        for name, module in MODULES.items()
        for of, kind in (("", np.real), (": derivatives", np.complex128))
    }
