"""Linear algebra of matrices of lanes, tile by tile: the 4 × 4 elements of a tile fit the registers, so that a number
that is read serves four multiply–adds, and four of these at a time do not wait for each other.

A tile is 16 rows of 8 lanes, column by column. ``where`` (T, T) tells as which tile a part of the matrix is kept, −1
where it is zero; the tiles of one row follow each other. An unknown has its place among the 4 T rows of the matrix;
rows that no unknown has are those of unity.
"""

from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, register_jitable

from en4dvar.plumbing.compiled import called
from en4dvar_bubble.solver import rodas5p
from en4dvar_bubble.solver.lanes import Value, lanes, load, row_pointer, splat, store

EDGE = 4
AREA = EDGE * EDGE


def kept_tiles(pattern: np.ndarray, places: np.ndarray) -> np.ndarray:
    """``where`` for a matrix that is not zero where ``pattern`` (n, n) says, of unknowns at ``places`` (n,)."""
    tiles = places // EDGE
    kept = np.zeros((tiles[-1] + 1, tiles[-1] + 1), dtype=bool)
    np.logical_or.at(kept, (tiles[:, None], tiles[None, :]), pattern)
    return np.where(kept, np.cumsum(kept).reshape(kept.shape) - 1, -1)


@register_jitable  # for Python, which makes the arrays, a function like any other
def whole(count):
    """``count`` rounded up to whole tiles."""
    return (count + EDGE - 1) // EDGE * EDGE


