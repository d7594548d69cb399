"""Files that appear complete or not at all, and that lie where they seem to.

A directory may have been prepared by somebody else: unpacked from an archive, say. What is written into one goes
through :func:`inside`, which follows no link there, and what is opened in place through :func:`own_file`. Both judge
what is there when they are called; a process that alters the directory at that moment has the rights to do harm anyway.
"""

import errno
import hashlib
import io
import math
import os
import re
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from pathlib import Path

from en4dvar.plumbing.errors import En4dvarError, OutputError, retold


class PathError(En4dvarError, ValueError):
    """A path that stands for nothing. A ``ValueError`` too, so that pydantic collects it."""

    exit_code = 2


_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
POSIX = hasattr(os, "killpg")  # sessions, signals and links of POSIX; not so on Windows
# A link is not followed and a pipe not waited for; Windows knows neither flag, but one by which bytes stay as they are.
_CAREFUL = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
PATIENCE = (0.02, 0.1, 0.3, 1.0)  # s between attempts to rename a file that another program holds open


def refused(path: str | Path, what: str) -> AbstractContextManager[None]:
    """Within, an operating-system error becomes an :class:`OutputError`: the path, ``what`` and the reason."""
    return retold(OSError, OutputError, f"{path}: {what}: ")


def inside(root: str | Path, name: str | Path) -> Path:
    """``root/name`` where that lies in ``root``; ``root`` itself may be a link, for the user has named it.

    Raises :class:`OutputError`: ``name`` is absolute, empty or holds ``..``; a part of it is there as a link, a pipe, a
    socket or a device, through which something else would be read or written.
    """
    relative, path = Path(name), os.fspath(root)
    if relative.anchor or not relative.parts or ".." in relative.parts or "\0" in str(name):
        raise OutputError(f"{root}: {str(name)!r} is not the name of a file in this directory")
    for part in relative.parts:
        path = os.path.join(path, part)
        try:
            mode = os.lstat(path).st_mode
        except FileNotFoundError:
            break
        except OSError as error:
            raise OutputError(f"{path}: cannot be used: {error.strerror or error}") from None
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise OutputError(f"{path}: is {kind_of(mode)}, which a run neither follows nor replaces; remove it")
    return Path(root) / relative


def own_file(path: Path) -> int:
    """Descriptor of a file that is written in place: to read, and to append to; it is made where it is missing.

    Raises :class:`OutputError`: the file is no plain one, or has other names, under which something else would be
    written. OSError.
    """
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | _CAREFUL, 0o666)
    status = os.fstat(handle)
    if stat.S_ISREG(status.st_mode) and status.st_nlink <= 1:
        return handle
    os.close(handle)
    what = "has a second name (a hard link)" if stat.S_ISREG(status.st_mode) else "is no plain file"
    raise OutputError(f"{path}: {what}, so that something else would be written; put a copy in its place")


def open_plain(path: Path) -> io.BufferedReader:
    """Open a file for reading. Raises :class:`OSError`, also for a folder, a pipe, a device, that may never end."""
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "a null byte in its name", str(path))
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        raise OSError(errno.EINVAL, f"is {kind_of(mode)}, not a file", str(path))
    return open(path, "rb", opener=lambda *_: handle)


def kind_of(mode: int) -> str:
    """What is no plain file, in words."""
    return _KINDS.get(stat.S_IFMT(mode), "something else")


def read_plain(path: str | Path, longest: int) -> bytes:
    """The content of a file. Raises :class:`OSError`, also for a pipe, a device, and more than ``longest`` bytes."""
    with open_plain(Path(path)) as file:
        return read_at_most(file, longest)


def read_at_most(file: io.BufferedReader, longest: int) -> bytes:
    """The rest of a file, whose size is looked at first. Raises :class:`OSError` for more than ``longest`` bytes."""
    size = os.fstat(file.fileno()).st_size - file.tell()
    content = file.read(size + 1) if size <= longest else b""
    if max(size, len(content)) > longest:  # it may have grown
        raise OSError(errno.EFBIG, f"{in_bytes(size)}; at most {in_bytes(longest)} are read", file.name)
    return content


def read_text(path: str | Path, longest: int = 10_000_000) -> str:
    """The text of a file: UTF-8, without its byte order mark.

    Raises :class:`OSError` as :func:`read_plain`, and where it is no text.
    """
    try:
        return read_plain(path, longest).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise OSError(errno.EILSEQ, "is not UTF-8 text", str(path)) from None


