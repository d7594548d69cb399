"""Frozen dataclasses of numbers, text and arrays ⇄ bytes. Nothing that is read is executed (no pickle).

The layout is an ``.npz`` archive: arrays as they are, everything else in one JSON text in which arrays are referred to
by their name. What is read back is checked against the annotations of the dataclass.
"""

from __future__ import annotations

import functools
import io
import json
import types
import typing
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

D = TypeVar("D")
_TEXT = "content"


def encode(value: Any) -> bytes:
    """Bytes of a dataclass whose fields are float, int, bool, str, None, float arrays, tuples and dataclasses."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    text = json.dumps(_plain(value, arrays))  # repr of a float is exact; NaN and Infinity are kept
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{_TEXT: np.array(text)}, **arrays)
    return buffer.getvalue()


def encode_text(value: Any) -> bytes:
    """As :func:`encode`, of a dataclass without arrays: its JSON text alone."""
    return json.dumps(_plain(value, {})).encode("ascii")


def decode_text(content: bytes, kind: type[D]) -> D:
    """The dataclass of :func:`encode_text`. Raises :class:`ValueError` where the bytes are not one of ``kind``."""
    try:
        value: D = _typed(json.loads(content), kind, {})
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a {kind.__name__}: {error}") from error
    return value


def decode(content: bytes, kind: type[D]) -> D:
    """The dataclass of :func:`encode`. Raises :class:`ValueError` where the bytes are not one of ``kind``."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        value: D = _typed(json.loads(str(arrays.pop(_TEXT))), kind, arrays)
    except (OSError, KeyError, TypeError, ValueError, EOFError) as error:
        raise ValueError(f"not a {kind.__name__}: {error}") from error
    return value


def _plain(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name), arrays) for f in fields(value)}
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, tuple):
        return [_plain(item, arrays) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"cannot store a {type(value).__name__}")


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind)}


def _typed(raw: Any, kind: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if raw is None and type(None) in arguments:
            return None
        return _typed(raw, next(a for a in arguments if a is not type(None)), arrays)
    if origin in (np.ndarray, npt.NDArray):  # from NumPy 2.5 on NDArray is an alias with a name of its own
        return arrays[raw["array"]]
    if origin is tuple:
        items = arguments[:1] * len(raw) if arguments[1:] == (Ellipsis,) else arguments
        return tuple(_typed(item, a, arrays) for item, a in zip(raw, items, strict=True))
    if origin is typing.Literal:
        if raw not in arguments:
            raise ValueError(f"{raw!r} is not one of {arguments}")
        return raw
    if is_dataclass(kind):
        hints = _hints(typing.cast(type, kind))
        if set(raw) != set(hints):
            raise ValueError(f"the fields of {kind} differ")
        return typing.cast(Any, kind)(**{name: _typed(item, hints[name], arrays) for name, item in raw.items()})
    if kind is float and type(raw) in (int, float):
        return raw
    if type(raw) is not kind:
        raise TypeError(f"{raw!r} is not a {kind.__name__}")
    return raw
