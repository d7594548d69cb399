"""Functions that are compiled apart from the kernels that call them, by their address.

Numba compiles a copy of every function into each kernel that calls it. What does not depend on the kind of equations is
a kernel of its own, so that the second kind finds it compiled. Its one argument is where a named group is kept in
memory: handing over a hundred numbers at every step would take a few percent of the step.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

_ADDRESSES: dict[Any, int] = {}


def address(kernel: Any, group: Any) -> int:
    """Where the machine code of ``kernel`` is, for a group of this type."""
    known = kernel, _kinds(group)  # numba's own name of a type takes a millisecond
    if known not in _ADDRESSES:
        signature = (types.CPointer(nb.typeof(group)),)
        kernel.compile(signature)
        compiled = kernel.overloads[signature]
        _ADDRESSES[known] = int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))
    return _ADDRESSES[known]


def _kinds(group: Any) -> tuple[Any, ...]:
    """What the type of a group depends on."""
    return tuple(
        [
            _kinds(value)
            if isinstance(value, tuple)
            else (value.dtype.char, value.ndim, value.flags.num)
            if isinstance(value, np.ndarray)
            else type(value)
            for value in group
        ]
    )


@intrinsic
def kept(typingctx, group):
    """Where a copy of ``group`` is kept until the caller returns."""

    def codegen(context, builder, sig, args):
        model = context.data_model_manager[sig.args[0]]
        return cgutils.alloca_once_value(builder, model.as_data(builder, args[0]))

    return types.CPointer(group)(group), codegen


@intrinsic
def contents(typingctx, place):
    """The group that is kept there."""

    def codegen(context, builder, sig, args):
        return context.data_model_manager[sig.return_type].load_from_data_pointer(builder, args[0])

    return place.dtype(place), codegen


@intrinsic
def call(typingctx, function, place):
    """The integer that the function at an address returns for the group kept at ``place``."""

    def codegen(context, builder, sig, args):
        convention, kinds = context.call_conv, sig.args[1:]
        kind = convention.get_function_type(sig.return_type, kinds)
        callee = builder.inttoptr(args[0], kind.as_pointer())
        status, found = convention.call_function(builder, callee, sig.return_type, kinds, args[1:])
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return found

    return types.int64(types.int64, place), codegen