@nb.njit
def place(where, i, j):
    """The row where element (i, j) is kept; the next element of a row is kept :data:`EDGE` rows further."""
    return where[i // EDGE, j // EDGE] * AREA + j % EDGE * EDGE + i % EDGE


class _Numbers:
    """Rows of an array from ``first`` on, each read when it is asked for and once."""

    def __init__(self, context: Any, builder: Any, kind: Any, array: Any, first: Any) -> None:
        self.context, self.builder, self.kind, self.array, self.first = context, builder, kind, array, first
        self.loaded: dict[int, Value] = {}

    def __getitem__(self, i: int) -> Value:
        if i not in self.loaded:
            row = self.builder.add(self.first, ir.Constant(self.first.type, i))
            pointer = row_pointer(self.context, self.builder, self.kind, self.array, row)
            self.loaded[i] = Value(self.builder, self.builder.load(pointer, align=8))
        return self.loaded[i]


def _of_registers(body: Callable[[list[Value], _Numbers, _Numbers], list[Value]]) -> Any:
    """A function of numbers in registers, rows of ``a`` from ``i`` and of ``b`` from ``j`` on, unrolled by Python."""

    @intrinsic
    def operation(typingctx, numbers, a, i, b, j):
        def codegen(context, builder, sig, args):
            kinds = sig.args
            mine = [Value(builder, value) for value in cgutils.unpack_tuple(builder, args[0])]
            own = _Numbers(context, builder, kinds[1], args[1], args[2])
            other = _Numbers(context, builder, kinds[3], args[3], args[4])
            return context.make_tuple(builder, sig.return_type, [v.value for v in body(mine, own, other)])

        return numbers(numbers, a, types.int64, b, types.int64), codegen

    return operation


def _loading(count: int) -> Any:
    @intrinsic
    def operation(typingctx, a, i):
        def codegen(context, builder, sig, args):
            numbers = _Numbers(context, builder, sig.args[0], args[0], args[1])
            return context.make_tuple(builder, sig.return_type, [numbers[k].value for k in range(count)])

        return types.UniTuple(lanes, count)(a, types.int64), codegen

    return operation


_tile, _part = _loading(AREA), _loading(EDGE)


@intrinsic
def _keep(typingctx, a, i, numbers):
    """Write numbers in registers to rows ``i …`` of ``a``."""

    def codegen(context, builder, sig, args):
        for k, value in enumerate(cgutils.unpack_tuple(builder, args[2])):
            row = builder.add(args[1], ir.Constant(args[1].type, k))
            builder.store(value, row_pointer(context, builder, sig.args[0], args[0], row), align=8)
        return context.get_dummy_value()

    return types.void(a, types.int64, numbers), codegen


@_of_registers
def _minus_product(columns, left, up):
    """Of a tile, or of a part of a right-hand side, which is one column."""
    for k in range(EDGE):
        for i in range(len(columns)):
            columns[i] -= left[k * EDGE + i % EDGE] * up[i // EDGE * EDGE + k]
    return columns


@_of_registers
def _times(tile, right, _):
    return [
        sum((tile[k * EDGE + r] * right[c * EDGE + k] for k in range(1, EDGE)), tile[r] * right[c * EDGE])
        for c in range(EDGE)
        for r in range(EDGE)
    ]


@_of_registers
def _inverse(tile, _, __):
    """By elimination without pivoting."""
    for k in range(EDGE):
        pivot = tile[k * EDGE + k] = tile[k * EDGE + k].inverse()
        others = [i for i in range(EDGE) if i != k]
        for c in others:
            tile[c * EDGE + k] *= pivot
            for r in others:
                tile[c * EDGE + r] -= tile[k * EDGE + r] * tile[c * EDGE + k]
        for r in others:
            tile[k * EDGE + r] = -(tile[k * EDGE + r] * pivot)
    return tile


@_of_registers
def _of_part(part, tile, _):
    return [sum((tile[k * EDGE + r] * part[k] for k in range(1, EDGE)), tile[r] * part[0]) for r in range(EDGE)]


@called
def factorise(a, h, where, places, algebraic):
    """LU without pivoting, in place, of the matrix ``a`` plus 1/(hγ) on the diagonal of the unknowns but numbers
    ``algebraic`` (first, last + 1), and 1 where no unknown is. The lower factor has tiles of unity on its diagonal; on
    that of the upper one there are the inverses of its tiles.
    """
    inverse_h = 1.0 / load(h, 0) * (1.0 / rodas5p.GAMMA)
    unknown = 0
    for i in range(len(where) * EDGE):
        added = splat(1.0)
        if unknown < len(places) and places[unknown] == i:
            added = splat(0.0) if algebraic[0] <= unknown < algebraic[1] else inverse_h
            unknown += 1
        at = place(where, i, i)
        store(a, at, load(a, at) + added)
    for i in range(len(where)):
        for j in range(len(where)):
            own = where[i, j] * AREA
            if own < 0:
                continue
            tile = _tile(a, own)
            for k in range(min(i, j)):
                left, up = where[i, k] * AREA, where[k, j] * AREA
                if left >= 0 and up >= 0:
                    tile = _minus_product(tile, a, left, a, up)
            if i == j:
                tile = _inverse(tile, a, own, a, own)
            elif i > j:
                tile = _times(tile, a, where[j, j] * AREA, a, own)
            _keep(a, own, tile)


@called
def _rest(a, where, x, i, first, last):
    """Part ``i`` of ``x`` without what parts ``first … last−1`` say of it."""
    part = _part(x, i * EDGE)
    for j in range(first, last):
        if where[i, j] >= 0:
            part = _minus_product(part, a, where[i, j] * AREA, x, j * EDGE)
    return part


@called
def solve(a, where, places, x, b, row):
    """Solve in place for the right-hand side of the unknowns in rows ``row …`` of ``b``; ``x`` is scratch."""
    size = len(where)
    for i in range(size * EDGE):
        store(x, i, 0.0)
    for i in range(len(places)):
        store(x, places[i], load(b, row + i))
    for i in range(1, size):
        _keep(x, i * EDGE, _rest(a, where, x, i, 0, i))
    for i in range(size - 1, -1, -1):
        own = where[i, i] * AREA
        _keep(x, i * EDGE, _of_part(_rest(a, where, x, i, i + 1, size), a, own, a, own))
    for i in range(len(places)):
        store(b, row + i, load(x, places[i]))
