"""Local extrema of readings that stand out by a share of their range, so that noise makes none."""

import numpy as np

from en4dvar.model.state import Array


def maxima(values: Array, prominence: float = 0.1) -> Array:
    """Indices of the local maxima of ``values`` (K,) behind their first minimum, of this prominence."""
    first, tops = minima(values, prominence)[:1], minima(-values, prominence)
    return tops[tops > first] if len(first) else first


def minima(values: Array, prominence: float = 0.1) -> Array:
    """Indices of the local minima of ``values`` (K,) with at least ``prominence`` times its range."""
    from scipy.signal import find_peaks

    if len(values) < 3:
        return np.empty(0, dtype=int)
    indices, _ = find_peaks(-values, prominence=prominence * np.ptp(values))
    return np.asarray(indices)
