"""One process at a time in a run directory. The operating system drops the lock of a process that dies."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from en4dvar.errors import OutputError

LOCK = ".en4dvar-lock"
_UNSUPPORTED = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)  # some network file systems


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Hold the lock of ``directory``.

    The lock is advisory and belongs to this process, not to the workers it starts. On a file system without locks it
    protects nothing, and a run is not refused there.

    Raises
    ------
    OutputError: another run holds it (says which process on which machine), or the directory cannot be written.
    """
    file = _acquire(directory)
    try:
        yield
    finally:
        (directory / LOCK).unlink(missing_ok=True)
        file.close()


def _acquire(directory: Path) -> IO[str]:
    path = directory / LOCK
    while True:
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{directory}: cannot be used as run directory: {error.strerror or error}") from None
        try:
            _lock(file)
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                file.seek(0)
                owner = file.read().strip() or "another process"
                file.close()
                raise OutputError(
                    f"{directory}: in use by {owner}; wait for it to end, or give another --out"
                ) from None
        try:
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                break
        except FileNotFoundError:
            pass
        file.close()  # the run before removed the file between our opening and locking it
    file.truncate(0)
    file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
    file.flush()
    return file


if sys.platform == "win32":
    import msvcrt

    def _lock(file: IO[str]) -> None:
        file.seek(1 << 20)  # beyond the text, so that others can read it
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(file: IO[str]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
