"""Several flashes in one exposure: which of the nested circles of a frame belongs to which flash."""

from collections.abc import Sequence
from itertools import pairwise, permutations

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.units import UnitError, parse_quantity

MOST = 5


def parse_flashes(text: str) -> tuple[float, ...]:
    """``"0 us, 2 us, 4 us"`` as instants after that of the frame, s. Raises :class:`UnitError`."""
    instants = tuple(parse_quantity(part, "s") for part in text.split(","))
    if len(instants) > MOST:
        raise UnitError(f"{len(instants)} flashes in an exposure; at most {MOST} can be told apart")
    if any(b <= a for a, b in pairwise(instants)):
        raise UnitError(f"flashes {text!r}: give their instants in the order of time")
    return instants


def in_time(radii: Sequence[Array], times: Array, flashes: Sequence[float]) -> list[tuple[int, ...]]:
    """Which circle belongs to each flash (S,), for each of K frames: the order in which the wall's speed changes least.

    All flashes are alike in a picture, so only the history tells: of all orders of the circles of each frame, those are
    chosen whose ∫ (d²R/dt²)² dt is least over all frames at once, as of a spline (dynamic programming over the orders
    of two frames that follow each other).

    ``radii``: of each frame, the circles' radii (S,), the largest first; times: (K,) instants of the frames, s.
    """
    orders = list(permutations(range(len(flashes))))
    if len(orders) == 1 or not radii:
        return [orders[0]] * len(radii)
    offsets = np.array(flashes)
    ordered = [np.array([r[list(order)] for order in orders]) for r in radii]  # (S!, S) of each frame
    cost = _bend(ordered[0], offsets + times[0])
    came: list[Array] = []
    before, now = np.indices((len(orders), len(orders)))
    for k in range(1, len(radii)):
        # of each pair of orders, the last two readings of the frame before and those of this one
        joined = np.concatenate([ordered[k - 1][before, -2:], ordered[k][now]], axis=2)
        instants = np.concatenate([offsets[-2:] + times[k - 1], offsets + times[k]])
        total = cost[:, None] + _bend(joined, instants)
        came.append(np.argmin(total, axis=0))
        cost = total.min(axis=0)
    best = [int(np.argmin(cost))]
    for back in reversed(came):
        best.append(int(back[best[-1]]))
    return [orders[b] for b in reversed(best)]


def _bend(radii: Array, instants: Array) -> Array:
    """Σ (change of speed)² / time along the last axis of radii (…, n) at instants (n,)."""
    steps = np.diff(instants)
    speeds = np.diff(radii, axis=-1) / steps
    return np.asarray((np.diff(speeds, axis=-1) ** 2 / (steps[1:] + steps[:-1])).sum(axis=-1))
