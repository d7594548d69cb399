"""Processes that are started for one thing, a run of a program say, and never survive it.

A child begins a session of its own, so that it and whatever it starts can be ended together, and has one end of a pipe,
which tells whether anything it started is still there. It carries the mark of this process in its environment: what
left the session is found by it (Linux). A guard, one small process, waits for the end of this process, and then ends
what carries the mark and removes the scratch folders; it is what is left to do after a SIGKILL.

A thread waits for a child; :func:`end_those_of` ends the children of threads that are told to stop.
"""

import ctypes
import os
import secrets
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any, TypeVar

from en4dvar.plumbing.files import POSIX, owner, temporary_folder
from en4dvar.plumbing.user_code import Stop

resource = import_module("resource") if POSIX else None
T = TypeVar("T")
MARK = "EN4DVAR_STARTED_BY"
_BORN = secrets.token_hex(8)
PATIENCE = 1.0  # s for processes to be gone that were killed
_children: "dict[int, Child]" = {}  # thread → what it waits for
_stopped: set[int] = set()  # threads that start no child and no forecast any more
_changing = threading.Lock()


class TimeLimitError(Stop):
    """A call is past its time. Not an :class:`Exception`, so that no model takes it for one of its own."""


class HaltedError(Stop):
    """What this thread does is of no use any more."""


class Child:
    """A process, in ``folder``; used as a context manager, on leaving it is ended with everything it has started."""

    def __init__(
        self,
        words: Sequence[str] | str,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
        output: IO[bytes] | int = subprocess.DEVNULL,
        errors: IO[bytes] | int = subprocess.DEVNULL,
        input: IO[bytes] | int = subprocess.DEVNULL,
    ):
        # without a folder nothing is left behind; to look for the temporary one is to write there
        _guard(os.getpid(), Path(tempfile.gettempdir() if folder else os.sep))
        self.alive, held = os.pipe()
        try:
            self.process = subprocess.Popen(
                words,
                cwd=folder,
                env={**os.environ, **(environment or {}), MARK: _mark()},
                stdin=input,
                stdout=output,
                stderr=errors,
                start_new_session=True,
                pass_fds=(held,) if POSIX else (),
            )
        except BaseException:
            os.close(self.alive)
            raise
        finally:
            os.close(held)

    def __enter__(self) -> "Child":
        thread = threading.get_ident()
        with _changing:
            _children[thread] = self
            if thread in _stopped:
                self.kill()
        return self

    def forget(self) -> None:
        """This thread waits for it no more."""
        with _changing:
            _children.pop(threading.get_ident(), None)

    def __exit__(self, *_: object) -> None:
        self.forget()
        try:
            self.kill()
            self.process.wait()
            if POSIX and not _readable(self.alive, 0.0):  # nothing is written: somebody holds its other end
                self._end_what_escaped()
        finally:
            os.close(self.alive)

    def wait(self, seconds: float | None) -> int:
        """Its exit status. It is not yet forgotten by the system, so that its session cannot be anybody else's. Raises
        :class:`subprocess.TimeoutExpired`.
        """
        if not hasattr(os, "pidfd_open"):
            return self.process.wait(seconds)
        handle = os.pidfd_open(self.process.pid)
        try:
            if not _readable(handle, seconds):
                raise subprocess.TimeoutExpired(self.process.args, seconds or 0.0)
        finally:
            os.close(handle)
        self.kill()
        return self.process.wait()

    def kill(self) -> None:
        """End the process and those of its session."""
        if not POSIX:  # its children with it
            subprocess.run(["taskkill", "/F", "/T", "/PID", str(self.process.pid)], capture_output=True, check=False)
        elif self.process.returncode is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)

    def _end_what_escaped(self) -> None:
        """End what is in another session by now, by the mark in its environment and the pipe that it still holds."""
        end = time.monotonic() + PATIENCE
        pipe = os.fstat(self.alive).st_ino
        while not _readable(self.alive, 0.01) and time.monotonic() < end:
            for process in Path("/proc").glob("[0-9]*"):
                with suppress(OSError):
                    marked = _mark().encode() in (process / "environ").read_bytes()
                    if marked and any(os.stat(f).st_ino == pipe for f in (process / "fd").iterdir()):
                        os.kill(int(process.name), signal.SIGKILL)


def _readable(handle: int, seconds: float | None) -> bool:
    """Wait until a descriptor can be read, or a pipe has no other end any more; not longer than told."""
    poll = select.poll()
    poll.register(handle, select.POLLIN)
    return bool(poll.poll(None if seconds is None else max(0.0, seconds) * 1000))


