"""BLAS in one thread: sums in one order, whatever the machine, and faster at these sizes."""

import functools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_changing = threading.Lock()
_held = False  # the limit belongs to the process: while one context holds it, those of any thread have nothing to do


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


@functools.cache
def one_blas_thread_for_good() -> None:
    """For processes that serve nothing else."""
    global _held
    with _changing:
        _controller().limit(limits=1, user_api="blas")
        _held = True
