"""The matrix of the general equations: blocks of fields that meet only in a border.

It is extended by the sums over the nodes (:mod:`general`), unknowns without a rate: rows and columns are the fields τ,
Y and θ_m, then the border, which begins with the sums. τ, Y and θ_m fill blocks of their own, Y's rows also the columns
of τ, and all else is zero but for the border. Elimination in this order fills nothing in.
"""

from functools import cache

import numba as nb
import numpy as np

from en4dvar_bubble.solver import rows
from en4dvar_bubble.solver.arrays import Dims, IntArray
from en4dvar_bubble.solver.general import sums
from en4dvar_bubble.solver.tiles import kept_tiles, whole


@nb.njit
def begins(dims):
    """Where the rows of Y, of θ_m and of the border begin: each with a tile of its own."""
    vapour = whole(dims.gas)
    medium = vapour + whole(dims.vapour)
    return vapour, medium, medium + whole(dims.medium)


def pattern(dims: Dims) -> np.ndarray:
    """(size, size): where the extended matrix and its factors may differ from zero."""
    gas, vapour = dims.gas, dims.gas + dims.vapour
    fields, kept = vapour + dims.medium, sums.py_func(dims)
    size = fields + kept + dims.wall + dims.kinetic + dims.memory + 2
    full = np.zeros((size, size), dtype=bool)
    full[:gas, :gas] = full[gas:vapour, :vapour] = full[vapour:fields, vapour:fields] = True
    full[:vapour, fields:] = full[vapour:fields, fields + kept :] = full[fields:, fields:] = True
    reach = {rows.SLOPE_SUM: (0, gas), rows.CONTENT_SUM: (0, vapour), rows.VAPOUR_SUM: (gas, vapour)}
    for row in range(kept):
        full[fields + row, slice(*reach[row])] = True
    if dims.wall:
        full[fields + kept, vapour:fields] = True
    return full


def places(dims: Dims) -> IntArray:
    """The place of each row of the :func:`pattern` among whole tiles."""
    border = sums.py_func(dims) + dims.wall + dims.kinetic + dims.memory + 2
    counts = dims.gas, dims.vapour, dims.medium, border
    first = 0, *begins.py_func(dims)
    return np.concatenate([np.arange(begin, begin + count) for begin, count in zip(first, counts, strict=True)])


@cache
def tiles(dims: Dims) -> tuple[IntArray, IntArray]:
    """``where`` of the matrix and the places of the unknowns that have a rate, see :mod:`tiles`."""
    every, fields = places(dims), dims.gas + dims.vapour + dims.medium
    with_rate = np.delete(every, np.arange(fields, fields + sums.py_func(dims)))
    return kept_tiles(pattern(dims), every), with_rate
