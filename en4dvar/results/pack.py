"""A pack: the results of many data sets one after the other in one file, to which a run appends each as it ends.

A record is a line (format, checksum of the rest of the line, name, fingerprint, sizes and SHA-256 of what follows),
then how the data set ended, then its groups. What is there is known from the lines alone: a record that was cut short
by a kill or a full disk is the last one and is overwritten, and damage ends at the next line that can be read. Of
several records of a name the last one counts. The result of a data set has an address: ``datasets.pack/<name>``.

Groups are two JSON texts, then the numbers: ten times faster than a netCDF file of them. The first text says which
variables there are, and is the same for most data sets of a campaign, so that it is understood once; the second holds
what is said of the groups, and variables of text. Nothing that is read is executed.
"""

import functools
import json
import math
import os
import re
import struct
import time
import unicodedata
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from en4dvar.plumbing.errors import OutputError, retold
from en4dvar.plumbing.files import open_plain, own_file, refused
from en4dvar.plumbing.hints import numbered
from en4dvar.results.checkpoint import digest
from en4dvar.results.netcdf import Group, Groups, Variable

PACK = "datasets.pack"
VERSION = "1"
FLUSH_EVERY = 1.0  # s; what a loss of power may take, a kill takes nothing
_MAGIC = b"\nen4dvar-pack "
_LONGEST = 4096  # bytes of a line
_BLOCK = 1 << 20  # bytes that are searched at once, at most
_RESERVED = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")  # names of devices on Windows
_LONGEST_NAME = 120  # bytes; file systems allow 255, and temporary names are longer


@dataclass(frozen=True, slots=True)
class Entry:
    """A record: where it begins, and what its line says. ``content`` has no bytes where the data set has failed."""

    begin: int
    line: int
    fingerprint: str
    outcome_size: int
    content_size: int
    outcome_digest: str
    content_digest: str

    @property
    def end(self) -> int:
        return self.begin + self.line + self.outcome_size + self.content_size


class Pack:
    """The pack of a run at work, its only writer; ``whole``: nothing in it but records. Raises :class:`OutputError`."""

    def __init__(self, path: Path):
        self.path = path
        self.entries: dict[str, Entry] = {}
        self.whole = True
        self._end, self._flushed = 0, time.monotonic()
        if path.exists():
            self.entries, self._end, self.whole = _scan(path)

    def append(self, name: str, fingerprint: str, outcome: bytes, content: bytes, content_digest: str) -> None:
        """Add a record. Raises :class:`OutputError`; the file is then as it was."""
        sizes, digests = (len(outcome), len(content)), (digest(outcome), content_digest)
        words = json.dumps([name, fingerprint, *sizes, *digests]).encode("ascii")
        line = b"%s%s %08x %s\n" % (_MAGIC, VERSION.encode("ascii"), zlib.crc32(words), words)
        with refused(self.path, "cannot be written"):
            file = own_file(self.path)
            try:
                _append(file, self._end, b"".join((line, outcome, content)))
                if time.monotonic() - self._flushed > FLUSH_EVERY:
                    os.fsync(file)
                    self._flushed = time.monotonic()
            finally:
                os.close(file)
        self.entries[name] = entry = Entry(self._end, len(line), fingerprint, *sizes, *digests)
        self._end = entry.end

    def flush(self) -> None:
        """What was appended also survives a loss of power. Raises :class:`OutputError`."""
        with refused(self.path, "cannot be written"), self.path.open("r+b") as file:
            os.fsync(file.fileno())

    def content(self, name: str, check: bool = True) -> bytes:
        """The groups of a data set. Raises :class:`OutputError` where they are damaged, if that is to be checked."""
        e = self.entries[name]
        expected = e.content_digest if check else ""
        return _read(self.path, name, e.begin + e.line + e.outcome_size, e.content_size, expected)


