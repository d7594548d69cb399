"""How compiled kernels are kept on disk: stamped with all their sources, whole at any moment, and compiled once.

Numba stamps a kept kernel with the modification time of the file of its outermost function only; an edit (or an
upgrade) of a module it calls would leave stale machine code in use. And of processes that need the same kernel at the
same time (a campaign's workers, a batch of jobs, 20 first starts) each would compile it.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock

PATIENCE = 120.0  # s that a process waits for another one's compilation, which may have been stopped
LOOKS = 0.05  # s between two looks


class SignatureFiles(IndexDataCacheFile):
    """A file of machine code for each signature and stamp, there before the index names it.

    numba numbers the files and writes the index first. Of processes that start at once, one could then load what
    another has compiled for another signature; and a kill in between would leave an index that is of the sources of
    today with machine code of those before.
    """

    def save(self, key: Any, data: Any) -> None:
        digest = sha256(repr((self._source_stamp, key)).encode()).hexdigest()[:16]
        name = f"{self._index_name.removesuffix('.nbi')}.{digest}.nbc"
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


def _digest(folder: Path, *more: Path) -> str:
    content = b"".join(path.read_bytes() for path in (*sorted(folder.glob("*.py")), *more))
    return sha256(content).hexdigest()


def stamp_with_sources(dispatcher: Any, folder: Path, *more: Path) -> None:
    """Replace the cache stamp of ``dispatcher`` (compiled with ``cache=True``) by the content of all modules in
    ``folder`` and ``more``.
    """
    cache = dispatcher._cache
    cache._cache_file = SignatureFiles(cache.cache_path, cache._impl.filename_base, _digest(folder, *more))


def compile_once(dispatcher: Any) -> None:
    """Of processes that need ``dispatcher`` for the same arguments, let one compile; the others load what it kept."""
    compile_: Callable[[Any], Any] = dispatcher.compile

    def alone(signature: Any) -> Any:
        cache = dispatcher._cache
        digest = sha256(repr(signature).encode()).hexdigest()[:16]
        # numba's lock first, as where one kernel is compiled within another: threads never wait for each other's file
        lock = Path(cache.cache_path) / f"{cache._impl.filename_base}.{digest}.lock"
        with global_compiler_lock, _held(lock), _without_collection():
            return compile_(signature)

    dispatcher.compile = alone


@contextmanager
def _without_collection() -> Iterator[None]:
    """Within, Python does not look for cycles: among the million objects that the compiler keeps until it is done, a
    tenth of its time went into that.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Within, no other process is; without such a file, or after :data:`PATIENCE`, another one may be."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)
    except OSError:  # a folder of somebody else's
        yield
        return
    try:
        end = time.monotonic() + PATIENCE
        while not _locked(file) and time.monotonic() < end:
            time.sleep(LOOKS)
        yield
    finally:
        os.close(file)  # the lock with it, as at the death of the process


def _locked(file: int) -> bool:
    """Whether the file is locked for us now; where files cannot be locked, nobody is waited for."""
    try:
        from fcntl import LOCK_EX, LOCK_NB, flock
    except ImportError:
        return True
    try:
        flock(file, LOCK_EX | LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # of some network file systems
        return True
    return True
