"""Files that appear complete or not at all, and that lie where they seem to.

A directory may have been prepared by somebody else: unpacked from an archive, say. What is written into one goes
through :func:`inside`, which follows no link there, and what is opened in place through :func:`own_file`. Both judge
what is there when they are called; a process that alters the directory at that moment has the rights to do harm anyway.
"""

from __future__ import annotations

import errno
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from en4dvar.errors import En4dvarError, OutputError


class PathError(En4dvarError, ValueError):
    """A path that stands for nothing. A ``ValueError`` too, so that pydantic collects it."""

    exit_code = 2


_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
# A link is not followed and a pipe not waited for; Windows knows neither flag.
_CAREFUL = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def inside(root: str | Path, name: str | Path) -> Path:
    """``root/name`` where that lies in ``root``; ``root`` itself may be a link, for the user has named it.

    Raises
    ------
    OutputError: ``name`` is absolute, empty or holds ``..``; a part of it is there as a link, a pipe, a socket or a
        device, through which something else would be read or written.
    """
    given, path = Path(name), os.fspath(root)
    if given.anchor or not given.parts or ".." in given.parts or "\0" in str(name):
        raise OutputError(f"{root}: {str(name)!r} is not the name of a file in this directory")
    for part in given.parts:
        path = os.path.join(path, part)
        try:
            mode = os.lstat(path).st_mode
        except FileNotFoundError:
            break
        except OSError as error:
            raise OutputError(f"{path}: cannot be used: {error.strerror or error}") from None
        if kind := _KINDS.get(stat.S_IFMT(mode)):
            raise OutputError(f"{path}: is {kind}, which a run neither follows nor replaces; remove it")
    return Path(root) / given


def own_file(path: Path) -> int:
    """Descriptor of a file that is written in place: to read, and to append to; it is made where it is missing.

    Raises
    ------
    OutputError: the file is no plain one, or has other names, under which something else would be written. OSError.
    """
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | _CAREFUL, 0o666)
    found = os.fstat(handle)
    if stat.S_ISREG(found.st_mode) and found.st_nlink <= 1:
        return handle
    os.close(handle)
    what = "has a second name (a hard link)" if stat.S_ISREG(found.st_mode) else "is no plain file"
    raise OutputError(f"{path}: {what}, so that something else would be written; put a copy in its place")


def open_plain(path: Path) -> io.BufferedReader:
    """Open a file for reading. Raises :class:`OSError`, also for a pipe or a device, whose reading may never end."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        raise OSError(errno.EINVAL, os.strerror(errno.EISDIR) if stat.S_ISDIR(mode) else "Not a plain file", str(path))
    return open(handle, "rb")


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
        _make_anew(partial)  # an unwritable place gives the system's reason here, not a library's guess later
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


def remove_file(path: Path) -> None:
    """Remove a file, or a link, if it is there. Raises :class:`OutputError`."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be removed: {error.strerror}") from None


def expanded(text: str) -> Path:
    """The path, a ``~`` at its beginning as the folder it stands for. Raises :class:`PathError`."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise PathError(f"{text}: the home folder that ~ stands for is not known") from None


def readable(text: object) -> str:
    r"""Text that can be written as UTF-8; bytes of a file's name that are not are shown as ``\udcfc``."""
    return str(text).encode("utf-8", "backslashreplace").decode("utf-8")


def _make_anew(path: Path) -> None:
    """An empty file that is not there already, as a link for instance."""
    path.unlink(missing_ok=True)
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
