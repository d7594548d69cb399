"""A pack: the results of many data sets one after the other in one file, to which a run appends each as it ends.

A record is a line (format, checksum of the rest of the line, name, fingerprint, sizes and SHA-256 of what follows),
then how the data set ended, then its groups. What is there is known from the lines alone: a record that was cut short
by a kill or a full disk is the last one and is overwritten, and damage ends at the next line that can be read. Of
several records of a name the last one counts. What ought to be there is known elsewhere
(:mod:`~en4dvar.results.run_results`). The result of a data set has an address like that of a file:
``datasets.pack/<name>``.
"""

import functools
import json
import os
import re
import time
import unicodedata
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import open_plain, own_file, refused
from en4dvar.plumbing.hints import numbered
from en4dvar.results.checkpoint import digest

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
    """The pack of a run at work, the only one that writes to it; ``whole``: there is nothing in it but records.

    Raises :class:`OutputError` where the file cannot be read, or is none.
    """

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
    """Name of the data set → name of a file, without suffix, that every file system takes and that is unique there.

    Letters of any script stay; blanks and signs become ``_``; names that differ only in case or accents' encoding get
    a number.

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
    """The records by name, where the last of them ends, and whether there is nothing else.

    Where no record follows another, the next line is looked for from that one's own line on: bytes may have gone.
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
