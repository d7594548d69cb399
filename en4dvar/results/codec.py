"""Frozen dataclasses of numbers, text and arrays ⇄ bytes. Nothing that is read is executed (no pickle).

The layout is an ``.npz`` archive: arrays as they are, everything else in one JSON text in which arrays are referred to
by their name. What is read back is checked against the annotations of the dataclass.
"""

import functools
import io
import json
import types
import typing
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from en4dvar.plumbing.errors import retold

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
    with retold((KeyError, TypeError, ValueError), ValueError, f"not a {kind.__name__}: "):
        value: D = _reader(typing.cast(Any, kind))(json.loads(content), {})
    return value


def decode(content: bytes, kind: type[D]) -> D:
    """The dataclass of :func:`encode`. Raises :class:`ValueError` where the bytes are not one of ``kind``."""
    with retold((OSError, KeyError, TypeError, ValueError, EOFError), ValueError, f"not a {kind.__name__}: "):
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        value: D = _reader(typing.cast(Any, kind))(json.loads(str(arrays.pop(_TEXT))), arrays)
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


_Arrays = dict[str, np.ndarray[Any, Any]]
_Reader = Callable[[Any, _Arrays], Any]  # what the JSON text says → the value of a type


@functools.cache  # a campaign reads as many of one kind as it has data sets
def _reader(kind: Any) -> _Reader:
    """Raises, when it reads, :class:`KeyError`, :class:`TypeError` or :class:`ValueError`."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        other = _reader(next(a for a in arguments if a is not type(None)))
        return lambda raw, arrays: None if raw is None and type(None) in arguments else other(raw, arrays)
    if origin in (np.ndarray, npt.NDArray):  # from NumPy 2.5 on NDArray is an alias with a name of its own
        return lambda raw, arrays: arrays[raw["array"]]
    if origin is tuple and arguments[1:] == (Ellipsis,):
        item = _reader(arguments[0])
        return lambda raw, arrays: tuple(item(part, arrays) for part in raw)
    if origin is tuple:
        items = tuple(map(_reader, arguments))
        return lambda raw, arrays: tuple(read(part, arrays) for read, part in zip(items, raw, strict=True))
    if origin is typing.Literal:
        return functools.partial(_choice, arguments)
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return functools.partial(_dataclass, kind, {f.name: _reader(hints[f.name]) for f in fields(kind)})
    return functools.partial(_simple, (int, float) if kind is float else (kind,))


def _dataclass(kind: Any, readers: dict[str, _Reader], raw: Any, arrays: _Arrays) -> Any:
    if set(raw) != set(readers):
        raise ValueError(f"the fields of {kind} differ")
    return kind(**{name: readers[name](item, arrays) for name, item in raw.items()})


def _choice(choices: tuple[Any, ...], raw: Any, _: _Arrays) -> Any:
    if raw not in choices:
        raise ValueError(f"{raw!r} is not one of {choices}")
    return raw


def _simple(kinds: tuple[type, ...], raw: Any, _: _Arrays) -> Any:
    if type(raw) not in kinds:
        raise TypeError(f"{raw!r} is not a {kinds[-1].__name__}")
    return raw
