"""Where work runs: in this process, in threads, in processes, on a dask cluster. The numbers do not depend on it."""

from en4dvar.executor.base import Executor, ExecutorError, WorkerLostError
from en4dvar.executor.blas import one_blas_thread
from en4dvar.executor.chunks import Outcome, cut, describe, run_chunk
from en4dvar.executor.local import ProcessesExecutor, SerialExecutor, ThreadsExecutor
from en4dvar.forward import ForwardModel

__all__ = [
    "Executor",
    "ExecutorError",
    "Outcome",
    "ProcessesExecutor",
    "SerialExecutor",
    "ThreadsExecutor",
    "WorkerLostError",
    "cut",
    "describe",
    "make_executor",
    "one_blas_thread",
    "run_chunk",
]


def make_executor(model: ForwardModel, workers: int = 1) -> Executor:
    """The executor of this machine that serves ``model`` with ``workers`` workers."""
    if workers == 1:
        return SerialExecutor()
    return ThreadsExecutor(workers) if model.compiled else ProcessesExecutor(workers)
