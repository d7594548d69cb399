"""Eight members at once: ``<8 x double>`` as a numba value, so that a kernel reads like scalar code and runs as SIMD.

A value of type ``lanes`` holds one number for each of :data:`WIDTH` members; arithmetic, comparison and ``sqrt`` act
lane by lane, so what one member computes never depends on its neighbours (same bits in any lane, group or chunk).
Rows of a C-contiguous ``(rows, 8)`` array, or of a part of one (:class:`Rows`), are read and written with :func:`load`
and :func:`store`. Multiply–adds may be fused.
"""

import math
import operator
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from en4dvar.plumbing.compiled import inlined
from en4dvar_bubble.solver import rows

WIDTH = 8

_F64 = ir.DoubleType()
_I64 = ir.IntType(64)
_VEC = ir.VectorType(_F64, WIDTH)
_MASK = ir.VectorType(ir.IntType(1), WIDTH)
_IVEC = ir.VectorType(_I64, WIDTH)
_CONTRACT = ("contract",)
TRIED_FIRST = {"target": "cpu"}  # of the meanings of an operator: numba asks those for any target, a dozen, after these


class _Vector(types.Type):
    """A value for each lane."""


lanes, mask = _Vector("f64x8"), _Vector("i1x8")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VEC if fe_type == lanes else _MASK)


def _splat(builder: Any, value: Any) -> Any:
    if value.type == _VEC:
        return value
    first = builder.insert_element(ir.Constant(_VEC, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, ir.Constant(_VEC, ir.Undefined), zeros)


_PAIRS = (lanes, lanes), (lanes, types.float64), (types.float64, lanes)


def _kind(value: Any) -> Any:
    """The type of lanes, or of a number for all of them."""
    return lanes if value is lanes else types.float64


def _operator(op: Any, result: Any, emit: Callable[..., Any], operands: Sequence[tuple[Any, ...]] = _PAIRS) -> None:
    """Let ``op`` of two lanes, or of lanes and a number for all of them, be what ``emit`` builds."""

    @infer_global(op)
    class _Template(ConcreteTemplate):
        metadata = TRIED_FIRST
        cases = [signature(result, *kinds) for kinds in operands]  # noqa: RUF012  # numba reads it as a list

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *(_splat(builder, x) for x in args))

    for kinds in operands:
        lower_builtin(op, *kinds)(lower)


_ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
for _op, _name in _ARITHMETIC.items():
    _operator(_op, lanes, lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=_CONTRACT))
_operator(operator.neg, lanes, lambda builder, a: builder.fneg(a), [(lanes,)])
for _op, _sign in {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}.items():
    _operator(_op, mask, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))


class Value:
    """Lanes while code is made, for kernels that Python unrolls."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def __sub__(self, other: "Value") -> "Value":
        return Value(self.builder, self.builder.fsub(self.value, other.value, flags=_CONTRACT))

    def __add__(self, other: "Value") -> "Value":
        return Value(self.builder, self.builder.fadd(self.value, other.value, flags=_CONTRACT))

    def __mul__(self, other: "Value") -> "Value":
        return Value(self.builder, self.builder.fmul(self.value, other.value, flags=_CONTRACT))

    def __neg__(self) -> "Value":
        return Value(self.builder, self.builder.fneg(self.value))

    def inverse(self) -> "Value":
        return Value(self.builder, self.builder.fdiv(ir.Constant(_VEC, [1.0] * WIDTH), self.value))


def row_pointer(context: Any, builder: Any, array_type: Any, array: Any, row: Any) -> Any:
    """Where the lanes of a row of an array begin."""
    data = cgutils.create_struct_proxy(array_type)(context, builder, value=array).data
    pointer = builder.gep(data, [builder.mul(row, ir.Constant(_I64, WIDTH))])
    return builder.bitcast(pointer, _VEC.as_pointer())


@intrinsic
def load(typingctx, array, row):
    """The eight numbers of ``array[row]``."""

    def codegen(context, builder, sig, args):
        row = context.cast(builder, args[1], sig.args[1], types.int64)
        return builder.load(row_pointer(context, builder, sig.args[0], args[0], row), align=8)

    return lanes(array, types.int64), codegen


@intrinsic
def store(typingctx, array, row, value):
    """Write ``value`` (lanes or a number for all) to ``array[row]``."""

    def codegen(context, builder, sig, args):
        pointer = row_pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(_splat(builder, args[2]), pointer, align=8)
        return context.get_dummy_value()

    return types.void(array, types.int64, _kind(value)), codegen


@intrinsic
def splat(typingctx, value):
    """The same number in every lane."""
    return lanes(types.float64), lambda context, builder, sig, args: _splat(builder, args[0])


@intrinsic
def select(typingctx, condition, a, b):
    """``a`` where ``condition``, else ``b``."""

    def codegen(context, builder, sig, args):
        return builder.select(args[0], _splat(builder, args[1]), _splat(builder, args[2]))

    return lanes(mask, _kind(a), _kind(b)), codegen


@intrinsic
def any_lane(typingctx, condition):
    """Whether the mask is set in at least one lane."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(WIDTH), 0))

    return types.boolean(mask), codegen


