"""Executors within this process, and what those share whose calls end as futures: in threads, processes, a cluster."""

import functools
import itertools
import queue
import threading
import time
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from en4dvar.executor.base import (
    Call,
    Executor,
    Hear,
    Outcome,
    T,
    Tell,
    WorkerLostError,
    kept,
    run_chunk,
    without_warnings,
)
from en4dvar.model.forward import ForwardModel
from en4dvar.model.state import Array
from en4dvar.plumbing.children import HaltedError, end_those_of, raise_in, starts_again
from en4dvar.plumbing.user_code import own_fault

MOMENT, PATIENCE = 0.05, 1.0  # s for threads to end by themselves, and once they are told to
Events = queue.SimpleQueue[Any]  # futures that ended, and (index, message) of what calls tell


class SerialExecutor(Executor):
    """Everything in this process, one call after the other."""

    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        for i, call in enumerate(calls):
            try:
                value: T | Exception = function(*call, *([functools.partial(hear, i)] if hear else []))
            except BaseException as error:
                value = own_fault(error)
            yield i, value

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """The trajectories as they come from the model: nothing is cut, nothing is collected."""
        return run_chunk(model, x, times)

    def close(self) -> None:
        """Nothing to release."""


class FuturesExecutor(Executor):
    """Keeps two calls a worker under way; what they tell and their ends arrive in one queue, in order.

    A future is anything with ``add_done_callback``. A call whose worker died is repeated when nothing else is under
    way, for calls around it may have been the reason; after ``attempts`` it is held responsible.
    """

    attempts = 2

    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        events: Events = queue.SimpleQueue()
        following = enumerate(calls)
        pending: dict[Any, tuple[int, Call]] = {}
        lost: deque[tuple[int, Call]] = deque()
        deaths: Counter[int] = Counter()

        def submit(i: int, call: Call) -> None:
            future = self._submit(function, call, (lambda message: events.put((i, message))) if hear else None)
            pending[future] = i, call
            future.add_done_callback(events.put)

        try:
            while True:
                for i, call in itertools.islice(following, max(0, 2 * self.workers - len(pending))):
                    submit(i, call)
                if not pending and lost:
                    submit(*lost.popleft())
                if not pending:
                    return
                event = self._next(events)
                if isinstance(event, tuple):
                    if hear:
                        hear(*event)
                    continue
                i, call = pending.pop(event)
                value = self._value(event)
                if isinstance(value, WorkerLostError):
                    deaths[i] += 1
                    if deaths[i] < self.attempts:
                        lost.append((i, call))
                        continue
                yield i, value
        finally:
            self._give_up(pending)

    @abstractmethod
    def _submit(self, function: Callable[..., T], call: Call, tell: Tell | None) -> Any:
        """The future of ``function(*call)``, or of ``function(*call, tell)``."""

    def _next(self, events: Events) -> Any:
        return events.get()

    @abstractmethod
    def _value(self, future: Any) -> Any:
        """The result, or the exception, of the call of a future that ended."""

    @abstractmethod
    def _give_up(self, futures: Collection[Any]) -> None:
        """Nobody waits any more for what these calls give."""


class PoolExecutor(FuturesExecutor):
    """Calls in threads of this process, which are started at first use and live until :meth:`close`."""

    def __init__(self, workers: int):
        if workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers}")
        self.workers = workers
        self._pool: ThreadPoolExecutor | None = None

    def _submit(self, function: Callable[..., T], call: Call, tell: Tell | None) -> Future[T]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.workers, thread_name_prefix="en4dvar")
        return self._pool.submit(function, *call, *([tell] if tell else []))

    def _value(self, future: Future[T]) -> T | Exception:
        try:
            return future.result()
        except BaseException as error:
            return own_fault(error)

    def _give_up(self, futures: Collection[Future[Any]]) -> None:
        for future in futures:
            future.cancel()

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def kill(self) -> None:
        """Stop the threads, whatever they are doing: a program is ended, Python code raises, other code is left alone.

        What is left alone is waited for :data:`PATIENCE` seconds, and ends this process no later than itself; the
        command line does not wait for it (:func:`en4dvar.cli.main`).
        """
        pool, self._pool = self._pool, None
        if pool is None:
            return
        pool.shutdown(wait=False, cancel_futures=True)
        threads = {thread.ident: thread for thread in pool._threads if thread.ident is not None}
        end_those_of(threads)
        _join(threads.values(), MOMENT)
        for number in [number for number, thread in threads.items() if thread.is_alive()]:
            raise_in(number, HaltedError)
        _join(threads.values(), PATIENCE)
        starts_again([number for number, thread in threads.items() if not thread.is_alive()])


class ThreadsExecutor(PoolExecutor):
    """Threads of this process, for models whose ``trajectories`` release the interpreter lock (``compiled``)."""

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """As of any executor; a model that can share a batch among threads is prepared once, in the calling thread.

        A forecast takes 1 ms: threads that contend for the interpreter, and one more to wake, would be a third of it.
        """
        try:
            with without_warnings():
                if (shared := model.share(x, times)) is not None:
                    helpers = min(self.workers, -(-len(x) // model.batch)) - 1
                    futures = [self._submit(shared.work, (), None) for _ in range(helpers)]
                    shared.work()
                    for future in futures:
                        future.result()
                    if len(results := kept(shared.results())) == len(x):
                        return results
        except BaseException as error:  # told member by member
            own_fault(error)
        return super().trajectories(model, x, times)


def _join(threads: Collection[threading.Thread], seconds: float) -> None:
    """Wait for threads to end, not longer than so many seconds for all of them."""
    end = time.monotonic() + seconds
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
