"""Ctrl-C, SIGTERM and SIGHUP: the run stops, keeps what it has, and says how to go on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Interrupted(KeyboardInterrupt):
    """An interrupt of a run that has begun and can be resumed, with what was kept."""


@contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Within, SIGTERM (a batch system's time limit) and SIGHUP (the terminal is gone) act like Ctrl-C.

    Only the main thread can arrange it. A signal that is ignored, as under ``nohup``, stays so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
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
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {kept()}") from None


def begun(error: BaseException | None) -> Interrupted | None:
    """The interrupt of a run that has begun, itself or below a second Ctrl-C that came while it was being answered."""
    while error is not None and not isinstance(error, Interrupted):
        error = error.__context__
    return error
