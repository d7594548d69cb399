"""Kernels: functions that numba compiles once and keeps on disk (:mod:`en4dvar.plumbing.kernel_cache`)."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numba
from numba.core.event import Listener, install_listener

from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.kernel_cache import compile_once, keep

F = TypeVar("F", bound=Callable[..., Any])
_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
KERNELS: list[Any] = []
"""Every kernel that has been declared so far in this process."""


def kernel(function: F) -> F:
    """``function`` compiled by numba, kept on disk, without the interpreter's lock.

    Raises
    ------
    OutputError: nowhere can compiled code be kept.
    """
    return _compiled(function, numba.njit(nogil=True))


def kernel_without_allocation(function: F) -> F:
    """A :func:`kernel` that makes no arrays: no references to them need be counted."""
    options: dict[str, Any] = {"_nrt": False}  # which numba's annotations leave out
    return _compiled(function, numba.njit(nogil=True, **options))


def kernel_called_by_address(function: F) -> F:
    """A :func:`kernel_without_allocation` that only other kernels call, with the numbers that IEEE 754 gives a division
    by zero.
    """
    options: dict[str, Any] = {"_nrt": False, **_NO_ENTRY}
    return _compiled(function, numba.njit(nogil=True, error_model="numpy", **options))


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


def _compiled(function: F, compile_: Callable[[F], Any]) -> F:
    if getattr(numba.config, "DISABLE_JIT", 0):
        raise ConfigError("NUMBA_DISABLE_JIT is set, but the solver's kernels run compiled alone; unset it")
    compiled: F = compile_(function)
    keep(compiled)
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
