"""The classical Runge–Kutta method of fourth order, compiled, members one after the other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit


def rk4(tendency: Callable[[np.ndarray, np.ndarray], None]) -> Callable[..., np.ndarray]:
    """Compile an integrator of ``tendency(x, dx)``, an njit function that writes dx/dt of one state into ``dx``.

    The integrator takes states (N, n), increasing times (N, K) from zero and the longest step; every interval is cut
    into equal steps no longer than that. It returns (N, K, n).
    """

    @njit(nogil=True, fastmath={"contract", "nsz", "arcp"})
    def integrate(start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
        n = start.shape[1]
        paths = np.empty((start.shape[0], times.shape[1], n))
        a, b, c, d, x, y = (np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n))
        for i in range(start.shape[0]):
            x[:] = start[i]
            t = 0.0
            for k in range(times.shape[1]):
                steps = int(np.ceil((times[i, k] - t) / longest - 1e-9))
                h = (times[i, k] - t) / max(steps, 1)
                for _ in range(steps):
                    tendency(x, a)
                    for j in range(n):
                        y[j] = x[j] + h / 2 * a[j]
                    tendency(y, b)
                    for j in range(n):
                        y[j] = x[j] + h / 2 * b[j]
                    tendency(y, c)
                    for j in range(n):
                        y[j] = x[j] + h * c[j]
                    tendency(y, d)
                    for j in range(n):
                        x[j] += h / 6 * (a[j] + 2 * b[j] + 2 * c[j] + d[j])
                t = times[i, k]
                paths[i, k] = x
        return paths

    return integrate
