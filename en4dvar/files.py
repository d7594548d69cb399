"""Files that appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from en4dvar.errors import En4dvarError, OutputError


class PathError(En4dvarError, ValueError):
    """A path that stands for nothing. A ``ValueError`` too, so that pydantic collects it."""

    exit_code = 2


@contextmanager
def atomic_path(path: str | Path, durable: bool = True) -> Iterator[Path]:
    """A partial file beside ``path`` to write to; on leaving it is renamed to ``path``.

    ``durable``: it is flushed to disk first, so that it also survives a loss of power.

    Where the block raises, ``path`` stays as it was and the partial file is removed. An operating-system error becomes
    an :class:`OutputError` that names ``path``.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        partial.touch()  # an unwritable place gives the system's reason here, not a library's guess later
        yield partial
        if durable:
            _fsync(partial)
        partial.replace(path)
        if durable and os.name == "posix":  # elsewhere a directory cannot be opened
            _fsync(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            partial.unlink()


def write_text(path: str | Path, text: str) -> Path:
    """Write ``text`` (UTF-8) atomically. Raises :class:`OutputError`."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
    return Path(path)


def write_bytes(path: str | Path, content: bytes) -> Path:
    """Write ``content`` atomically. Raises :class:`OutputError`."""
    with atomic_path(path) as partial:
        partial.write_bytes(content)
    return Path(path)


def make_folder(path: str | Path) -> Path:
    """The folder, made where it is missing. Raises :class:`OutputError`."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be created: {error.strerror}") from None
    return path


def expanded(text: str) -> Path:
    """The path, a ``~`` at its beginning as the folder it stands for. Raises :class:`PathError`."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise PathError(f"{text}: the home folder that ~ stands for is not known") from None


def readable(text: object) -> str:
    r"""Text that can be written as UTF-8; bytes of a file's name that are not are shown as ``\udcfc``."""
    return str(text).encode("utf-8", "backslashreplace").decode("utf-8")


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
