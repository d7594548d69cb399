"""Ctrl-C, SIGTERM and SIGHUP: the run stops, keeps what it has, and says how to go on.

Python answers a signal between two of its instructions, and a forecast of compiled code may be one of them. On the
command line a thread therefore waits for signals as well (:func:`heeded`): what is done is on the disk at any moment,
so that the process may end wherever it stands.
"""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any

PATIENCE = 1.0  # s for the program to answer a signal by itself
AGAIN = 0.05  # s; here and now it would be raised where nothing can be, once more
_END = b"\0"  # number of no signal
_answered = threading.Event()
_kept: list[Callable[[], str]] = []  # what a stop has to say of the runs under way


class Interrupted(KeyboardInterrupt):
    """An interrupt of a run that has begun and can be resumed, with what was kept."""


@contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Within, SIGTERM (a batch system's time limit) and SIGHUP (the terminal is gone) act like Ctrl-C. Only the main
    thread can arrange it. A signal that is ignored, as under ``nohup``, stays so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        _answered.set()
        raise KeyboardInterrupt("terminated")

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {n: signal.signal(n, stop) for n in numbers if signal.getsignal(n) != signal.SIG_IGN}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def tell_interrupt(kept: Callable[[], str]) -> Iterator[None]:
    """Within, an interrupt that nobody has put into words becomes :class:`Interrupted`, with what is ``kept`` then."""
    _kept.append(kept)
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {kept()}") from None
    finally:
        _kept.remove(kept)


@contextmanager
def heeded(end: Callable[[str], object]) -> Iterator[None]:
    """Within, in the main thread: a stop that compiled code keeps the program from answering ends in ``end(words)``.

    One that arrives where nothing can be raised (the end of an object, some compiled code) is raised again behind it.
    ``end`` is called in a thread of its own, :data:`PATIENCE` after the signal, with what is kept, "" before a run has
    begun; it is to end the process.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or handler is not signal.default_int_handler:
        yield
        return

    def interrupt(*_: Any) -> None:
        _answered.set()
        raise KeyboardInterrupt

    _answered.clear()
    tell_ignored, tell_error = sys.unraisablehook, sys.excepthook

    def once_more(ignored: "sys.UnraisableHookArgs") -> None:
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            threading.Timer(AGAIN, _thread.interrupt_main).start()
        else:
            tell_ignored(ignored)

    def tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if not issubclass(kind, KeyboardInterrupt):  # compiled code that ignores it tells of it twice
            tell_error(kind, error, trace)

    come, written = os.pipe()
    if hasattr(os, "set_blocking"):
        os.set_blocking(written, False)
    listener = threading.Thread(target=_listen, args=(come, end), daemon=True)
    listener.start()
    before = signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook, sys.excepthook = once_more, tell
    try:
        yield
    finally:
        sys.unraisablehook, sys.excepthook = tell_ignored, tell_error
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(before)
        os.write(written, _END)  # a forked process may hold the pipe open
        os.close(written)
        listener.join()  # or it would look for its answer when another command waits for one


def _listen(come: int, end: Callable[[str], object]) -> None:
    """Wait for signals, whose numbers are written into a pipe as they come, until its end is written."""
    stops = {getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP")}
    with os.fdopen(come, "rb", buffering=0) as pipe:
        while (number := pipe.read(1)) != _END:
            if number[0] in stops and not _answered.wait(PATIENCE):
                words = ""
                with suppress(Exception):  # it is asked while the run goes on
                    words = f"interrupted; {_kept[-1]()}"
                end(words)


def begun(error: BaseException | None) -> Interrupted | None:
    """The interrupt of a run that has begun, itself or below a second Ctrl-C that came while it was being answered."""
    while error is not None and not isinstance(error, Interrupted):
        error = error.__context__
    return error
