"""Parts of a block of numbers, a column per lane, for kernels: each a run of rows."""

from __future__ import annotations

import operator
from itertools import pairwise
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from en4dvar_bubble.solver.lanes import TRIED_FIRST, WIDTH

_I64 = ir.IntType(64)


class Rows(types.Type):
    """Rows of :data:`WIDTH` numbers: where they begin and how many, 2 words where an array takes 9. The compiler moves
    every field of the named groups at every call and every access to one of them: with arrays it takes twice as long.
    """

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype
        super().__init__(name=f"rows({dtype})")


@register_model(Rows)
class _RowsModel(models.StructModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, [("data", types.CPointer(fe_type.dtype)), ("count", types.intp)])


@intrinsic(prefer_literal=True)
def parted(typingctx, block, edges, count):
    """The first ``count`` parts of a C-contiguous (rows, 8) array, which must outlive them; part i is the rows
    ``edges[i] … edges[i+1]−1``.
    """

    def codegen(context, builder, sig, args):
        data, at = (
            cgutils.create_struct_proxy(kind)(context, builder, value=value).data
            for kind, value in zip(sig.args[:2], args[:2], strict=True)
        )
        parts = []
        ends = [builder.load(builder.gep(at, [ir.Constant(_I64, i)])) for i in range(len(sig.return_type) + 1)]
        for first, end in pairwise(ends):
            part = cgutils.create_struct_proxy(sig.return_type.dtype)(context, builder)
            part.data = builder.gep(data, [builder.mul(first, ir.Constant(_I64, WIDTH))])
            part.count = builder.sub(end, first)
            parts.append(part._getvalue())
        return context.make_tuple(builder, sig.return_type, parts)

    return types.UniTuple(Rows(block.dtype), count.literal_value)(block, edges, count), codegen


@infer_global(len)
class _Count(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(types.intp, *args) if isinstance(args[0], Rows) else None


@lower_builtin(len, Rows)
def _lower_count(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.extract_value(args[0], 1)


def _element(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Where ``of[i]``, the ``i``-th number, or ``of[row, lane]`` is."""
    place = args[1]
    if isinstance(sig.args[1], types.BaseTuple):
        row, lane = cgutils.unpack_tuple(builder, place)
        place = builder.add(builder.mul(row, ir.Constant(_I64, WIDTH)), lane)
    return builder.gep(builder.extract_value(args[0], 0), [place])


@infer_global(operator.getitem)
class _Read(AbstractTemplate):
    metadata = TRIED_FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        return signature(args[0].dtype, args[0], _place(args[1])) if isinstance(args[0], Rows) else None


@infer_global(operator.setitem)
class _Write(AbstractTemplate):
    metadata = TRIED_FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        if isinstance(args[0], Rows):
            return signature(types.none, args[0], _place(args[1]), args[0].dtype)
        return None


def _place(index: Any) -> Any:
    return types.UniTuple(types.int64, 2) if isinstance(index, types.BaseTuple) else types.int64


@lower_builtin(operator.getitem, Rows, types.Any)
def _lower_read(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.load(_element(context, builder, sig, args))


@lower_builtin(operator.setitem, Rows, types.Any, types.Any)
def _lower_write(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[2], _element(context, builder, sig, args))
    return context.get_dummy_value()
