"""Which readings to take: the most informative few of many candidates, by adding one at a time and then exchanging.

The expected information by :mod:`en4dvar.estimation.design.planned` grows by each reading's own rows of S alone,
so that one set of runs at all candidates tells it for every choice. To add the best one at a time comes
within 1 − 1/e of the best choice where the information is submodular (Krause & Guestrin 2005, UAI), as it is of
independent readings about everything; exchanges then end in a choice that no single exchange improves.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from en4dvar.estimation.design.planned import Planned, require_alive
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError

SWEEPS = 10
WORTH = 1e-9  # nats: an exchange that gains less is none
Indices = npt.NDArray[np.intp]


def choose(planned: Planned, u: Array, count: int, apart: float = 0.0) -> Indices:
    """The ``count`` readings that tell most, each ``apart`` from the others in time, from draws (R, n) of the prior.

    Raises
    ------
    ConfigError: errors that are correlated; no such choice is possible. TooFewMembersError: the model mostly fails.
    """
    observations = planned.problem.observations
    if not observations.noise.independent:
        raise ConfigError("readings can be chosen where their errors are independent of each other")
    tangents = planned.tangents(u)
    require_alive(len(tangents.at), len(u))
    _, rows = tangents.whitened(planned)
    search = _Search(rows.reshape(len(rows), -1, len(observations), rows.shape[2]), planned.asked)
    near = np.abs(np.subtract.outer(observations.times, observations.times)) < apart * (1 - 1e-9)
    np.fill_diagonal(near, True)
    chosen: list[int] = []
    for _ in range(count):
        order = np.argsort(-search.gains(), kind="stable").tolist()
        possible = (k for k in order if not near[chosen, k].any() and _room(near, [*chosen, k]) >= count)
        best = next(possible, None)
        if best is None:
            raise ConfigError(f"no {count} of {len(observations)} readings lie so far apart from each other")
        chosen.append(best)
        search.add(best, 1)
    for _ in range(SWEEPS):
        moved = False
        for place, reading in enumerate(chosen):
            search.add(reading, -1)
            others = [k for k in chosen if k != reading]
            gains = np.where(near[others].any(axis=0), -np.inf, search.gains())
            better = int(np.argmax(gains))
            if gains[better] > gains[reading] + WORTH:
                chosen[place], moved = better, True
            search.add(chosen[place], 1)
        if not moved:
            break
    return np.sort(np.array(chosen, dtype=np.intp))


class _Search:
    """Information of a growing set of readings, from their rows (R, B, K, n): B of each reading, of R draws."""

    def __init__(self, rows: Array, asked: int):
        self.rows, self.others = rows.transpose(0, 2, 1, 3), rows.transpose(0, 2, 1, 3)[..., asked:]
        self.precision = np.tile(np.eye(rows.shape[-1]), (len(rows), 1, 1))
        self.asked = asked

    def add(self, k: int, sign: int) -> None:
        """Reading k, or take it away."""
        own = self.rows[:, k]
        self.precision = self.precision + sign * np.einsum("rbi,rbj->rij", own, own)

    def gains(self) -> Array:
        """(K,) mean information, nats, that each reading would add."""
        a = self.asked
        return _added(self.rows, self.precision) - _added(self.others, self.precision[:, a:, a:])


def _room(near: npt.NDArray[np.bool_], chosen: list[int]) -> int:
    """How many readings can be chosen in all beside these, the earliest that is free each time."""
    blocked, count = np.asarray(near[chosen].any(axis=0)), len(chosen)
    for k in range(len(blocked)):
        if not blocked[k]:
            blocked, count = blocked | near[k], count + 1
    return count


def _added(rows: Array, precision: Array) -> Array:
    """(K,) mean ½ ln det(I + s M⁻¹ sᵀ) of rows s (R, K, B, n)."""
    if not rows.shape[-1]:
        return np.zeros(rows.shape[1])
    half = np.einsum("rkbi,rij->rkbj", rows, np.linalg.inv(precision))
    inner = np.eye(rows.shape[2]) + np.einsum("rkbj,rkcj->rkbc", half, rows)
    return np.asarray(0.5 * np.linalg.slogdet(inner)[1].mean(axis=0))
