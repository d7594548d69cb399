"""Executors on this machine: this process, threads, spawned processes."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any

from en4dvar.executor.base import ATTEMPTS_ALONE, Executor, T, WorkerLostError
from en4dvar.executor.blas import one_blas_thread_for_good
from en4dvar.executor.chunks import Outcome, kept, run_chunk
from en4dvar.executor.limits import NO_LIMITS, Limits, apply_limits
from en4dvar.forward import ForwardModel
from en4dvar.state import Array

Call = tuple[Any, ...]


class SerialExecutor(Executor):
    """Everything in this process, one call after the other."""

    def map(self, function: Callable[..., T], calls: Iterable[Call]) -> Iterator[tuple[int, T | Exception]]:
        for i, call in enumerate(calls):
            try:
                value: T | Exception = function(*call)
            except Exception as error:
                value = error
            yield i, value

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """As they come from the model: nothing is cut, nothing is collected."""
        return run_chunk(model, x, times)

    def close(self) -> None:
        """Nothing to release."""


class _PoolExecutor(Executor):
    """The pool is started at first use and lives until :meth:`close`."""

    limits: Limits = NO_LIMITS

    def __init__(self, workers: int):
        if workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers}")
        self.workers = workers
        self._pool: ThreadPoolExecutor | ProcessPoolExecutor | None = None

    def _start(self) -> ThreadPoolExecutor | ProcessPoolExecutor:
        raise NotImplementedError

    def _submit(self, function: Callable[..., T], call: Call) -> Future[T]:
        if self._pool is None:
            self._pool = self._start()
        try:
            return self._pool.submit(function, *call)
        except BrokenProcessPool:  # an idle worker died; calls under way learn it from their futures
            self.close()
            return self._submit(function, call)

    def map(self, function: Callable[..., T], calls: Iterable[Call]) -> Iterator[tuple[int, T | Exception]]:
        queue = enumerate(calls)
        pending: dict[Future[T], tuple[int, Call]] = {}
        try:
            while True:
                while len(pending) < 2 * self.workers and (following := next(queue, None)) is not None:
                    pending[self._submit(function, following[1])] = following
                if not pending:
                    return
                suspects: list[tuple[int, Call]] = []
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    i, call = pending.pop(future)
                    try:
                        yield i, future.result()
                    except BrokenProcessPool:
                        suspects.append((i, call))
                    except Exception as error:
                        yield i, error
                if suspects:  # the death of one worker breaks the pool and takes every call in it along
                    suspects += pending.values()
                    pending.clear()
                    for i, call in sorted(suspects, key=lambda item: item[0]):
                        yield i, self._alone(function, call)
        finally:
            for future in pending:
                future.cancel()

    def _alone(self, function: Callable[..., T], call: Call) -> T | Exception:
        """Repeat a call with no other in the pool, so that it is known who is to blame."""
        for _ in range(ATTEMPTS_ALONE):
            self.close()
            try:
                return self._submit(function, call).result()
            except BrokenProcessPool:
                continue
            except Exception as error:
                return error
        self.close()
        return WorkerLostError(self.limits.death)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None


class ThreadsExecutor(_PoolExecutor):
    """Threads of this process, for models whose ``trajectories`` release the interpreter lock (``compiled``)."""

    def _start(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.workers, thread_name_prefix="en4dvar")

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """As of any executor; a model that can share a batch among threads is prepared once, in the calling thread.

        A forecast takes 1 ms: threads that contend for the interpreter, and one more to wake, would be a third of it.
        """
        try:
            shared = model.share(x, times)
            if shared is None:
                return super().trajectories(model, x, times)
            helpers = [self._submit(shared.work, ()) for _ in range(min(self.workers, -(-len(x) // model.batch)) - 1)]
            shared.work()
            for helper in helpers:
                helper.result()
            results = kept(shared.results())
        except Exception:  # told member by member
            results = []
        return results if len(results) == len(x) else super().trajectories(model, x, times)


class ProcessesExecutor(_PoolExecutor):
    """Fresh (spawned) processes, within ``limits``; the model must be picklable and importable."""

    def __init__(self, workers: int, limits: Limits = NO_LIMITS):
        super().__init__(workers)
        self.limits = limits

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self.workers, mp_context=get_context("spawn"), initializer=prepare_worker, initargs=(self.limits,)
        )

    def kill(self) -> None:
        if isinstance(self._pool, ProcessPoolExecutor):
            # Python 3.14 has kill_workers(); until then the processes are only found here
            for process in list((self._pool._processes or {}).values()):
                process.kill()
        self.close()


def prepare_worker(limits: Limits = NO_LIMITS) -> None:
    """Ctrl-C is the main process's business, BLAS uses one thread, and nobody works for a main process that is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_blas_thread_for_good()
    apply_limits(limits)
    threading.Thread(target=_end_with_parent, name="en4dvar-parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
