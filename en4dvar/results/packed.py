"""Groups of variables ⇄ bytes, as a :mod:`~en4dvar.results.pack` holds them: two JSON texts, then the numbers.

Ten times faster to write and to read than a netCDF file of the same groups, of which the definitions are most of the
work. The first text says which variables there are, and is the same for most data sets of a campaign, so that it is
understood once; the second holds what is said of the groups, and variables of text. Nothing that is read is executed.
"""

import functools
import json
import math
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from en4dvar.plumbing.errors import retold
from en4dvar.results.netcdf import Group, Groups, Variable

_SIZES = struct.Struct("<QQ")  # of the texts
_ALIGNED = 8  # bytes


@dataclass(frozen=True, eq=False)
class PackedLayout:
    """Which variables there are: of each group the path, then of its variables and of its coordinates the name and what
    :func:`_place` tells; ``named``: which texts stand along dimensions; ``sizes`` of these by path; ``texts``: how many
    words each has; ``length`` of the numbers in bytes.
    """

    groups: list[tuple[str, list[Any], list[Any]]]
    named: list[int]
    sizes: dict[str, dict[str, int]]
    texts: dict[int, int]
    length: int


@dataclass(frozen=True, slots=True)
class Content:
    """Bytes of :func:`packed` whose texts are read: the layout (one object for equal ones), of each group its
    attributes, variables of text; ``numbers`` are as they were.
    """

    layout: PackedLayout
    attributes: list[dict[str, Any]]
    words: list[list[str]]
    numbers: memoryview


@dataclass(frozen=True)
class Alike:
    """Contents that differ in numbers and attributes only: ``places`` says which of those given these are.

    Variables of ``groups`` have the contents along a first axis of their values; ``attributes`` are, content by
    content, those of each group.
    """

    places: list[int]
    groups: dict[str, Group]
    attributes: list[dict[str, dict[str, Any]]]


def packed(groups: Groups) -> bytes:
    """The bytes of the groups."""
    numbers = bytearray()
    words: list[Any] = []
    layout = []
    for path, group in groups.items():
        parts = (group.variables, group.coords)
        layout.append([path, *([[name, *_place(v, numbers, words)] for name, v in part.items()] for part in parts)])
    told = [[_attributes(group.attrs) for group in groups.values()], words]
    first, second = (json.dumps(header).encode("ascii") for header in (layout, told))
    second += b" " * (-(len(first) + len(second)) % _ALIGNED)
    return b"".join((_SIZES.pack(len(first), len(second)), first, second, numbers))


def opened(content: bytes) -> Content:
    """What the texts say. Raises :class:`ValueError`."""
    with _understanding():
        first, second = _SIZES.unpack_from(content)
        begin = _SIZES.size + first
        attributes, words = json.loads(content[begin : begin + second])
        layout = _layout(content[_SIZES.size : begin])
        numbers = memoryview(content)[begin + second :]
        held = len(attributes), len(numbers), {k: len(words[k]) for k in layout.texts}
        if held != (len(layout.groups), layout.length, layout.texts):
            raise ValueError("there are more or fewer values than it says")
        return Content(layout, attributes, words, numbers)


def unpacked(content: bytes, wanted: Collection[str] | None = None) -> dict[str, Group]:
    """The groups, or those ``wanted``, whose arrays can be written to. Raises :class:`ValueError`."""
    return _restored([opened(content)], (), wanted)


def unpacked_together(contents: Sequence[Content], wanted: Collection[str]) -> list[Alike]:
    """The groups ``wanted`` of contents, those alike at once: what is done for one is done for all. Raises
    :class:`ValueError`.
    """
    places_of: dict[Any, list[int]] = {}
    for i, content in enumerate(contents):
        places_of.setdefault((content.layout, *(tuple(content.words[k]) for k in content.layout.named)), []).append(i)

    def alike(places: list[int]) -> Alike:
        every = [contents[i] for i in places]
        paths = [path for path, *_ in every[0].layout.groups]
        attributes = [dict(zip(paths, content.attributes, strict=True)) for content in every]
        return Alike(places, _restored(every, (len(every),), wanted), attributes)

    return list(map(alike, places_of.values()))


_NONE = struct.error, ValueError, KeyError, TypeError, AttributeError, IndexError
_understanding = functools.partial(retold, _NONE, ValueError, "no packed groups: ")


@functools.lru_cache(maxsize=64)
def _layout(text: bytes) -> PackedLayout:
    def understood(part: list[Any]) -> list[Any]:
        return [(name, tuple(dims), shape, fill, _whole(said), *rest) for name, dims, shape, fill, said, *rest in part]

    groups = [(path, understood(variables), understood(coords)) for path, variables, coords in json.loads(text)]
    sizes = {
        path: {dim: n for _, dims, shape, *_ in (*variables, *coords) for dim, n in zip(dims, shape, strict=True)}
        for path, variables, coords in groups
    }
    texts, length = {}, 0
    for _, variables, coords in groups:
        for *_, shape, _, _, kind, where in (*variables, *coords):
            if where < 0 or min(shape, default=0) < 0 or np.dtype(kind or "f8").hasobject:
                raise ValueError("a variable is nowhere")
            if kind:
                length = max(length, where + math.prod(shape) * np.dtype(kind).itemsize)
            else:
                texts[where] = math.prod(shape)
    named = [where for _, _, coords in groups for *_, kind, where in coords if not kind]
    return PackedLayout(groups, named, sizes, texts, length + -length % _ALIGNED)


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
    values, where = v.stored, len(numbers)
    numbers += values.tobytes()
    numbers += b"\0" * (-len(numbers) % _ALIGNED)
    return [*about, values.dtype.str, where]


def _restored(every: Sequence[Content], lead: tuple[int, ...], wanted: Collection[str] | None) -> dict[str, Group]:
    """The groups of contents of one layout, whose values have the ``lead``ing axis (n,), or none of a single one.

    Attributes are those of the first.
    """

    def variable(
        dims: tuple[str, ...], shape: list[int], fill: bool, attributes: dict[str, Any], kind: str, where: int
    ) -> Variable:
        values: np.ndarray[Any, Any]
        if kind:
            end = where + math.prod(shape) * np.dtype(kind).itemsize
            values = numbers[:, where:end].view(kind)
        else:
            texts = [text for content in every for text in content.words[where]]
            values = np.empty(len(texts), dtype=object)
            values[:] = texts
        return Variable(dims, values.reshape((*lead, *shape)), attributes, fill)

    def variables(part: list[Any]) -> dict[str, Variable]:
        return {name: variable(*v) for name, *v in part}

    with _understanding():
        whole = bytearray().join(content.numbers for content in every)
        numbers = np.frombuffer(whole, np.uint8).reshape(len(every), -1)
        return {
            path: Group(variables(held), variables(coords), _whole(said))
            for (path, held, coords), said in zip(every[0].layout.groups, every[0].attributes, strict=True)
            if wanted is None or path in wanted
        }