def end_those_of(threads: Collection[int]) -> None:
    """End the children that these threads wait for, and those that they would start; see :func:`starts_again`."""
    with _changing:
        _stopped.update(threads)
        for thread in threads:
            if (child := _children.get(thread)) is not None:
                child.kill()


def starts_again(threads: Collection[int]) -> None:
    """Numbers of threads that have ended may be those of others."""
    with _changing:
        _stopped.difference_update(threads)


def require_going_on() -> None:
    """Raises :class:`HaltedError` in a thread that is to stop."""
    if threading.get_ident() in _stopped:
        raise HaltedError("stopped")


def status_named(status: int) -> str:
    """What ended a process, by its status."""
    if status >= 0:
        return f"exit status {status}"
    return f"signal {signal.Signals(-status).name if -status in set(signal.Signals) else -status}"


def limit_memory(size: int) -> None:
    """From now on, an allocation in this process beyond ``size`` bytes more than it has raises MemoryError (Linux).
    Compiled code that does not check ends the process.
    """
    if sys.platform == "linux" and resource:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        held = int(status.partition("VmData:")[2].split()[0]) * 1024
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        allowed = held + size
        resource.setrlimit(resource.RLIMIT_DATA, (allowed if hard < 0 else min(allowed, hard), hard))


def limit_time(seconds: int) -> None:
    """From now on, more processor time than this ends this process, without a dump of its memory."""
    if sys.platform != "win32" and resource:
        used = resource.getrusage(resource.RUSAGE_SELF)
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        allowed = int(used.ru_utime + used.ru_stime) + 1 + seconds
        resource.setrlimit(resource.RLIMIT_CPU, (allowed if hard < 0 else min(allowed, hard), hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def raise_in(thread: int, kind: type[BaseException] | None) -> None:
    """Raise in a thread, as soon as that runs Python; None: what was to be raised and was not yet."""
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), kind and ctypes.py_object(kind))


class ThreadAlarm:
    """Raises :class:`TimeLimitError` in the thread that starts it, as soon as that runs Python."""

    def start(self, seconds: float) -> None:
        self.armed, self.lock, self.thread = True, threading.Lock(), threading.get_ident()
        self.timer = threading.Timer(seconds, self._raise)
        self.timer.daemon = True
        self.timer.start()

    def _raise(self) -> None:
        with self.lock:
            if self.armed:
                raise_in(self.thread, TimeLimitError)

    def stop(self) -> None:
        self.timer.cancel()
        with self.lock:
            self.armed = False
        raise_in(self.thread, None)  # set, but not raised yet


def within(seconds: float, call: Callable[[], T], alarm: Any = None) -> T:
    """What ``call()`` returns. Raises :class:`TimeLimitError` past the time, where that is spent in Python.

    ``alarm`` raises it, by default a :class:`ThreadAlarm`. No context manager: an exception may come at any moment, in
    the manager's own ``__exit__`` too.
    """
    alarm = alarm or ThreadAlarm()
    try:
        try:
            alarm.start(seconds)
            return call()
        finally:
            alarm.stop()
    finally:
        alarm.stop()  # again, for the exception may have come while it was stopped; it comes once


@contextmanager
def scratch(parent: Path | None) -> Iterator[Path]:
    """An empty folder that is removed on leaving, or by the guard when this process is gone."""
    with temporary_folder(parent) as folder:
        _guard(os.getpid(), folder.parent)
        yield folder


@cache
def _guard(process: int, parent: Path) -> None:
    """Have what this process leaves behind ended and removed; started once for it and a parent of scratch folders."""
    if not POSIX:
        return
    here, _ = os.pipe()  # our end is closed by the system, however this process ends
    guard = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", _GUARD, MARK, _mark(), str(parent), f"en4dvar-{owner()}-"],
        stdin=here,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        cwd="/",
    )
    guard.returncode = 0  # nobody waits for it: it ends after this process
    os.close(here)


def _mark() -> str:
    return f"{os.getpid()}-{_BORN}"


_GUARD = """\
import os, shutil, signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
while os.read(0, 1):
    pass
mark, parent, prefix = os.fsencode("=".join(sys.argv[1:3])), *sys.argv[3:]
def marked():
    for name in os.listdir("/proc") if os.path.isdir("/proc") else ():
        try:
            with open("/proc/" + name + "/environ", "rb") as file:
                if mark in file.read().split(b"\\0"):
                    yield int(name)
        except (OSError, ValueError):
            pass
for _ in range(50):
    left = list(marked())
    for process in left:
        try:
            os.kill(process, signal.SIGKILL)
        except OSError:
            pass
    folders = [os.path.join(parent, name) for name in os.listdir(parent) if name.startswith(prefix)]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    if not left and not folders:
        break
    time.sleep(0.02)
"""
