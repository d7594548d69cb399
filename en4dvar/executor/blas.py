"""BLAS in one thread: sums in one order, whatever the machine, and faster at these sizes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any


@functools.cache
def _limiter() -> Callable[[], AbstractContextManager[Any]]:
    from threadpoolctl import ThreadpoolController

    controller = ThreadpoolController()  # looks through every loaded library: once is enough
    return lambda: controller.limit(limits=1, user_api="blas")


def one_blas_thread() -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread.

    The limit belongs to the process: where several threads enter, one context around all of them must stay open.
    """
    return _limiter()()


@functools.cache
def one_blas_thread_for_good() -> None:
    """For processes that serve nothing else."""
    _limiter()().__enter__()
