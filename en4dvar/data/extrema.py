"""Local extrema of readings that stand out by a share of their range, so that noise makes none."""

import numpy as np

from en4dvar.model.state import Array

HOLE = 4.0  # median steps: a longer one is a hole
FEWEST = 4  # readings through which a line or a parabola is laid


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


def with_unseen(times: Array, values: Array) -> tuple[Array, Array]:
    """The series ``times`` (K,), ``values`` (K,) with one more sample in each hole that hides a minimum.

    It does where the samples before fall, along a line that would end below the first sample behind, which no fall that
    gets steeper does; and where those behind fall from a top inside the hole, as no fall that gets flatter does. The
    sample in its middle is where the line ends, or at the lowest of all.
    """
    t, y = times, values
    steps = np.diff(times)
    for last in np.flatnonzero(steps > HOLE * np.median(steps))[::-1] if len(steps) else ():
        behind, after = values[last + 1 :], times[last + 1 :] - times[last + 1]
        count = int(np.argmax(np.append(behind, -np.inf) < 0.5 * (behind[0] + behind.min())))
        before = slice(max(last + 1 - FEWEST, 0), last + 1)
        if last + 1 < FEWEST or count < FEWEST or values[last] > values[before].min():
            continue
        end = float(np.polyval(np.polyfit(times[before], values[before], 1), times[last + 1]))
        bend, slope, _ = np.polyfit(after[:count], behind[:count], 2)
        if end < behind[0] and bend < 0 and -steps[last] < -0.5 * slope / bend < 0:
            t = np.insert(t, last + 1, times[last] + 0.5 * steps[last])
            y = np.insert(y, last + 1, max(end, float(values.min())))
    return t, y
