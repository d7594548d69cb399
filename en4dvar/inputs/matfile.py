"""Numbers of MATLAB files. Those of version 5, also inside structs and cell arrays, are read here, not by a library.

One flipped bit in a file takes the process down inside scipy's compiled reader, which trusts sizes it finds in the
file. To check all that it trusts is to read the file, so this does: every size is compared with the bytes that are
there before it is used, and bytes become numbers by ``numpy.frombuffer`` alone. Of text or an object only the name is
read. What is in a struct or a cell array has the name MATLAB has for it: ``film.R``, ``expts(2).R``, ``R{3}``.
MathWorks, *MAT-File Format* (R2019b), chapter 1.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from en4dvar.inputs.hdf_matfile import hdf_variables
from en4dvar.inputs.variables import MOST, MOST_IN_MATRICES, Variables, array_words, gathered
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.files import open_plain, read_plain

LONGEST = 4_000_000_000  # bytes of a file
HEADER = 128  # bytes
MATRIX, COMPRESSED = 14, 15  # kinds of elements
HEAD = 4096  # bytes of a compressed variable that tell what it is
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
OPAQUE = 17  # class of tables, strings and objects: no size is stored, the second element is the name
CLASSES = {1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix", 16: "a function"}
CLASSES |= {OPAQUE: "an object"}
CELL, STRUCT = 1, 2
DEEPEST = 4  # structs inside structs
NUMERIC = range(6, 16)  # classes of arrays of numbers
COMPLEX = 0x800


class _Damaged(Exception):
    """What is wrong with the bytes."""


@dataclass(frozen=True)
class _Variable:
    """A vector's ``values`` (K,) or a matrix's (n, m), or in ``words`` what else it is."""

    name: str
    values: Array | None = None
    words: str = ""
    holds: bool = False  # a struct or a cell array


def mat_variables(path: Path) -> Variables:
    """What a ``.mat`` file holds. Raises :class:`DataError`."""
    with open_plain(path) as file:
        raw = file.read(HEADER)
    if not raw.startswith((b"MATLAB 5.0", b"MATLAB 7.3")):
        raise DataError(f"{path}: not a MATLAB v5 file (no such header); save it in MATLAB with save(..., '-v7')")
    order = {b"IM": "<", b"MI": ">"}.get(raw[126:HEADER], "")
    if raw.startswith(b"MATLAB 7.3") or (order and struct.unpack_from(f"{order}H", raw, 124)[0] == 0x0200):
        return hdf_variables(path)
    raw = read_plain(path, LONGEST)
    try:
        if not order:
            raise _Damaged("its header does not say in which order bytes are")
        variables = _variables(memoryview(raw), order)
    except _Damaged as error:
        raise DataError(f"{path}: not a MATLAB v5 file ({error})") from None
    return gathered((v.name, v.words if v.values is None else v.values) for v in variables)


def _variables(raw: memoryview, order: str) -> list[_Variable]:
    """Named variables of a file; of two with one name the last. Raises :class:`_Damaged`."""
    elements, by_name, numbers, in_matrices = _Elements(raw[HEADER:], order), {}, 0, 0
    while elements.left >= 8:
        kind, content = elements.long()
        if kind == 0:
            break  # padding
        if kind == COMPRESSED:
            variables = _unpacked(content, order)
        elif kind == MATRIX:
            variables = _variable(content, order)
        else:
            raise _Damaged(f"an element of kind {kind} where a variable should be")
        for variable in variables:
            if variable.values is not None and variable.values.ndim == 2:
                in_matrices += variable.values.size
                if in_matrices > MOST_IN_MATRICES:
                    variable = _Variable(variable.name, words=array_words(variable.values.shape))
            numbers += 0 if variable.values is None else variable.values.size
            if numbers > MOST:
                raise _Damaged(f"more than {MOST} numbers in vectors")
            if variable.name and not variable.name.startswith("__"):
                by_name[variable.name] = variable
    return list(by_name.values())


def _unpacked(packed: memoryview, order: str) -> list[_Variable]:
    """A compressed variable; what holds no vector is not unpacked to its end, where its checksum is."""
    head, _ = _inflated(packed, HEAD)
    kind, size = struct.unpack_from(f"{order}II", head) if len(head) >= 8 else (0, 0)
    if kind != MATRIX:
        raise _Damaged("a compressed variable is damaged")
    variable, *_ = _variable(memoryview(head)[8:], order, data=False)
    if variable.words and not variable.holds:
        return [variable]
    if size > 8 * MOST + HEAD:
        if variable.holds:
            return [variable]
        raise _Damaged(f"{variable.name} would take {size / 2**20:.0f} MiB")
    content, ended = _inflated(packed, 8 + size + 1)
    if not ended or len(content) != 8 + size:
        raise _Damaged("a compressed variable is damaged")
    return _variable(memoryview(content)[8:], order)


def _inflated(packed: memoryview, most: int) -> tuple[bytes, bool]:
    """At most so many bytes, and whether they are all, with the right checksum."""
    stream = zlib.decompressobj()
    try:
        return stream.decompress(packed, most), stream.eof
    except zlib.error:
        raise _Damaged("a compressed variable is damaged") from None


def _variable(content: memoryview, order: str, data: bool = True, within: str = "", depth: int = 0) -> list[_Variable]:
    """What the content of a matrix element holds, and what is in that; without ``data`` a vector has no values.

    ``within``: the name of one inside another, which has none of its own.
    """
    elements = _Elements(content, order)
    _, flags = elements.next()
    if len(flags) < 8:
        raise _Damaged("a variable without a class")
    (flag,) = struct.unpack_from(f"{order}I", flags)
    kind = flag & 0xFF
    if kind not in CLASSES and kind not in NUMERIC:
        raise _Damaged(f"a variable of class {kind}")
    shape = () if kind == OPAQUE else _shape(elements.next()[1], order)
    own = _name(elements.next()[1])
    name = within or own
    if kind in (CELL, STRUCT):
        container = _Variable(name, words=CLASSES[kind], holds=True)
        return [container, *(_held(elements, order, kind, name, math.prod(shape), depth + 1) if data else ())]
    if kind in CLASSES or flag & COMPLEX:
        return [_Variable(name, words=CLASSES.get(kind, "complex"))]
    count = math.prod(shape)
    if count != max(shape) and (len(shape) > 2 or count > MOST_IN_MATRICES):
        return [_Variable(name, words=array_words(shape))]
    if not data:
        return [_Variable(name)]
    values = _numbers(elements, order, name, count)
    return [_Variable(name, values if count == max(shape) else values.reshape(shape, order="F"))]


def _name(raw: memoryview) -> str:
    name = bytes(raw).partition(b"\0")[0].decode("latin-1")
    if not name.isprintable():
        raise _Damaged("a variable's name is damaged")
    return name


def _held(elements: "_Elements", order: str, kind: int, name: str, count: int, depth: int) -> Iterator[_Variable]:
    """What is in a struct array or a cell array of ``count`` elements, element by element."""
    if depth > DEEPEST:
        return
    fields = _fields(elements, order) if kind == STRUCT else [""]
    if not fields:
        return
    for index in range(1, count + 1):
        of = f"{name}{{{index}}}" if kind == CELL else name if count == 1 else f"{name}({index})"
        for field in fields:
            tag, content = elements.long()
            if tag != MATRIX:
                raise _Damaged(f"an element of kind {tag} in {name}")
            if len(content):
                yield from _variable(content, order, within=f"{of}.{field}" if field else of, depth=depth)


def _fields(elements: "_Elements", order: str) -> list[str]:
    """Names of the fields of a struct, all stored with the same length."""
    _, length = elements.next()
    if len(length) != 4:
        raise _Damaged("a struct without the length of its names")
    (size,) = struct.unpack(f"{order}i", length)
    _, names = elements.next()
    if size <= 0 or len(names) % size:
        raise _Damaged("a struct whose names have no length")
    return [_name(names[at : at + size]) for at in range(0, len(names), size)]


def _shape(content: memoryview, order: str) -> tuple[int, ...]:
    shape = struct.unpack_from(f"{order}{len(content) // 4}i", content)
    if len(shape) < 2 or min(shape) < 0:
        raise _Damaged("a variable with no valid size")
    return shape


def _numbers(elements: "_Elements", order: str, name: str, count: int) -> Array:
    """The next element as ``count`` numbers."""
    if not count:
        return np.empty(0)
    kind, content = elements.next()
    if kind not in NUMBERS:
        raise _Damaged(f"{name} is stored as elements of kind {kind}, which are not numbers")
    stored = np.dtype(f"{order}{NUMBERS[kind]}")
    if len(content) != count * stored.itemsize:
        raise _Damaged(f"{name} should hold {count} numbers, but there are {len(content) // stored.itemsize}")
    return np.frombuffer(content, stored).astype(np.float64)


class _Elements:
    """Tagged elements one after the other. Raises :class:`_Damaged` where one is longer than what is left."""

    def __init__(self, content: memoryview, order: str):
        self.content, self.order, self.at = content, order, 0

    @property
    def left(self) -> int:
        return len(self.content) - self.at

    def long(self) -> tuple[int, memoryview]:
        """Kind and content of an element with a tag of eight bytes."""
        kind, size = self._words(8)
        return kind, self._take(size)

    def next(self) -> tuple[int, memoryview]:
        """Kind and content of an element inside a variable, which may be small: four bytes that share the tag's."""
        (tag,) = self._words(4)
        size, kind = tag >> 16, tag & 0xFFFF
        if size > 4:
            raise _Damaged(f"a small element of {size} bytes")
        if size:
            return kind, self._take(4)[:size]
        (size,) = self._words(4)
        content = self._take(size)
        self.at = min(self.at + -size % 8, len(self.content))
        return kind, content

    def _words(self, size: int) -> tuple[int, ...]:
        return struct.unpack(f"{self.order}{size // 4}I", self._take(size))

    def _take(self, size: int) -> memoryview:
        if size > self.left:
            raise _Damaged("it is cut short, or a size in it is damaged")
        self.at += size
        return self.content[self.at - size : self.at]
