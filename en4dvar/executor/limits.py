"""What a forward model may take in a worker process: time for a batch of members, memory for the process.

A batch past its time is interrupted by an alarm, as Ctrl-C would; where its code never returns to the interpreter (a
compiled loop), or where the call is not in the main thread of its process (dask), the process is ended instead. Memory
is the size of the data segment (Linux) beyond what the process had at its start; an allocation past it raises
MemoryError, or ends a process whose compiled code does not check. Either way the members have failed, with the reason,
and the run goes on. Other executors share the process of the run, which cannot be ended: they know no limits.
"""

from __future__ import annotations

import faulthandler
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


class TimeLimitError(BaseException):
    """A batch is past its time. Not an :class:`Exception`, so that no model takes it for one of its own."""


def parse_bytes(text: object) -> int:
    """A size of memory. Raises :class:`ValueError`.

    >>> parse_bytes("1.5 GB"), parse_bytes("512 MiB")
    (1500000000, 536870912)
    """
    found = _BYTES.fullmatch(text) if isinstance(text, str) else None
    if found is None or float(found[1]) == 0:
        raise ValueError(f"{text!r} is not a size of memory; write e.g. 2 GB")
    return int(float(found[1]) * _UNITS[found[2] or ""])


_limits = NO_LIMITS  # of this process
_deadlines: dict[int, float] = {}  # thread → when its process is ended, on the monotonic clock
_arming = threading.Lock()


def apply_limits(limits: Limits) -> None:
    """Make them hold in this process, which is a worker. Once; a repetition changes nothing."""
    global _limits
    if limits == _limits:
        return
    _limits = limits
    if limits.memory is not None and sys.platform == "linux":
        import resource

        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        held = int(status.partition("VmData:")[2].split()[0]) * 1024
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        allowed = held + limits.memory
        resource.setrlimit(resource.RLIMIT_DATA, (allowed if hard < 0 else min(allowed, hard), hard))


def has_time_limit() -> bool:
    """Whether batches are timed in this process, and so have to be run one by one."""
    return _limits.seconds is not None


@contextmanager
def time_limit() -> Iterator[None]:
    """Around one batch. Raises :class:`TimeLimitError` past the limit, or ends the process after twice the time."""
    seconds = _limits.seconds
    if seconds is None:
        yield
        return
    alarm = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()

    def stop(*_: Any) -> None:
        raise TimeLimitError(f"not done after {seconds:g} s")

    _watch(time.monotonic() + (2 * seconds + 1 if alarm else seconds))
    try:
        if alarm:
            signal.signal(signal.SIGALRM, stop)
            signal.setitimer(signal.ITIMER_REAL, seconds)
        yield
    finally:
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, 0)
        _watch(None)


def _watch(deadline: float | None) -> None:
    """End this process at ``deadline`` of this thread, if it comes to that; None: it did not."""
    with _arming:
        _deadlines.pop(threading.get_ident(), None)
        if deadline is not None:
            _deadlines[threading.get_ident()] = deadline
        faulthandler.cancel_dump_traceback_later()
        if _deadlines:
            left = max(min(_deadlines.values()) - time.monotonic(), 0.01)
            # of the C library's own thread, so that it comes even where the interpreter is held for good
            faulthandler.dump_traceback_later(left, exit=True, file=_nowhere())


def _nowhere() -> int:
    """A file that the traceback of the dying process goes to."""
    global _sink
    if _sink is None:
        _sink = os.open(os.devnull, os.O_WRONLY)
    return _sink


_sink: int | None = None