def read_outcome(path: Path, name: str, entry: Entry) -> bytes:
    """How a data set ended. Raises :class:`OutputError` where that is damaged."""
    return _read(path, name, entry.begin + entry.line, entry.outcome_size, entry.outcome_digest)


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Name of the data set → name of a file, without suffix, that every file system takes and that is unique there:
    blanks and signs become ``_``; names that differ only in case or accents' encoding get a number.

    >>> file_names(["gel 1", "gel/1", "Gel_1", "ゲル"])
    {'gel 1': 'gel_1', 'gel/1': 'gel_1_2', 'Gel_1': 'Gel_1_3', 'ゲル': 'ゲル'}
    """
    used: set[str] = set()
    chosen = {}
    for name in names:
        base = re.sub(r"[^\w.+-]", "_", unicodedata.normalize("NFC", name)).lstrip(".") or "_"
        base = base.encode("utf-8")[:_LONGEST_NAME].decode("utf-8", "ignore").rstrip(".")
        base = f"_{base}" if _RESERVED.fullmatch(base) else base
        candidate, number = base, 1
        while candidate.casefold() in used:
            number += 1
            candidate = f"{base}_{number}"
        used.add(candidate.casefold())
        chosen[name] = candidate
    return chosen


def results_of(pack: Path) -> list[Path]:
    """The addresses of the results in a pack, in the order of their names and numbers. Raises :class:`OutputError`."""
    held = [name for name, entry in known_pack(pack).entries.items() if entry.content_size]
    return [pack / name for name in sorted(sorted(held), key=numbered)]


def read_result(address: Path) -> bytes:
    """The groups at an address. Raises :class:`OutputError`."""
    pack = known_pack(address.parent)
    if address.name not in pack.entries:
        raise OutputError(f"{address}: no such result: it was never written, is cut short or was altered")
    return pack.content(address.name)


def known_pack(path: Path) -> Pack:
    """A pack that is read, once for all that is asked of it. Raises :class:`OutputError`."""
    with refused(path, "cannot be read"):
        status = path.stat()
    return _known(path, status.st_ino, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=2)  # results are read one by one
def _known(path: Path, *state: int) -> Pack:
    return Pack(path)


def _append(file: int, end: int, record: bytes) -> None:
    """Write at ``end``, behind which there is at most what a kill left of a record. Raises :class:`OSError`."""
    if os.fstat(file).st_size != end:
        os.ftruncate(file, end)
    left = memoryview(record)
    try:
        while left:
            left = left[os.write(file, left) :]
    except OSError:
        os.ftruncate(file, end)
        raise


def _read(path: Path, name: str, begin: int, size: int, expected: str) -> bytes:
    with refused(path, "cannot be read"), open_plain(path) as file:
        file.seek(begin)
        content = file.read(size)
    if len(content) != size or (expected and digest(content) != expected):
        raise OutputError(f"{path / name}: damaged or altered since it was written (its checksum does not match)")
    return content


def _scan(path: Path) -> tuple[dict[str, Entry], int, bool]:
    """The records by name, where the last of them ends, and whether there is nothing else. Where no record follows
    another, the next line is looked for from that one's own line on: bytes may have gone.
    """
    entries: dict[str, Entry] = {}
    end = place = looked = 0
    whole = True
    with refused(path, "cannot be read"), open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size
        begin = file.read(_LONGEST)
        while place < size:
            file.seek(place)
            name, entry = _entry(file.readline(1) + file.readline(_LONGEST), place)
            if entry is None or entry.end > size:
                whole, place = False, _next(file, looked + 1, size)
                looked = place
            else:
                entries[name], looked = entry, place
                place, end = entry.end, max(end, entry.end)
    if not entries:
        version = begin.removeprefix(_MAGIC).split(b" ", 1)[0].decode("ascii", "replace")
        if begin.startswith(_MAGIC) and version != VERSION:
            raise OutputError(f"{path}: result format {version}; this version of en4dvar reads {VERSION}")
    return entries, end, whole


def _entry(line: bytes, begin: int) -> tuple[str, Entry | None]:
    """What a line says, where it is one."""
    words = line.removeprefix(_MAGIC).split(b" ", 2)
    if not line.startswith(_MAGIC) or len(words) != 3 or words[0] != VERSION.encode("ascii"):
        return "", None
    if words[1] != b"%08x" % zlib.crc32(words[2][:-1]) or not words[2].endswith(b"\n"):
        return "", None
    try:
        name, *rest = json.loads(words[2])
    except (ValueError, TypeError, RecursionError):  # written by hand, as what follows
        return "", None
    kinds = [str, int, int, str, str]
    if list(map(type, rest)) != kinds or min(rest[1:3]) < 0 or not name or Path(str(name)).name != name:
        return "", None
    return name, Entry(begin, len(line), *rest)


def _next(file: BinaryIO, place: int, size: int) -> int:
    """Where the next line begins, or ``size``."""
    length = _LONGEST  # the next line may be near, and the file full of them
    while place < size:
        file.seek(place)
        block = file.read(length)
        if (at := block.find(_MAGIC)) >= 0:
            return place + at
        if len(block) < length:
            break
        place += len(block) - len(_MAGIC)
        length = min(2 * length, _BLOCK)
    return size


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
    """Contents that differ in numbers and attributes only: ``places`` among those given, ``groups`` of which values
    have the contents along a first axis, and ``attributes``, content by content, of each group.
    """

    places: list[int]
    groups: dict[str, Group]
    attributes: list[dict[str, dict[str, Any]]]


def packed(groups: Groups) -> bytes:
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
    """The groups ``wanted``; what is done for one is done for all that are alike. Raises :class:`ValueError`."""
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
        return [(name, tuple(dims), shape, fill, dict(said), *rest) for name, dims, shape, fill, said, *rest in part]

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
    """The groups of contents of one layout, values with the ``lead``ing axis (n,) or none; attributes of the first."""

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
            path: Group(variables(held), variables(coords), dict(said))
            for (path, held, coords), said in zip(every[0].layout.groups, every[0].attributes, strict=True)
            if wanted is None or path in wanted
        }
