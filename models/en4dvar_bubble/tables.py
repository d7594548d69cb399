"""Smooth functions of one variable as piecewise quintics, so that one compiled kernel serves every law and every pulse.

Of samples on a uniform grid with four extra points at either end, derivatives at the nodes are eighth-order central
differences, and each cell is the quintic Hermite polynomial of value, slope and curvature. A cell takes eight doubles
(six coefficients, one cache line). In tables of sharp laws (:mod:`laws.exactness`) a cell may be halved, and its halves
again: the seventh number is how many times narrower a cell is than those of the grid (zero where none is halved), the
eighth the place of its left half, which its right half follows.
"""

import math
from dataclasses import dataclass

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import called, kernel

HALO = 4

_FIRST = np.array([4 / 5, -1 / 5, 4 / 105, -1 / 280])
_SECOND = np.array([8 / 5, -1 / 5, 8 / 315, -1 / 560])
_SECOND_CENTRE = -205 / 72

# Places in a cell, from 0 to 1, through whose values a polynomial is laid: with both ends, and without.
LOBATTO = 0.5 - 0.5 * np.cos(np.pi * np.arange(6) / 5)
GAUSS = (np.polynomial.legendre.leggauss(5)[0] + 1) / 2


def to_coefficients(places: Array) -> Array:
    """What values (…, n) at ``places`` (n,) of a cell are multiplied by from the right: coefficients, lowest first."""
    return np.asarray(np.linalg.inv(np.vander(places, increasing=True)).T)


@dataclass(frozen=True)
class Grid:
    """``cells`` cells of width ``step`` from ``origin``; ``nodes`` includes the halo."""

    origin: float
    step: float
    cells: int

    @property
    def nodes(self) -> Array:
        return self.origin + self.step * np.arange(-HALO, self.cells + 1 + HALO, dtype=np.float64)

    def within(self, places: Array) -> Array:
        """Numbers (cells, n) at ``places`` (n,) of every cell."""
        return self.origin + self.step * (np.arange(self.cells)[:, None] + places)

    @property
    def span(self) -> Array:
        """(first, last, cells per unit, cells, 0 times halved): what the kernel needs to look up a value."""
        return np.array([self.origin, self.origin + self.step * self.cells, 1.0 / self.step, float(self.cells), 0.0])


@kernel
def from_values(samples: Array) -> Array:
    """Coefficients (N, cells, 8) from samples (N, cells + 1 + 2·HALO) of the function."""
    out = np.empty((len(samples), samples.shape[1] - 1 - 2 * HALO, 8))
    for i in range(len(samples)):
        fill_one(samples, i, 1.0, out, i)
    return out


@called
def fill_one(samples, member, factor, out, at):
    """Write those of ``factor`` times one member's row of samples to ``out[at]``."""
    cells = samples.shape[1] - 1 - 2 * HALO
    a = da = dda = 0.0
    for j in range(cells + 1):
        here = j + HALO
        b = factor * samples[member, here]
        db = 0.0
        ddb = _SECOND_CENTRE * b
        for r in range(HALO):
            right, left = samples[member, here + r + 1], samples[member, here - r - 1]
            db += factor * _FIRST[r] * (right - left)
            ddb += factor * _SECOND[r] * (right + left)
        if j > 0:
            cell = out[at, j - 1]
            rise, turn, curl = b - a - da - 0.5 * dda, db - da - dda, ddb - dda
            cell[0], cell[1], cell[2] = a, da, 0.5 * dda
            cell[3] = 10.0 * rise - 4.0 * turn + 0.5 * curl
            cell[4] = -15.0 * rise + 7.0 * turn - curl
            cell[5] = 6.0 * rise - 3.0 * turn + 0.5 * curl
            cell[6] = cell[7] = 0.0
        a, da, dda = b, db, ddb


@kernel
def evaluate(table, span, x):
    """Values (N, K) of the tables (N, cells, 8), halved cells after the others, at ``x`` (N, K); NaN where it is."""
    n, k = x.shape
    out = np.empty((n, k))
    for i in range(n):
        for q in range(k):
            if not math.isfinite(x[i, q]):
                out[i, q] = np.nan
                continue
            position = (x[i, q] - span[0]) * span[2]
            cell = int(min(max(np.floor(position), 0.0), span[3] - 1.0))
            s = position - cell
            while table[i, cell, 7] > 0:
                right = int(s >= 0.5)
                cell = int(table[i, cell, 7]) + right
                s = 2 * s - right
            value = 0.0
            for power in range(5, -1, -1):
                value = value * s + table[i, cell, power]
            out[i, q] = value
    return out
