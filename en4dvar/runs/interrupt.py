"""Ctrl-C and SIGTERM: the run stops, keeps what it has, and says how to go on."""

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
    """Within, SIGTERM (a batch system's time limit) acts like Ctrl-C; only the main thread can arrange it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt("terminated")

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def tell_interrupt(kept: Callable[[], str]) -> Iterator[None]:
    """Within, an interrupt that nobody has put into words becomes :class:`Interrupted`, with what is ``kept`` then."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {kept()}") from None
