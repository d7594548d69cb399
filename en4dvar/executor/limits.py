"""What a forward model may take in a worker process: time for a batch of members, memory for the process.

A batch past its time is interrupted, as Ctrl-C would; where its code never returns to the interpreter (a compiled loop;
on dask, where calls are not in the main thread, also a system call), the process is ended instead. While a process is
suspended the time does not count; after more than twice the limit it may be ended as it continues, and its call is
repeated. Memory is the size of the data segment (Linux) beyond what the process had at its start; an allocation past it
raises MemoryError, or ends a process whose compiled code does not check. Either way the members have failed, with the
reason, and the run goes on. Other executors share the process of the run, which cannot be ended: they know no limits.

BLAS uses one thread: sums in one order, whatever the machine, and faster at these sizes.
"""

import faulthandler
import functools
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from en4dvar.plumbing.children import TimeLimitError as TimeLimitError
from en4dvar.plumbing.children import limit_memory, within

T = TypeVar("T")
_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30, "Ti": 2**40}
_BYTES = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(k|M|G|T|Ki|Mi|Gi|Ti)?B\s*")


@dataclass(frozen=True)
class Limits:
    """``seconds`` for a batch of members, ``memory`` in bytes for a worker process; None: no limit."""

    seconds: float | None = None
    memory: int | None = None

    def __bool__(self) -> bool:
        return self.seconds is not None or self.memory is not None

    @property
    def death(self) -> str:
        """What is known where a worker process is gone."""
        ended = [] if self.seconds is None else [f"its time limit of {self.seconds:g} s"]
        ended += [] if self.memory is None else [f"its memory limit of {self.memory / 1e9:g} GB"]
        return f"a worker process died{', or was ended at ' if ended else ''}{' or '.join(ended)}"


NO_LIMITS = Limits()


def parse_bytes(text: object) -> int:
    """A size of memory. Raises :class:`ValueError`.

    >>> parse_bytes("1.5 GB"), parse_bytes("512 MiB")
    (1500000000, 536870912)
    """
    match = _BYTES.fullmatch(text) if isinstance(text, str) else None
    if match is None or float(match[1]) == 0:
        raise ValueError(f"{text!r} is not a size of memory; write e.g. 2 GB")
    return int(float(match[1]) * _UNITS[match[2] or ""])


MOMENT = 0.01  # s
_limits = NO_LIMITS  # of this process
_deadlines: dict[int, float] = {}  # thread → when its process is ended, on the monotonic clock
_arming = threading.Lock()
_changing = threading.Lock()  # of BLAS
_held = False  # its limit belongs to the process: while one context holds it, those of any thread have nothing to do


@functools.cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()  # looks through every loaded library: once is enough


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Context in which BLAS uses one thread.

    Where several threads enter, one context around all of them must stay open.
    """
    global _held
    limit = None
    with _changing:
        if not _held:
            limit = _controller().limit(limits=1, user_api="blas")
            _held = True
    try:
        yield
    finally:
        if limit is not None:
            with _changing:
                limit.restore_original_limits()
                _held = False


def apply_limits(limits: Limits) -> None:
    """Make them hold in this process, which is a worker, with one thread of BLAS; a repetition changes nothing."""
    global _limits, _held
    with _changing:
        if not _held:
            _controller().limit(limits=1, user_api="blas")
            _held = True
    if limits == _limits:
        return
    _limits = limits
    if limits.memory is not None:
        limit_memory(limits.memory)


def has_time_limit() -> bool:
    """True if batches are timed in this process, and so have to be run one by one."""
    return _limits.seconds is not None


def within_time_limit(batch: Callable[[], T]) -> T:
    """What ``batch()`` returns. Raises :class:`TimeLimitError` past the limit; past twice the time the process ends."""
    seconds = _limits.seconds
    if seconds is None:
        return batch()
    by_signal = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    _watch(seconds)
    try:
        return within(seconds, batch, _Signal() if by_signal else None)
    except TimeLimitError:
        raise TimeLimitError(f"not done after {seconds:g} s") from None
    finally:
        _watch(None)


class _Signal:
    """Raises :class:`TimeLimitError` in the main thread.

    A process that was suspended (Ctrl-Z) has the time anew when it continues. Its alarm has gone on meanwhile and is
    heard first, so that each alarm is asked for once more, a moment later, before it counts.
    """

    def start(self, seconds: float) -> None:
        self.seconds, self.armed, self.certain = seconds, True, False
        signal.signal(signal.SIGALRM, self._raise)
        signal.signal(signal.SIGCONT, self._continue)
        signal.setitimer(signal.ITIMER_REAL, seconds)

    def _raise(self, *_: Any) -> None:
        if self.armed and self.certain:
            raise TimeLimitError
        if self.armed:
            self.certain = True
            signal.setitimer(signal.ITIMER_REAL, MOMENT)

    def _continue(self, *_: Any) -> None:
        if self.armed:
            self.certain = False
            _watch(self.seconds)
            signal.setitimer(signal.ITIMER_REAL, self.seconds)

    def stop(self) -> None:
        self.armed = False
        signal.setitimer(signal.ITIMER_REAL, 0)


def _watch(seconds: float | None) -> None:
    """End this process if a batch of this thread that begins now, and has so many seconds, does not; None: it ended."""
    with _arming:
        _deadlines.pop(threading.get_ident(), None)
        if seconds is not None:
            _deadlines[threading.get_ident()] = time.monotonic() + 2 * seconds + 1
        faulthandler.cancel_dump_traceback_later()
        if _deadlines:
            left = max(min(_deadlines.values()) - time.monotonic(), 0.01)
            # of the C library's own thread, so that it comes even where the interpreter is held for good
            faulthandler.dump_traceback_later(left, exit=True, file=_nowhere())


@functools.cache
def _nowhere() -> int:
    """A file that the traceback of the dying process goes to."""
    return os.open(os.devnull, os.O_WRONLY)
