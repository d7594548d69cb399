"""Where work runs: in this process, in threads, in processes, on a dask cluster. The numbers do not depend on it."""

import os
from typing import Literal

from en4dvar.executor.base import (
    Executor,
    ExecutorError,
    Outcome,
    SerialExecutor,
    ThreadsExecutor,
    WorkerLostError,
    cut,
    run_chunk,
)
from en4dvar.executor.limits import NO_LIMITS, Limits, TimeLimitError, one_blas_thread
from en4dvar.executor.processes import ProcessesExecutor
from en4dvar.model.forward import ForwardModel

__all__ = [
    "Executor", "ExecutorError", "Limits", "Outcome", "ProcessesExecutor", "SerialExecutor", "ThreadsExecutor",
    "TimeLimitError", "WorkerLostError", "available_cores", "choose_executor", "cut", "one_blas_thread", "run_chunk",
]  # fmt: skip


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def choose_executor(
    model: ForwardModel,
    kind: Literal["serial", "threads", "processes", "dask"] | None = None,
    workers: int | None = None,
    address: str | None = None,
    limits: Limits = NO_LIMITS,
) -> Executor:
    """The executor that is asked for; by default threads on every core for compiled models and programs, else this
    process alone.

    With ``limits`` the default are processes, the only workers of this machine that can be held to them.

    Raises ExecutorError: the dask cluster at ``address`` cannot be reached, or dask is not installed.
    """
    if limits and kind is None and address is None:
        kind = "processes"
    if workers is None and address is None:
        workers = available_cores() if kind or model.threaded else 1
    if kind == "dask" or address is not None:
        from en4dvar.executor.dask import DaskExecutor

        return DaskExecutor(workers, address, limits)
    if kind is None:
        kind = "serial" if workers == 1 else "threads" if model.threaded else "processes"
    if kind == "serial":
        return SerialExecutor()
    return ThreadsExecutor(workers or 1) if kind == "threads" else ProcessesExecutor(workers or 1, limits)
