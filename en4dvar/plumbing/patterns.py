"""Texts that a pattern is sought in, by a process of its own, which starts faster the less it imports."""

import re
from collections.abc import Iterator
from pathlib import Path

from en4dvar.plumbing.errors import DataError, retold
from en4dvar.plumbing.files import read_plain

LONGEST = 256_000_000  # bytes of a text


def matches(path: Path, pattern: str) -> Iterator[list[str]]:
    """What a regular expression with one group finds in a file; see :mod:`en4dvar.plumbing.decoding`.

    Raises :class:`DataError` as :func:`text_of`.
    """
    yield re.findall(pattern, text_of(path), re.MULTILINE)


def text_of(path: Path) -> str:
    """What a program has written, its lines ended by ``\\n``; bytes that are no UTF-8 are replaced.

    Raises :class:`DataError` where it cannot be read, or is longer than :data:`LONGEST`.
    """
    with retold(OSError, DataError, f"no output file {path}: "):
        return read_plain(path, LONGEST).decode("utf-8", errors="replace").replace("\r\n", "\n")