@intrinsic
def take(typingctx, counter):
    """The number ``counter[0]``, one more for whoever asks next; no two threads ever get the same."""

    def codegen(context, builder, sig, args):
        place = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", place, ir.Constant(_I64, 1), "monotonic")

    return types.int64(counter), codegen


def _function(name: str, operands: int) -> Any:
    """A function of LLVM's, of one or two ``operands``: lanes, or a number for all of them."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(_VEC, [_VEC] * operands)
        called = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v8f64")
        return builder.call(called, [_splat(builder, x) for x in args])

    @intrinsic
    def of_one(typingctx, x):
        return lanes(lanes), codegen

    @intrinsic
    def of_two(typingctx, a, b):
        return lanes(_kind(a), _kind(b)), codegen

    return of_one if operands == 1 else of_two


sqrt, floor, absolute = (_function(name, 1) for name in ("sqrt", "floor", "fabs"))
minimum, maximum = (_function(name, 2) for name in ("minnum", "maxnum"))


@intrinsic
def _scale_by_power_of_two(typingctx, mantissa, exponent):
    """``mantissa · 2**exponent`` for integral ``exponent`` in [-1022, 1023], by writing the exponent bits."""

    def codegen(context, builder, sig, args):
        bias = ir.Constant(_IVEC, [1023] * WIDTH)
        shift = ir.Constant(_IVEC, [52] * WIDTH)
        bits = builder.shl(builder.add(builder.fptosi(args[1], _IVEC), bias), shift)
        return builder.fmul(args[0], builder.bitcast(bits, _VEC))

    return lanes(lanes, lanes), codegen


@intrinsic
def _split(typingctx, x):
    """Exponent e and mantissa m in [1, 2) of positive normal numbers, x = m 2^e."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[0], _IVEC)
        shift = ir.Constant(_IVEC, [52] * WIDTH)
        exponent = builder.sub(builder.lshr(bits, shift), ir.Constant(_IVEC, [1023] * WIDTH))
        fraction = builder.and_(bits, ir.Constant(_IVEC, [(1 << 52) - 1] * WIDTH))
        unity = ir.Constant(_IVEC, [1023 << 52] * WIDTH)
        mantissa = builder.bitcast(builder.or_(fraction, unity), _VEC)
        return context.make_tuple(builder, sig.return_type, [builder.sitofp(exponent, _VEC), mantissa])

    return types.UniTuple(lanes, 2)(lanes), codegen


