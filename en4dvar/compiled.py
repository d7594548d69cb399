"""Kernels: functions that numba compiles once and keeps on disk for later processes.

Numba writes beside the source file, or below the user's cache folder; where neither can be written (an installation and
a HOME that are read-only, as on many clusters) it refuses to declare the function at all. Kernels are then kept in a
folder of the user's own below the system's temporary one. ``NUMBA_CACHE_DIR`` goes before all of these.
"""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.event import Listener, install_listener

from en4dvar.errors import OutputError
from en4dvar.kernel_cache import compile_once

F = TypeVar("F", bound=Callable[..., Any])
CACHE = "NUMBA_CACHE_DIR"
_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
KERNELS: list[Any] = []
"""Every kernel that has been declared so far in this process."""


def kernel(function: F) -> F:
    """``function`` compiled by numba, kept on disk, without the interpreter's lock.

    Raises
    ------
    OutputError: nowhere can compiled code be kept.
    """
    return _compiled(function, numba.njit(cache=True, nogil=True))


def kernel_without_allocation(function: F) -> F:
    """A :func:`kernel` that makes no arrays: no references to them need be counted."""
    options: dict[str, Any] = {"_nrt": False}  # which numba's annotations leave out
    return _compiled(function, numba.njit(cache=True, nogil=True, **options))


def kernel_called_by_address(function: F) -> F:
    """A :func:`kernel_without_allocation` that only other kernels call, with the numbers that IEEE 754 gives a division
    by zero.
    """
    options: dict[str, Any] = {"_nrt": False, **_NO_ENTRY}
    return _compiled(function, numba.njit(cache=True, nogil=True, error_model="numpy", **options))


def called(function: F) -> F:
    """``function`` compiled into the kernels that call it. Not to be called from Python: entries for that take time
    to compile.
    """
    compiled: F = numba.njit(**_NO_ENTRY)(function)
    return compiled


def inlined(function: F) -> F:
    """The same, without a call."""
    compiled: F = numba.njit(forceinline=True, **_NO_ENTRY)(function)
    return compiled


def summing_kernel(function: F) -> F:
    """A :func:`kernel` whose sums may be added in another order, side by side; the order is the same in every run."""
    return _compiled(function, numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"}))


def _compiled(function: F, compile_: Callable[[F], Any]) -> F:
    try:
        compiled: F = compile_(function)
    except RuntimeError:  # numba found no folder
        _keep_in_a_temporary_folder()
        compiled = compile_(function)
    compile_once(compiled)
    KERNELS.append(compiled)
    return compiled


def compilations() -> int:
    """How often a kernel was compiled in this process, because nothing kept on disk served its arguments."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in KERNELS)


@contextmanager
def watch_compilation(tell: Callable[[], None]) -> Iterator[None]:
    """Within, ``tell`` is called when this process begins to compile what is not kept on disk."""
    with install_listener("numba:compile", _Watcher(tell)):
        yield


class _Watcher(Listener):
    def __init__(self, tell: Callable[[], None]):
        self._tell = tell

    def on_start(self, event: Any) -> None:
        self._tell()

    def on_end(self, event: Any) -> None:
        """What comes next is told by who does it."""


def _keep_in_a_temporary_folder() -> None:
    """Tell numba of a folder that can be written, here and in processes that start from here; say so."""
    try:
        folder = _own_folder(Path(tempfile.gettempdir()))
    except OSError as error:
        raise OutputError(
            f"no folder can be written to keep compiled code in ({error.strerror}); set {CACHE} to one"
        ) from None
    asked = os.environ.get(CACHE)
    os.environ[CACHE] = str(folder)
    numba.config.reload_config()
    places = f"{CACHE}={asked}" if asked else "neither the program's folder nor the user's cache folder"
    print(
        f"note: {places} cannot be written; compiled code is kept in {folder}, and compiled again where that is gone"
        f" (set {CACHE} to a folder that stays)",
        file=sys.stderr,
    )


def _own_folder(temporary: Path) -> Path:
    """A folder that nobody else can write: numba runs what it finds there.

    It has the same name for every process of the user; where somebody else holds that name, a new one is made.
    """
    user = os.getuid() if hasattr(os, "getuid") else None
    folder = temporary / f"en4dvar-numba-{'user' if user is None else user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    foreign = user is not None and (found.st_uid != user or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    if foreign or not stat.S_ISDIR(found.st_mode) or not os.access(folder, os.W_OK):
        return Path(tempfile.mkdtemp(prefix="en4dvar-numba-", dir=temporary))
    return folder
