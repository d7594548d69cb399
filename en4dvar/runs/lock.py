"""One process at a time in a run directory. The operating system drops the lock of a process that dies."""

import errno
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import lock_descriptor

from en4dvar.plumbing.called import ELSEWHERE, advised
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import POSIX, inside, is_gone, own_file

LOCK = ".en4dvar-lock"
PATIENCE = 3.0  # s for the lock of a dead process to go
_LONGEST = 500  # bytes of a lock's text
_LONGEST_NUMBER = 9  # digits that the number of a process can have
_OTHER = "another process"
_UNSUPPORTED = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)  # some network file systems


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Hold the lock of ``directory``.

    The lock is advisory and belongs to this process, not to the workers it starts. On a file system without locks it
    protects nothing, and a run is not refused there.

    Raises :class:`OutputError`: another run holds it (says which process on which machine), or it is no plain file.
    :class:`OSError`: the directory cannot be written.
    """
    file = _acquire(directory)
    try:
        yield
    finally:
        ours = _is_at(file, directory / LOCK)
        if not POSIX:  # nobody can remove a file that is open, which is why nobody else's is removed here
            os.close(file)
        if ours:
            with suppress(OSError):
                (directory / LOCK).unlink()
        if POSIX:
            os.close(file)


def _acquire(directory: Path) -> int:
    """Descriptor of the locked file. A buffer, which a full disk cannot take, would be written again at its end."""
    path, patience = inside(directory, LOCK), time.monotonic() + PATIENCE
    while True:
        file = own_file(path)
        try:
            free = lock_descriptor(file, blocking=False)
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                os.close(file)
                raise
            free = True
        if not free:
            os.lseek(file, 1, os.SEEK_SET)
            owner = os.read(file, _LONGEST).decode("utf-8", "replace").strip() or _OTHER
            os.close(file)
            if not _is_dead(owner) or time.monotonic() > patience:
                advice = f"wait for it to end, or give {advised(*ELSEWHERE)}"
                raise OutputError(f"{directory}: in use by {owner}; {advice}") from None
            time.sleep(0.02)
            continue
        if not _is_at(file, path):
            os.close(file)  # the run before removed the file between our opening and locking it
            continue
        try:
            os.ftruncate(file, 1)  # Windows locks this byte, and lets others read what follows
            os.write(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        except OSError:
            with suppress(OSError):
                path.unlink()
            os.close(file)
            raise
        return file


def _is_at(file: int, path: Path) -> bool:
    """Whether the open file is the one at ``path``, which another run may have removed, and made again."""
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except OSError:
        return False


def _is_dead(owner: str) -> bool:
    """Whether the process that wrote its name has ended; its lock outlives it in one that it was about to start."""
    if owner == _OTHER:  # not written yet
        return True
    number, _, host = owner.removeprefix("process ").partition(" on ")
    if host != socket.gethostname() or not number.isdecimal():
        return False
    return POSIX and (len(number) > _LONGEST_NUMBER or is_gone(int(number)))
