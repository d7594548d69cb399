"""Linear algebra of the general equations: blocks of fields that meet only in a border.

The matrix is extended by the sums over the nodes (:mod:`general`), unknowns without a rate: rows and columns are the
fields τ, Y and θ_m, then the border, which begins with the sums. τ, Y and θ_m fill blocks of their own, Y's rows also
the columns of τ, and all else is zero but for the border. ``eq.spans`` says so row by row and column by column;
elimination in this order fills nothing in.
"""

from __future__ import annotations

from functools import cache

import numba as nb
import numpy as np

from en4dvar_bubble.solver import rodas5p
from en4dvar_bubble.solver.arrays import Dims, IntArray
from en4dvar_bubble.solver.general import CONTENT_SUM, SLOPE_SUM, VAPOUR_SUM, sums
from en4dvar_bubble.solver.lanes import load, store

# Columns of ``spans``: two runs (first … last−1) each of the row left and right of the diagonal, of the column
# below and above it.
LEFT, RIGHT, BELOW, ABOVE = 0, 4, 8, 12


def pattern(dims: Dims) -> np.ndarray:
    """(size, size): where the extended matrix and its factors may differ from zero."""
    gas, vapour = dims.gas, dims.gas + dims.vapour
    fields, kept = vapour + dims.medium, sums(dims)
    size = fields + kept + dims.wall + dims.memory + 2
    full = np.zeros((size, size), dtype=bool)
    full[:gas, :gas] = full[gas:vapour, :vapour] = full[vapour:fields, vapour:fields] = True
    full[:vapour, fields:] = full[vapour:fields, fields + kept :] = full[fields:, fields:] = True
    reach = {SLOPE_SUM: (0, gas), CONTENT_SUM: (0, vapour), VAPOUR_SUM: (gas, vapour)}
    for row in range(kept):
        full[fields + row, slice(*reach[row])] = True
    if dims.wall:
        full[fields + kept, vapour:fields] = True
    return full


@cache
def spans(dims: Dims) -> IntArray:
    """(size, 16) of each row and column of the :func:`pattern`: :data:`LEFT`, :data:`RIGHT`, :data:`BELOW`,
    :data:`ABOVE`.
    """
    full = pattern(dims)
    table = []
    for i in range(len(full)):
        sides = (full[i, :i], 0), (full[i, i + 1 :], i + 1), (full[i + 1 :, i], i + 1), (full[:i, i], 0)
        table.append([edge for line, begin in sides for edge in _runs(line, begin)])
    return np.array(table)


def _runs(line: np.ndarray, begin: int) -> list[int]:
    """First and last (and one) of the two runs of true at most in a line whose first place is ``begin``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(int))) + begin
    return [*edges, *[begin] * (4 - len(edges))]


@nb.njit(forceinline=True)
def _subtract(a, own, k, table):
    """Row k, times the factor that makes the element below its diagonal zero, from the row that begins at ``own`` in
    ``a``; the factor takes the element's place.
    """
    row = k * len(table)
    factor = load(a, own + k) * load(a, row + k)
    store(a, own + k, factor)
    for part in range(RIGHT, BELOW, 2):
        for j in range(table[k, part], table[k, part + 1]):
            store(a, own + j, load(a, own + j) - factor * load(a, row + j))


@nb.njit(forceinline=True)
def _subtract_two(a, own, k, table):
    """The same with rows k and k+1 of one block at once, which halves what is read and written."""
    row, following = k * len(table), (k + 1) * len(table)
    factor = load(a, own + k) * load(a, row + k)
    other = (load(a, own + k + 1) - factor * load(a, row + k + 1)) * load(a, following + k + 1)
    store(a, own + k, factor)
    store(a, own + k + 1, other)
    for part in range(RIGHT, BELOW, 2):
        for j in range(max(table[k, part], k + 2), table[k, part + 1]):
            store(a, own + j, load(a, own + j) - factor * load(a, row + j) - other * load(a, following + j))


@nb.njit
def arrow_factors(h, eq, w):
    """LU without pivoting, in place, of what ``jac`` holds plus 1/(hγ) on the diagonal of the unknowns with a rate and
    1 on that of the sums; the diagonal is replaced by its inverse.
    """
    a, table = w.jac, eq.spans
    size, kept = len(table), sums(eq.dims)
    fields = size - len(w.border)
    algebraic = fields + kept if eq.dims.wall else -1
    inverse_h = 1.0 / load(h, 0) * (1.0 / rodas5p.GAMMA)
    for i in range(size):
        own = i * size
        if fields <= i < fields + kept:
            store(a, own + i, load(a, own + i) + 1.0)
        elif i != algebraic:
            store(a, own + i, load(a, own + i) + inverse_h)
        for part in range(LEFT, RIGHT, 2):
            k, last = table[i, part], table[i, part + 1]
            while k < last:
                if k + 1 < last and table[k, RIGHT] == k + 1:
                    _subtract_two(a, own, k, table)
                    k += 2
                else:
                    _subtract(a, own, k, table)
                    k += 1
        store(a, own + i, 1.0 / load(a, own + i))


@nb.njit(forceinline=True)
def _column(a, j, x, value, first, last, size):
    """``value`` times some rows of a column from ``x``."""
    for i in range(first, last):
        store(x, i, load(x, i) - load(a, i * size + j) * value)


@nb.njit
def arrow_solve(eq, w, row):
    """Solve in place for the right-hand side in rows ``row … row+n−1`` of ``k``, column by column: the differences of a
    column do not wait for each other.
    """
    a, b, table, x = w.jac, w.k, eq.spans, w.extended
    size, kept = len(table), sums(eq.dims)
    fields = size - len(w.border)
    for i in range(fields):
        store(x, i, load(b, row + i))
    for i in range(fields, fields + kept):
        store(x, i, 0.0)
    for i in range(fields + kept, size):
        store(x, i, load(b, row + i - kept))
    for j in range(size):
        for part in range(BELOW, ABOVE, 2):
            _column(a, j, x, load(x, j), table[j, part], table[j, part + 1], size)
    for j in range(size - 1, -1, -1):
        value = load(x, j) * load(a, j * size + j)
        store(x, j, value)
        for part in range(ABOVE, ABOVE + 4, 2):
            _column(a, j, x, value, table[j, part], table[j, part + 1], size)
    for i in range(fields):
        store(b, row + i, load(x, i))
    for i in range(fields + kept, size):
        store(b, row + i - kept, load(x, i))
