"""Where members run: in this process, in threads, in other processes. The numbers do not depend on the choice.

Members are cut into chunks at multiples of ``model.batch``, so every compiled batch holds the same members for any
number of workers, and results return in the order of the members. An exception is a
:class:`~en4dvar.forward.Failure` of the batch that raised it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import Executor as Pool
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from en4dvar.forward import Failure, ForwardModel, Trajectory
from en4dvar.state import Array

Outcome = Trajectory | Failure


class Executor(Protocol):
    """Runs members of a forward model."""

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> list[Outcome]:
        """Initial states (B, n_state) and times (B, K) → B trajectories or failures, in the order of the members."""


class SerialExecutor:
    """All members in this process, in one call of the model."""

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> list[Outcome]:
        return run_chunk(model, x, times)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """Nothing to release."""


class _PoolExecutor:
    """Chunks of members, one per worker; the pool is started at first use and lives until :meth:`close`."""

    def __init__(self, workers: int):
        if workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers}")
        self.workers = workers
        self._pool: Pool | None = None

    def _start(self) -> Pool:
        raise NotImplementedError

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> list[Outcome]:
        if self._pool is None:
            self._pool = self._start()
        times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        chunks = cut(len(x), model.batch, self.workers)
        futures = []
        results: list[Outcome] = []
        try:
            futures = [self._pool.submit(run_chunk, model, x[part], times[part]) for part in chunks]
            for part, future in zip(chunks, futures, strict=True):
                try:
                    results += future.result()
                except BrokenProcessPool:
                    raise
                except Exception as error:  # e.g. a result that cannot be pickled
                    results += [Failure(describe(error))] * (part.stop - part.start)
        except BrokenProcessPool:
            self.close()  # the next call starts a new pool
            lost = len(x) - len(results)
            results += [Failure("a worker process died")] * lost
        return results

    def close(self) -> None:
        """Stop the workers."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


class ThreadsExecutor(_PoolExecutor):
    """Threads of this process, for models whose ``trajectories`` release the interpreter lock (``compiled``)."""

    def _start(self) -> Pool:
        return ThreadPoolExecutor(self.workers, thread_name_prefix="en4dvar")


class ProcessesExecutor(_PoolExecutor):
    """Fresh (spawned) processes; the model must be picklable and importable."""

    def _start(self) -> Pool:
        return ProcessPoolExecutor(self.workers, mp_context=get_context("spawn"), initializer=_one_thread_for_good)


def make_executor(model: ForwardModel, workers: int = 1) -> SerialExecutor | ThreadsExecutor | ProcessesExecutor:
    """The executor that serves ``model`` with ``workers`` workers; use it as a context manager."""
    if workers == 1:
        return SerialExecutor()
    return ThreadsExecutor(workers) if model.compiled else ProcessesExecutor(workers)


def cut(n_members: int, batch: int, workers: int) -> list[slice]:
    """Contiguous chunks of members, at most one per worker, each but the last a multiple of ``batch``.

    >>> cut(10, 4, 2)
    [slice(0, 8, None), slice(8, 10, None)]
    """
    batches = -(-n_members // batch)
    edges = [min(n_members, batch * -(-batches * i // min(workers, batches))) for i in range(min(workers, batches) + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def run_chunk(model: ForwardModel, x: Array, times: Array) -> list[Outcome]:
    """Run a chunk; where the model raises, run its batches one by one, so that only a raising batch is lost."""
    times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
    try:
        outcomes = list(model.trajectories(x, times))
        reason = f"the model returned {len(outcomes)} trajectories for {len(x)} members"
    except Exception as error:  # a model may fail in any way; the reason is kept
        outcomes, reason = [], describe(error)
    if len(outcomes) == len(x):
        return outcomes
    if len(x) <= model.batch:
        return [Failure(reason)] * len(x)
    parts = [slice(i, i + model.batch) for i in range(0, len(x), model.batch)]
    return [outcome for part in parts for outcome in run_chunk(model, x[part], times[part])]


def describe(error: BaseException) -> str:
    """An exception as the reason of a failure."""
    return f"{type(error).__name__}: {error}"


@functools.cache
def _blas_limiter() -> Callable[[], AbstractContextManager[Any]]:
    from threadpoolctl import ThreadpoolController

    controller = ThreadpoolController()  # looks through every loaded library: once is enough
    return lambda: controller.limit(limits=1, user_api="blas")


def one_blas_thread() -> AbstractContextManager[Any]:
    """Context in which BLAS uses one thread: sums in one order, whatever the machine, and faster at these sizes."""
    return _blas_limiter()()


def _one_thread_for_good() -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


__all__: Sequence[str] = (
    "Executor",
    "ProcessesExecutor",
    "SerialExecutor",
    "ThreadsExecutor",
    "make_executor",
    "one_blas_thread",
)