def in_bytes(size: float) -> str:
    """A size in words.

    >>> in_bytes(999), in_bytes(1.1e12)
    ('999 bytes', '1.1 TB')
    """
    units = ("bytes", "kB", "MB", "GB", "TB", "PB", "EB")
    power = min(len(units) - 1, int(math.log10(max(size, 1))) // 3)
    return f"{size / 1000**power:.3g} {units[power]}"


@contextmanager
def atomic_path(path: str | Path, durable: bool = True) -> Iterator[Path]:
    """A partial file beside ``path`` to write to; on leaving it is renamed to ``path``.

    ``durable``: it is flushed to disk first, so that it also survives a loss of power.

    Where the block raises, ``path`` stays as it was and the partial file is removed. An operating-system error becomes
    an :class:`OutputError` that names ``path``.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{owner()}.tmp")
    try:
        _remove_leftovers(os.path.abspath(path.parent), _PARTIAL)
        partial.unlink(missing_ok=True)  # it may be a link
        # an unwritable place gives the system's reason here, not a library's guess later
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        yield partial
        if durable:
            _fsync(partial, os.O_RDWR)
        replace_file(partial, path)
        if durable and POSIX:  # elsewhere a directory cannot be opened
            _fsync(path.parent, os.O_RDONLY)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            partial.unlink()


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """A folder in ``parent``, by default the system's, that is removed on leaving; after a kill, by who comes next."""
    parent = Path(tempfile.gettempdir()) if parent is None else parent
    _remove_leftovers(os.path.abspath(parent), _FOLDER)
    folder = Path(tempfile.mkdtemp(prefix=f"en4dvar-{owner()}-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


_PARTIAL = re.compile(r"\..+\.(\d{6})(\d{7,})\.tmp")
_FOLDER = re.compile(r"en4dvar-(\d{6})(\d{7,})-\w+")


def owner() -> str:
    """Digits for this process in the names of what is not to outlive it: of the machine, and of the process there."""
    return f"{_machine()}{os.getpid():07d}"


@cache
def _machine() -> str:
    """Six digits of this machine or container, in which processes are numbered."""
    try:
        numbering = os.stat("/proc/self/ns/pid").st_ino
    except OSError:
        numbering = 0
    digest = hashlib.sha256(f"{socket.gethostname()} {numbering}".encode()).digest()
    return f"{int.from_bytes(digest[:8], 'big') % 10**6:06d}"


@cache
def _remove_leftovers(folder: str, names: re.Pattern[str]) -> None:
    """Remove what processes of this machine that are gone have left in a folder; looked for once."""
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            match = names.fullmatch(entry.name)
            if match and match[1] == _machine() and is_gone(int(match[2])):
                with suppress(OSError):
                    shutil.rmtree(entry) if entry.is_dir(follow_symlinks=False) else os.unlink(entry)


def is_gone(process: int) -> bool:
    """True if no process has this number; on Windows, where asking might end it, it is taken to be there."""
    try:
        if POSIX:
            os.kill(process, 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        pass
    return False


def write_text(path: str | Path, text: str) -> Path:
    """Write ``text`` (UTF-8) atomically. Raises :class:`OutputError`."""
    return write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, content: bytes) -> Path:
    """Write ``content`` atomically. Raises :class:`OutputError`."""
    with atomic_path(path) as partial:
        partial.write_bytes(content)
    return Path(path)


def make_folder(path: str | Path) -> Path:
    """The folder, made where it is missing. Raises :class:`OutputError`."""
    path = Path(path)
    with refused(path, "cannot be created"):
        path.mkdir(parents=True, exist_ok=True)
    return path


def remove_file(path: Path) -> None:
    """Remove a file, or a link, if it is there. Raises :class:`OutputError`."""
    with refused(path, "cannot be removed"):
        path.unlink(missing_ok=True)


def expanded(text: str) -> Path:
    """The path, a ``~`` at its beginning as the folder it stands for. Raises :class:`PathError`."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise PathError(f"{text}: the home folder that ~ stands for is not known") from None


def path_from(folder: Path, data: str) -> str:
    """``data`` as a configuration in ``folder`` says it: relative where both share more than the root."""
    path, here = expanded(data).absolute(), folder.absolute()
    near = path.parts[:2] == here.parts[:2] and len(here.parts) > 1
    return Path(os.path.relpath(path, here)).as_posix() if near else path.as_posix()


def here() -> str:
    """The working directory, "" where it is gone."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def readable(text: object) -> str:
    r"""Text that can be written as UTF-8; bytes of a file's name that are not are shown as ``\udcfc``."""
    return str(text).encode("utf-8", "backslashreplace").decode("utf-8")


def replace_file(source: Path, target: Path) -> None:
    """Rename a file or folder, in the place of a file; again a few times where another program has it open, which
    Windows then refuses (a virus scanner, the synchronisation of a folder). Raises :class:`OSError`.
    """
    for seconds in () if POSIX else PATIENCE:
        try:
            source.replace(target)
            return
        except PermissionError:
            time.sleep(seconds)
    source.replace(target)


def _fsync(path: Path, flags: int) -> None:
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
