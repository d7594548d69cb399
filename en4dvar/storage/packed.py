"""Groups of variables ⇄ bytes, as a :mod:`~en4dvar.storage.pack` holds them: two JSON texts, then the numbers.

Ten times faster to write and to read than a netCDF file of the same groups, of which the definitions are most of the
work. The first text says which variables there are, and is the same for most data sets of a campaign, so that it is
understood once; the second holds what is said of the groups, and variables of text. Nothing that is read is executed.
"""

from __future__ import annotations

import functools
import json
import math
import struct
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from en4dvar.storage.netcdf import Group, Groups, Variable

_SIZES = struct.Struct("<QQ")  # of the texts
_ALIGNED = 8  # bytes


def packed(groups: Groups) -> bytes:
    """The bytes of the groups."""
    numbers = bytearray()
    words: list[Any] = []
    layout = []
    for path, group in groups.items():
        parts = (group.variables, group.coords)
        layout.append([path, *([[name, *_place(v, numbers, words)] for name, v in part.items()] for part in parts)])
    told = [[_attributes(group.attrs) for group in groups.values()], words]
    first, second = (json.dumps(one).encode("ascii") for one in (layout, told))
    second += b" " * (-(len(first) + len(second)) % _ALIGNED)
    return b"".join((_SIZES.pack(len(first), len(second)), first, second, numbers))


def unpacked(content: bytes, wanted: Collection[str] | None = None) -> dict[str, Group]:
    """The groups, or those ``wanted``, whose arrays can be written to. Raises :class:`ValueError`."""
    held = bytearray(content)
    try:
        first, second = _SIZES.unpack_from(held)
        begin = _SIZES.size + first
        attributes, words = json.loads(held[begin : begin + second])
        numbers = memoryview(held)[begin + second :]

        def restored(part: list[Any]) -> dict[str, Variable]:
            return {name: _restored(numbers, words, *v) for name, *v in part}

        return {
            path: Group(restored(variables), restored(coords), _whole(said))
            for (path, variables, coords), said in zip(
                _layout(bytes(held[_SIZES.size : begin])), attributes, strict=True
            )
            if wanted is None or path in wanted
        }
    except (struct.error, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"no packed groups: {error}") from None


@functools.lru_cache(maxsize=16)
def _layout(text: bytes) -> list[Any]:
    """Of each group the path, then of its variables and of its coordinates name and arguments of :func:`_restored`."""

    def understood(part: list[Any]) -> list[Any]:
        return [(name, tuple(dims), shape, fill, _whole(said), *rest) for name, dims, shape, fill, said, *rest in part]

    return [(path, *map(understood, parts)) for path, *parts in json.loads(text)]


def _attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for k, v in attributes.items()}


def _whole(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {k: np.array(v) if isinstance(v, list) else v for k, v in attributes.items()}


def _place(v: Variable, numbers: bytearray, words: list[Any]) -> list[Any]:
    """What is told of a variable, its kind ("" of text) and where its values are put."""
    about = [v.dims, v.values.shape, v.fill, _attributes(v.attrs)]
    if v.values.dtype.kind in "OU":
        words.append(v.values.ravel().tolist())
        return [*about, "", len(words) - 1]
    values = v.values.astype(np.float32) if v.single else v.values
    where = len(numbers)
    numbers += values.tobytes()
    numbers += b"\0" * (-len(numbers) % _ALIGNED)
    return [*about, values.dtype.str, where]


def _restored(
    numbers: memoryview, words: list[Any],
    dims: tuple[str, ...], shape: list[int], fill: bool, attributes: dict[str, Any], kind: str, where: int,
) -> Variable:  # fmt: skip
    if kind:
        values = np.frombuffer(numbers, kind, math.prod(shape), where)
    else:
        values = np.empty(len(words[where]), dtype=object)
        values[:] = words[where]
    return Variable(dims, values.reshape(shape), attributes, fill)
