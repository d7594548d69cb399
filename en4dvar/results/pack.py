"""A pack: the results of many data sets one after the other in one file, to which a run appends each as it ends.

A record is a line (format, checksum of the rest of the line, name, fingerprint, sizes and SHA-256 of what follows),
then how the data set ended, then its groups. What is there is known from the lines alone: a record that was cut short
by a kill or a full disk is the last one and is overwritten, and damage ends at the next line that can be read. Of
several records of a name the last one counts. The result of a data set has an address like that of a file:
``datasets.pack/<name>``.
"""

from __future__ import annotations

import functools
import json
import os
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import open_plain, own_file
from en4dvar.plumbing.hints import numbered
from en4dvar.results.checkpoint import digest

PACK = "datasets.pack"
VERSION = "1"
FLUSH_EVERY = 1.0  # s; what a loss of power may take, a kill takes nothing
_MAGIC = b"\nen4dvar-pack "
_LONGEST = 4096  # bytes of a line
_BLOCK = 1 << 20  # bytes that are searched at once


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
    """The pack of a run at work, the only one that writes to it.

    Raises :class:`OutputError` where the file cannot be read, or is none.
    """

    def __init__(self, path: Path):
        self.path = path
        self.entries: dict[str, Entry] = {}
        self._end, self._flushed = 0, time.monotonic()
        if path.exists():
            self.entries, self._end = _scan(path)

    def append(self, name: str, fingerprint: str, outcome: bytes, content: bytes, content_digest: str) -> None:
        """Add a record. Raises :class:`OutputError`; the file is then as it was."""
        sizes, digests = (len(outcome), len(content)), (digest(outcome), content_digest)
        words = json.dumps([name, fingerprint, *sizes, *digests]).encode("ascii")
        line = b"%s%s %08x %s\n" % (_MAGIC, VERSION.encode("ascii"), zlib.crc32(words), words)
        try:
            file = own_file(self.path)
            try:
                _append(file, self._end, b"".join((line, outcome, content)))
                if time.monotonic() - self._flushed > FLUSH_EVERY:
                    os.fsync(file)
                    self._flushed = time.monotonic()
            finally:
                os.close(file)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from None
        self.entries[name] = entry = Entry(self._end, len(line), fingerprint, *sizes, *digests)
        self._end = entry.end

    def flush(self) -> None:
        """What was appended also survives a loss of power. Raises :class:`OutputError`."""
        try:
            with self.path.open("r+b") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def content(self, name: str, check: bool = True) -> bytes:
        """The groups of a data set. Raises :class:`OutputError` where they are damaged, if that is to be checked."""
        e = self.entries[name]
        expected = e.content_digest if check else ""
        return _read(self.path, name, e.begin + e.line + e.outcome_size, e.content_size, expected)


def read_outcome(path: Path, name: str, entry: Entry) -> bytes:
    """How a data set ended. Raises :class:`OutputError` where that is damaged."""
    return _read(path, name, entry.begin + entry.line, entry.outcome_size, entry.outcome_digest)


def results_of(pack: Path) -> list[Path]:
    """The addresses of the results in a pack, in the order of their names and numbers. Raises :class:`OutputError`."""
    held = [name for name, entry in _opened(pack).entries.items() if entry.content_size]
    return [pack / name for name in sorted(sorted(held), key=numbered)]


def read_result(address: Path) -> bytes:
    """The groups at an address. Raises :class:`OutputError`."""
    pack = _opened(address.parent)
    if address.name not in pack.entries:
        raise OutputError(f"{address}: no such result: it was never written, is cut short or was altered")
    return pack.content(address.name)


def _opened(path: Path) -> Pack:
    try:
        status = path.stat()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from None
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
    try:
        with open_plain(path) as file:
            file.seek(begin)
            content = file.read(size)
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(content) != size or (expected and digest(content) != expected):
        raise OutputError(f"{path / name}: damaged or altered since it was written (its checksum does not match)")
    return content


def _scan(path: Path) -> tuple[dict[str, Entry], int]:
    """The whole records by name, and where the last of them ends."""
    entries: dict[str, Entry] = {}
    end = place = 0
    try:
        with open_plain(path) as file:
            size = os.fstat(file.fileno()).st_size
            _check_version(path, file.read(_LONGEST))
            while place < size:
                file.seek(place)
                name, entry = _entry(file.readline(1) + file.readline(_LONGEST), place)
                if entry is None or entry.end > size:
                    place = _next(file, place + 1, size)
                else:
                    entries[name] = entry
                    end = place = entry.end
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from None
    return entries, end


def _check_version(path: Path, begin: bytes) -> None:
    version = begin.removeprefix(_MAGIC).split(b" ", 1)[0].decode("ascii", "replace")
    if begin.startswith(_MAGIC) and version != VERSION:
        raise OutputError(f"{path}: result format {version}; this version of en4dvar reads {VERSION}")


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
    while place < size:
        file.seek(place)
        block = file.read(_BLOCK)
        if (at := block.find(_MAGIC)) >= 0:
            return place + at
        if len(block) < _BLOCK:
            break
        place += len(block) - len(_MAGIC)
    return size