@intrinsic
def gather_rows(typingctx, table, index):
    """The first six of the eight numbers from ``table.ravel()[index]`` on, per lane, as six lanes; ``index`` holds
    integral numbers, ``table`` is C-contiguous float64.

    Eight loads of a whole row and a transposition: pairs, then fours, then eights of lanes are brought together.
    """

    def codegen(context, builder, sig, args):
        data = cgutils.create_struct_proxy(sig.args[0])(context, builder, value=args[0]).data
        offsets = builder.fptosi(args[1], _IVEC)
        gathered = []
        for lane in range(WIDTH):
            where = builder.extract_element(offsets, ir.Constant(ir.IntType(32), lane))
            row = builder.bitcast(builder.gep(data, [where]), _VEC.as_pointer())
            gathered.append(builder.load(row, align=8))

        def merged(vectors: list[Any], run: int, half: int) -> list[Any]:
            """Of each two vectors, the runs of ``run`` numbers that are in their even (0) or odd (1) places."""
            first = [i + half * run for i in range(WIDTH) if (i // run) % 2 == 0]
            places = [
                at + other * WIDTH for k in range(0, WIDTH // 2, run) for other in (0, 1) for at in first[k : k + run]
            ]
            chosen = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), places)
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            return [builder.shuffle_vector(a, b, chosen) for a, b in pairs]

        columns = []
        for column in range(6):
            vectors = gathered
            for bit in range(3):
                vectors = merged(vectors, 1 << bit, (column >> bit) & 1)
            columns.append(vectors[0])
        return context.make_tuple(builder, sig.return_type, columns)

    return types.UniTuple(lanes, 6)(table, lanes), codegen


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
@infer_global(operator.setitem)
class _Element(AbstractTemplate):
    metadata = TRIED_FIRST

    def generic(self, args: Any, kws: Any) -> Any:
        if not isinstance(args[0], Rows):
            return None
        place = types.UniTuple(types.int64, 2) if isinstance(args[1], types.BaseTuple) else types.int64
        written = args[2:] and (args[0].dtype,)
        return signature(types.none if written else args[0].dtype, args[0], place, *written)


@lower_builtin(operator.getitem, Rows, types.Any)
def _lower_read(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.load(_element(context, builder, sig, args))


@lower_builtin(operator.setitem, Rows, types.Any, types.Any)
def _lower_write(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    builder.store(args[2], _element(context, builder, sig, args))
    return context.get_dummy_value()


_LOG2E = 1.4426950408889634
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10


def _polynomial(*coefficients: float) -> Any:
    """A polynomial of lanes by Horner's rule, the highest coefficient first, unrolled."""

    @intrinsic
    def function(typingctx, x):
        def codegen(context, builder, sig, args):
            value, *others = (ir.Constant(_VEC, [c] * WIDTH) for c in coefficients)
            for other in others:
                value = builder.fadd(builder.fmul(value, args[0], flags=_CONTRACT), other, flags=_CONTRACT)
            return value

        return lanes(lanes), codegen

    return function


_taylor = _polynomial(*(1.0 / math.factorial(k) for k in range(13, -1, -1)))
_artanh = _polynomial(*(1.0 / k for k in range(21, 1, -2)))


@inlined
def exp(x):
    """e^x lane by lane to about 1 ulp, for any |x| (clamped to the range of normal doubles).

    Cody–Waite reduction x = k ln 2 + r, |r| ≤ ln 2 / 2, then the Taylor polynomial of degree 13 (truncation 4e-18).
    """
    x = minimum(maximum(x, -708.0), 709.0)
    k = floor(x * _LOG2E + 0.5)
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    return _scale_by_power_of_two(_taylor(r), k)


@inlined
def log(x):
    """Natural logarithm lane by lane of positive normal numbers, to about 1 ulp.

    x = m 2^e with m in [√½, √2), ln m = 2 artanh((m−1)/(m+1)) by its series (truncation 2e-18).
    """
    exponent, m = _split(x)
    large = m > 1.4142135623730951
    m = select(large, m * 0.5, m)
    exponent = select(large, exponent + 1.0, exponent)
    z = (m - 1.0) / (m + 1.0)
    w = z * z
    return exponent * _LN2_HIGH + (z * 2.0 + (z * 2.0 * w * _artanh(w) + exponent * _LN2_LOW))


@inlined
def lookup(table, offset, span, x):
    """Value and two derivatives of a piecewise quintic, extended beyond its ends (:mod:`en4dvar_bubble.tables`).

    A cell whose eighth number is not zero is halved: the number is the place of its left half, the right one follows.
    """
    origin, intervals = span[0], span[3]
    per_unit = splat(span[2])
    position = (x - origin) * per_unit
    cell = minimum(maximum(floor(position), 0.0), intervals - 1.0)
    s = position - cell
    at = offset + cell * 8.0
    for _ in range(int(span[4])):
        half = gather_rows(table, at + 2.0)[5]
        halved = half > 0.5
        if not any_lane(halved):
            break
        right = select(s < 0.5, 0.0, 1.0)
        at = select(halved, offset + (half + right) * 8.0, at)
        s = select(halved, s * 2.0 - right, s)
        per_unit = select(halved, per_unit * 2.0, per_unit)
    c0, c1, c2, c3, c4, c5 = gather_rows(table, at)
    value = ((((c5 * s + c4) * s + c3) * s + c2) * s + c1) * s + c0
    first = (((c5 * 5.0 * s + c4 * 4.0) * s + c3 * 3.0) * s + c2 * 2.0) * s + c1
    second = ((c5 * 20.0 * s + c4 * 12.0) * s + c3 * 6.0) * s + c2 * 2.0
    return value, first * per_unit, second * (per_unit * per_unit)


@inlined
def driving(t, eq, par):
    """p_f, dp_f/dt, d²p_f/dt² at the lanes' times; zero outside the table's span."""
    zero, span, rate = splat(0.0), eq.driving_span, load(par, rows.PULSE_RATE)
    read = (t - load(par, rows.PULSE_SHIFT)) * rate
    before = read < span[0]
    after = read > span[1]
    inside = select(before, 0.0, select(after, 0.0, 1.0))
    if not any_lane(inside > 0.5):
        return zero, zero, zero
    f, g, h = lookup(eq.driving, load(par, rows.PULSE_TABLE), span, read)
    scale = load(par, rows.AMPLITUDE) * inside
    return f * scale, g * rate * scale, h * rate * rate * scale
