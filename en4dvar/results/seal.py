"""The last line of a result file: format, version and SHA-256 of everything before it.

HDF5 has no checksum of its own: of files with one flipped bit most are read without a word, and some send its library
into an endless loop. The line stands behind the end of the HDF5 file, where every reader of netCDF ignores it; it is
checked before the library gets to see the file.
"""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import atomic_path, open_plain

FORMAT = "en4dvar-result"
VERSION = "1"
WRITTEN: set[str] = set()
"""Last words of the files that this process has sealed itself."""
_LENGTH = len(f"\n{FORMAT} {VERSION} sha256 {'0' * 64}\n")


@dataclass(frozen=True)
class SealedBytes:
    """A result file in memory: ``content``, which may be large and is never copied, and its last line."""

    content: bytes | memoryview
    line: bytes
    sha256: str

    @classmethod
    def of(cls, content: bytes | memoryview) -> Self:
        """``content`` with its last line, and the digest of both."""
        digest = hashlib.sha256(content)
        line = _line(digest.hexdigest())
        digest.update(line)
        return cls(content, line, digest.hexdigest())

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (bytes(self.content), self.line, self.sha256)

    def write(self, path: Path) -> Path:
        """Write the file atomically. Raises :class:`OutputError`."""
        WRITTEN.add(self.line.decode("ascii"))
        with atomic_path(path) as partial:
            partial.write_bytes(self.content)
            with partial.open("ab") as file:
                file.write(self.line)
        return path


def seal_file(path: Path) -> None:
    """Add the last line to a file that is written piece by piece. Raises :class:`OSError`."""
    with path.open("r+b") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0, os.SEEK_END)
        file.write(_line(digest))
        WRITTEN.add(_line(digest).decode("ascii"))


def check_seal(path: Path) -> bool:
    """Read the whole file once and compare; returns whether this process has written it.

    Raises :class:`OutputError`: the file cannot be read, is not one of ours, is of another version, cut short or
    altered.
    """
    try:
        with open_plain(path) as file:
            line, digest = _last_line(file, path), hashlib.sha256()
            left = file.tell() - _LENGTH
            file.seek(0)
            while left > 0 and (block := file.read(min(left, 1 << 20))):
                digest.update(block)
                left -= len(block)
    except FileNotFoundError:
        raise OutputError(f"{path}: no such file") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror or error}") from None
    if line != _line(digest.hexdigest()):
        raise OutputError(f"{path}: damaged or altered since it was written (its checksum does not match)")
    return line.decode("ascii") in WRITTEN


def _last_line(file: BinaryIO, path: Path) -> bytes:
    """The line of a result; it is looked at first, for what has none may be a terabyte long."""
    file.seek(max(file.seek(0, os.SEEK_END) - _LENGTH, 0))
    line = file.read()
    words = line.decode("ascii", "replace").split()
    if words[:1] != [FORMAT] or len(words) != 4:
        raise OutputError(
            f"{path}: not a complete result of en4dvar: it is cut short, was altered, or comes from an older version"
        )
    if words[1] != VERSION:
        raise OutputError(f"{path}: result format {words[1]}; this version of en4dvar reads {VERSION}")
    return line


def _line(digest: str) -> bytes:
    return f"\n{FORMAT} {VERSION} sha256 {digest}\n".encode("ascii")
