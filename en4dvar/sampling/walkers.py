"""Moves of an ensemble of walkers about others that stand still, on a density that is cheap to evaluate."""

from collections.abc import Callable
from typing import Any

import numpy as np

from en4dvar.model.state import Array

STRETCHES = 0.3  # share of the moves, the others are differential evolution
LEAPS = 0.1  # share of the latter of length 1, which takes walkers from one mode to another
JITTER = 2e-5  # of the spread, the most
MOVES = 5  # of one half of the walkers while the other stands still


def advance(
    cost: Callable[[Array], Array], x: Array, costs: Array, others: Array, random: Any, moves: int
) -> tuple[Array, Array]:
    """Walkers (W, n) of cost (W,) after so many Metropolis moves on exp(−cost), and their costs.

    Every move is reversible with respect to exp(−cost) given ``others`` (W', n), and so are they together.
    ``random`` is numpy's Generator or RandomState. Sources: ter Braak (2006), Stat.
    Comput. 16, 239; Goodman & Weare (2010), Commun. Appl. Math. Comput. Sci. 5, 65.
    """
    count, n = x.shape
    x, costs, others = x.T.copy(), costs.copy(), others.T.copy()  # coordinates in rows: long inner loops
    spread = others.std(axis=1)[:, None, None]
    uniform = random.random((6, moves, count))
    jitter = JITTER * spread * (2 * random.random((n, moves, count)) - 1)
    n_others = others.shape[1]
    first = (uniform[0] * n_others).astype(int)
    second = (first + 1 + (uniform[1] * (n_others - 1)).astype(int)) % n_others
    length = np.where(uniform[2] < LEAPS, 1.0, 2.38 / np.sqrt(2 * n))
    stretched = uniform[3] < STRETCHES
    stretch = 0.5 * (1 + uniform[4]) ** 2  # density ∝ 1/√s on [½, 2]
    threshold = np.log1p(-uniform[5]) - np.where(stretched, (n - 1) * np.log(stretch), 0.0)
    # either is affine in x, so that everything but x is known beforehand: x + leap, or anchor + stretch (x − anchor)
    anchor = others.take(first, axis=1)
    leap = length * (anchor - others.take(second, axis=1)) + jitter
    factor = np.where(stretched, stretch, 1.0)
    offset = np.where(stretched, (1 - factor) * anchor, leap)
    for move in range(moves):
        proposed = factor[move] * x + offset[:, move]
        new = cost(proposed.T)
        accepted = threshold[move] < costs - new
        np.copyto(x, proposed, where=accepted)
        np.copyto(costs, new, where=accepted)
    return np.ascontiguousarray(x.T), costs


def walked(cost: Callable[[Array], Array], start: Array, random: Any, rounds: int, left_out: int) -> Array:
    """Positions (D, n) on exp(−cost) of walkers from ``start`` (W, n), two halves that move in turn.

    Those of the first ``left_out`` rounds are left out.
    """
    halves, kept = list(start.reshape(2, len(start) // 2, -1)), list[Array]()
    of_each = [cost(part) for part in halves]
    for number in range(rounds):
        for i in (0, 1):
            halves[i], of_each[i] = advance(cost, halves[i], of_each[i], halves[1 - i], random, MOVES)
        kept += halves if number >= left_out else []
    return np.concatenate(kept)
