"""BLAS in one thread: sums in one order, whatever the machine, and faster at these sizes."""

from __future__ import annotations

import functools
import threading
from contextlib import AbstractContextManager
from typing import Any, ClassVar


@functools.cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()  # looks through every loaded library: once is enough


class OneThread(AbstractContextManager[None]):
    """The limit belongs to the process: while one context holds it, others, of any thread, have nothing to do."""

    _lock: ClassVar[threading.Lock] = threading.Lock()
    _held: ClassVar[bool] = False

    def __enter__(self) -> None:
        self._limit: Any = None
        with OneThread._lock:
            if not OneThread._held:
                self._limit = _controller().limit(limits=1, user_api="blas")
                self._limit.__enter__()
                OneThread._held = True

    def __exit__(self, *error: object) -> None:
        if self._limit is not None:
            with OneThread._lock:
                self._limit.__exit__(None, None, None)
                OneThread._held = False


def one_blas_thread() -> OneThread:
    """Context in which BLAS uses one thread.

    Where several threads enter, one context around all of them must stay open.
    """
    return OneThread()


@functools.cache
def one_blas_thread_for_good() -> None:
    """For processes that serve nothing else."""
    one_blas_thread().__enter__()
