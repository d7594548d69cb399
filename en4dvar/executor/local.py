"""Executors within this process: itself, and threads."""

from __future__ import annotations

import functools
import itertools
import queue
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from en4dvar.executor.base import Executor, Hear, T
from en4dvar.executor.chunks import Outcome, kept, run_chunk
from en4dvar.forward import ForwardModel
from en4dvar.state import Array

Call = tuple[Any, ...]


class SerialExecutor(Executor):
    """Everything in this process, one call after the other."""

    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        for i, call in enumerate(calls):
            try:
                value: T | Exception = function(*call, *([functools.partial(hear, i)] if hear else []))
            except Exception as error:
                value = error
            yield i, value

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """As they come from the model: nothing is cut, nothing is collected."""
        return run_chunk(model, x, times)

    def close(self) -> None:
        """Nothing to release."""


class ThreadsExecutor(Executor):
    """Threads of this process, for models whose ``trajectories`` release the interpreter lock (``compiled``).

    They are started at first use and live until :meth:`close`.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers}")
        self.workers = workers
        self._pool: ThreadPoolExecutor | None = None

    def _submit(self, function: Callable[..., T], call: Call) -> Future[T]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.workers, thread_name_prefix="en4dvar")
        return self._pool.submit(function, *call)

    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        news: queue.SimpleQueue[Future[T] | tuple[int, Any]] = queue.SimpleQueue()  # calls that ended; what they tell
        following = enumerate(calls)
        pending: dict[Future[T], int] = {}

        def teller(i: int) -> Callable[[Any], None]:
            return lambda message: news.put((i, message))

        try:
            while True:
                for i, call in itertools.islice(following, max(0, 2 * self.workers - len(pending))):
                    future = self._submit(function, (*call, *([teller(i)] if hear else [])))
                    pending[future] = i
                    future.add_done_callback(news.put)
                if not pending:
                    return
                item = news.get()
                if not isinstance(item, Future):
                    if hear:
                        hear(*item)
                    continue
                i = pending.pop(item)
                try:
                    yield i, item.result()
                except Exception as error:
                    yield i, error
        finally:
            for future in pending:
                future.cancel()

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

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None
