"""Groups of variables ⇄ bytes, as a :mod:`~en4dvar.storage.pack` holds them: one JSON text, then the numbers.

Ten times faster to write and to read than a netCDF file of the same groups, of which the definitions are most of the
work. Nothing that is read is executed.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from en4dvar.errors import OutputError
from en4dvar.storage.netcdf import Group, Groups, Variable

_SIZE = struct.Struct("<Q")  # of the text
_ALIGNED = 8  # bytes


def packed(groups: Groups) -> bytes:
    """The bytes of the groups."""
    numbers = bytearray()
    text = json.dumps([[path, _group(group, numbers)] for path, group in groups.items()]).encode("utf-8")
    text += b" " * (-len(text) % _ALIGNED)
    return b"".join((_SIZE.pack(len(text)), text, numbers))


def unpacked(content: bytes) -> dict[str, Group]:
    """The groups, whose arrays can be written to. Raises :class:`~en4dvar.errors.OutputError`."""
    held = bytearray(content)
    try:
        (size,) = _SIZE.unpack_from(held)
        begin = _SIZE.size + size
        layout = json.loads(held[_SIZE.size : begin])
        return {path: _restored(raw, memoryview(held)[begin:]) for path, raw in layout}
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise OutputError(f"not a result of en4dvar: {error}") from None


def _group(group: Group, numbers: bytearray) -> list[Any]:
    parts = ({name: _variable(v, numbers) for name, v in part.items()} for part in (group.variables, group.coords))
    return [*parts, _attributes(group.attrs)]


def _attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for k, v in attributes.items()}


def _variable(v: Variable, numbers: bytearray) -> list[Any]:
    about = [v.dims, v.values.shape, v.fill, _attributes(v.attrs)]
    if v.values.dtype.kind in "OU":
        return [*about, None, v.values.ravel().tolist()]
    where = len(numbers)
    numbers += v.values.tobytes()
    numbers += b"\0" * (-len(numbers) % _ALIGNED)
    return [*about, v.values.dtype.str, where]


def _restored(raw: list[Any], numbers: memoryview) -> Group:
    variables, coords, attributes = raw
    parts = ({name: _read(v, numbers) for name, v in part.items()} for part in (variables, coords))
    return Group(*parts, _whole(attributes))


def _read(raw: list[Any], numbers: memoryview) -> Variable:
    dims, shape, fill, attributes, kind, where = raw
    if kind is None:
        values = np.empty(len(where), dtype=object)
        values[:] = where
    else:
        values = np.frombuffer(numbers, np.dtype(kind), int(np.prod(shape)), where)
    return Variable(tuple(dims), values.reshape(shape), _whole(attributes), fill)


def _whole(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {k: np.array(v) if isinstance(v, list) else v for k, v in attributes.items()}
