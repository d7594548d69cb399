"""Named groups by the place where they are kept, and functions that are compiled apart and called by their address.

A group that is handed over is handed over number by number, a hundred of them, which the compiler has to move at every
call; of a :class:`Place` a function takes one word and reads what it needs. And numba compiles a copy of every function
into each kernel that calls it: what does not depend on the kind of equations is a kernel of its own, so that the second
kind finds it compiled.
"""

from typing import Any

import numba as nb
from numba._dispatcher import compute_fingerprint
from numba.core import cgutils, types
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, lower_getattr_generic, models, register_model

_ADDRESSES: dict[Any, int] = {}


def address(kernel: Any, group: Any) -> int:
    """Where the machine code of ``kernel`` is, for a group of this type."""
    known = kernel, compute_fingerprint(group)  # of its type; the type itself takes 40 times as long to tell
    if known not in _ADDRESSES:
        signature = (Place(nb.typeof(group)),)
        kernel.compile(signature)
        compiled = kernel.overloads[signature]
        _ADDRESSES[known] = int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))
    return _ADDRESSES[known]


class Place(types.Type):
    """Where a named group is kept in memory. Its fields are read when they are asked for; those that are groups are
    places again.
    """

    def __init__(self, group: Any) -> None:
        self.group = group
        super().__init__(name=f"place({group})")


@register_model(Place)
class _PlaceModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, dmm[fe_type.group].get_data_type().as_pointer())


@infer_getattr
class _Fields(AttributeTemplate):
    key = Place

    def generic_resolve(self, value: Any, attr: str) -> Any:  # type: ignore[override]  # there it is no method
        kind = _kind(value, attr)
        return Place(kind) if isinstance(kind, types.BaseNamedTuple) else kind


def _kind(place: Any, name: str) -> Any:
    return place.group.types[place.group.fields.index(name)]


@lower_getattr_generic(Place)
def _field(context: Any, builder: Any, place: Any, where: Any, name: str) -> Any:
    kind = _kind(place, name)
    there = cgutils.gep_inbounds(builder, where, 0, place.group.fields.index(name))
    if isinstance(kind, types.BaseNamedTuple):
        return there
    return context.data_model_manager[kind].load_from_data_pointer(builder, there)


@intrinsic
def kept(typingctx, group):
    """The :class:`Place` of a copy of ``group``, until the caller returns."""

    def codegen(context, builder, sig, args):
        model = context.data_model_manager[sig.args[0]]
        return cgutils.alloca_once_value(builder, model.as_data(builder, args[0]))

    return Place(group)(group), codegen


@intrinsic
def call(typingctx, function, place):
    """The integer that the function at an address returns for a :class:`Place`."""

    def codegen(context, builder, sig, args):
        convention, kinds = context.call_conv, sig.args[1:]
        kind = convention.get_function_type(sig.return_type, kinds)
        callee = builder.inttoptr(args[0], kind.as_pointer())
        status, result = convention.call_function(builder, callee, sig.return_type, kinds, args[1:])
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return result

    return types.int64(types.int64, place), codegen
