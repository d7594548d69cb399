"""NRMSE between readings and their nearest neighbours on simulation traces, over data sets and time shifts.

    NRMSE = 1 − ‖y − ŷ‖ / ‖y − ȳ‖        (Mancia et al. 2021, section "IMR Approach")

ŷ_i is the trace at the instant of its time grid nearest to t_i + t_s. Shifts are multiples of the grid's step, so a
shift moves every index by the same number.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from en4dvar.data.observations import Observations
from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel


@dataclass(frozen=True)
class Targets:
    """Readings of S data sets on one time grid.

    ``grid`` (M,) s; ``values`` and ``nearest`` (sum K,) readings and indices of the grid without shift; readings of
    set s are ``offsets[s]:offsets[s+1]``; ``scale`` (S,) ‖y − ȳ‖²; ``reach``: the shifts are −reach…reach steps.
    """

    grid: Array
    step: float
    values: Array
    nearest: np.ndarray
    offsets: np.ndarray
    scale: Array
    reach: int


def targets(observations: Sequence[Observations], shift: float, step: float, earliest: float = -np.inf) -> Targets:
    """The grid covers every reading at every shift within ±``shift`` (s), from ``earliest`` on.

    Raises
    ------
    ValueError: a reading would be compared before ``earliest``.
    """
    reach = int(np.floor(shift / step * (1 + 1e-9)))
    first = min(float(o.times[0]) for o in observations) - reach * step
    if first < earliest:
        raise ValueError(f"a reading shifted by {-reach * step:g} s would lie {earliest - first:g} s before the start")
    last = max(float(o.times[-1]) for o in observations) + reach * step
    grid = first + step * np.arange(int(np.ceil((last - first) / step * (1 - 1e-9))) + 1)
    values = np.concatenate([o.values for o in observations])
    nearest = np.concatenate([np.rint((o.times - first) / step).astype(np.int64) for o in observations])
    offsets = np.concatenate([[0], np.cumsum([len(o) for o in observations])])
    scale = np.array([np.sum((o.values - o.values.mean()) ** 2) for o in observations])
    return Targets(np.asarray(grid, dtype=float), step, values, nearest, offsets, scale, reach)


def best_over_shifts(traces: Array, aims: Targets) -> tuple[Array, Array]:
    """Largest NRMSE (B, S) over the shifts of traces (B, M), and that shift (B, S) in s; −inf where a trace is NaN."""
    shape = (len(traces), len(aims.scale))
    squares, steps = np.empty(shape), np.empty(shape, dtype=np.int64)
    _least_squares(np.ascontiguousarray(traces), aims.values, aims.nearest, aims.offsets, aims.reach, squares, steps)
    return np.asarray(1 - np.sqrt(squares / aims.scale)), np.asarray(steps * aims.step)


@kernel
def _least_squares(
    traces: Array,
    values: Array,
    nearest: npt.NDArray[np.int64],
    offsets: npt.NDArray[np.int64],
    reach: int,
    squares: Array,
    steps: npt.NDArray[np.int64],
) -> None:
    last = traces.shape[1] - 1
    for b in range(traces.shape[0]):
        trace = traces[b]
        alive = True
        for m in range(trace.size):
            alive &= np.isfinite(trace[m])
        for s in range(offsets.size - 1):
            squares[b, s] = np.inf
            steps[b, s] = 0
            if not alive:
                continue
            for k in range(2 * reach + 1):
                # from no shift outwards: of equal fits the smallest shift is kept
                move = (k + 1) // 2 if k % 2 else -(k // 2)
                total = 0.0
                for i in range(offsets[s], offsets[s + 1]):
                    at = min(max(nearest[i] + move, 0), last)
                    difference = values[i] - trace[at]
                    total += difference * difference
                    if total >= squares[b, s]:
                        break
                if total < squares[b, s]:
                    squares[b, s] = total
                    steps[b, s] = move
