"""The classical Runge–Kutta method of fourth order, compiled, members one after the other."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from en4dvar.plumbing.compiled import F, kernel, stamp_with_sources


def kept(function: F) -> F:
    """``function``, which may call :func:`rk4`, compiled and kept on disk until a file of this folder changes."""
    compiled = kernel(function)
    stamp_with_sources(compiled, Path(__file__).parent)
    return compiled


@njit(inline="always")  # a function that hands another one on, compiled for itself, numba does not keep on disk
def rk4(
    tendency: Callable[[np.ndarray, np.ndarray], None], start: np.ndarray, times: np.ndarray, longest: float
) -> np.ndarray:
    """Paths (N, K, n) of states (N, n) at increasing times (N, K), from time zero to either side.

    ``tendency(x, dx)``, an njit function, writes dx/dt of one state into ``dx``. Every interval is cut into equal steps
    no longer than ``longest``.
    """
    n, kind = start.shape[1], start.dtype  # complex for derivatives
    paths = np.empty((start.shape[0], times.shape[1], n), kind)
    x, at, slope, total = np.empty(n, kind), np.empty(n, kind), np.empty(n, kind), np.empty(n, kind)
    for i in range(start.shape[0]):
        for j in range(n):
            x[j] = start[i, j]
        t = 0.0
        for k in range(times.shape[1]):
            steps = int(np.ceil(abs(times[i, k] - t) / longest - 1e-9))
            h = (times[i, k] - t) / max(steps, 1)
            for _ in range(steps):
                tendency(x, slope)
                for j in range(n):
                    total[j] = slope[j]
                    at[j] = x[j] + h / 2 * slope[j]
                for stage in range(1, 4):
                    tendency(at, slope)
                    ahead = h if stage == 2 else h / 2
                    weight = 1.0 if stage == 3 else 2.0
                    for j in range(n):
                        total[j] += weight * slope[j]
                        at[j] = x[j] + ahead * slope[j]
                for j in range(n):
                    x[j] += h / 6 * total[j]
            t = times[i, k]
            for j in range(n):
                paths[i, k, j] = x[j]
    return paths
