"""Executors: members in chunks, the unit of work that is sent to a worker; those within this process; and what those
share whose calls end as futures: in threads, processes, a cluster.
"""

import functools
import itertools
import pickle
import queue
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, Self, TypeVar

import numpy as np

from en4dvar.executor.limits import TimeLimitError, has_time_limit, within_time_limit
from en4dvar.model.forward import Batch, Failure, ForwardModel, Trajectory
from en4dvar.model.state import Array, floats
from en4dvar.plumbing.children import HaltedError, end_those_of, raise_in, starts_again
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.units import unit_after
from en4dvar.plumbing.user_code import describe, loss_of, own_fault, reason_of

T = TypeVar("T")
Outcome = Trajectory | Failure
SAME_INSTANT = 1e-6  # of the largest: a time this close to the one asked for is it
Call = tuple[Any, ...]
Tell = Callable[[Any], None]  # what a call says while it runs: a message
Hear = Callable[[int, Any], None]  # who hears it: index of the call, message


class CommonValue(Generic[T]):
    """A value that is pickled once for all calls, and made again once in each worker process."""

    def __init__(self, value: T):
        self.value = value

    @functools.cached_property
    def _pickled(self) -> bytes:
        return pickle.dumps(self.value)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self._pickled,)


@functools.lru_cache(maxsize=2)
def _made_again(pickled: bytes) -> CommonValue[Any]:
    return CommonValue(pickle.loads(pickled))


def cut(n_members: int, batch: int, workers: int) -> list[slice]:
    """Contiguous chunks of members, at most one per worker, each but the last a multiple of ``batch``.

    >>> cut(10, 4, 2)
    [slice(0, 8, None), slice(8, 10, None)]
    """
    batches = -(-n_members // batch)
    edges = [min(n_members, batch * -(-batches * i // min(workers, batches))) for i in range(min(workers, batches) + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def run_chunk(model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
    """Run a chunk; where the model raises, run its batches one by one, so that only a raising batch is lost.

    Where batches are timed (see :mod:`en4dvar.executor.limits`) they are run one by one from the start.
    """
    if len(x) <= model.batch or not has_time_limit():
        try:
            with without_warnings():
                outcomes = within_time_limit(lambda: kept(model.trajectories(x, times)))
            if len(outcomes) == len(x):
                return as_asked(model, outcomes, times)
            reason = f"the model returned {len(outcomes)} trajectories for {len(x)} members"
        except TimeLimitError as error:
            reason = describe(error)
        except BaseException as error:  # a model may fail in any way; the reason is kept
            reason = loss_of(error)
        if len(x) <= model.batch:
            return [Failure(reason)] * len(x)
    times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
    parts = [slice(i, i + model.batch) for i in range(0, len(x), model.batch)]
    return [outcome for part in parts for outcome in run_chunk(model, x[part], times[part])]


def kept(outcomes: Sequence[Outcome]) -> Sequence[Outcome]:
    """A batch as it is, anything else as a list, empty where a model forgot to return."""
    return outcomes if isinstance(outcomes, Batch) else list(() if outcomes is None else outcomes)


def as_asked(model: ForwardModel, outcomes: Sequence[Outcome], times: Array) -> Sequence[Outcome]:
    """``outcomes`` of N members at ``times`` (K,) or (N, K); a member that is not at its own is a :class:`Failure`."""
    rows = np.broadcast_to(times + model._begins, (len(outcomes), np.shape(times)[-1]))
    if isinstance(outcomes, Batch) and not _off(outcomes.times, rows, model._begins).any():
        return outcomes
    of_all = [outcome.times for outcome in outcomes if isinstance(outcome, Trajectory)]
    if np.array_equal(of_all, rows):  # at once, for members are many
        return outcomes
    return [_own(model, outcome, row) for outcome, row in zip(outcomes, rows, strict=True)]


def _own(model: ForwardModel, outcome: Outcome, asked: Array) -> Outcome:
    """A member's outcome where it is at the times (K,) ``asked`` for."""
    if isinstance(outcome, Failure) or (isinstance(outcome, Trajectory) and np.array_equal(outcome.times, asked)):
        return outcome
    who = f"{model._who or f'{type(model).__name__}.trajectories'} gives"
    if not isinstance(outcome, Trajectory):
        kind = type(outcome).__name__
        return Failure(f"{who} items of type {kind}; give a Batch, or a Trajectory or Failure for each member")
    stated = np.ravel(floats(outcome.times))
    off = _off(stated, asked, model._begins)
    if not off.any():
        return outcome
    unit = unit_after(model.time_unit)
    odd, at = (
        f"{counted(len(t), 'time')} from {t[0]:.6g} to {t[-1]:.6g}{unit}" if len(t) else "no times"
        for t in (stated, asked)
    )
    k = np.argmax(off)
    first = f"; the first that differs is {stated[k]:.9g}, not {asked[k]:.9g}" if len(stated) == len(asked) else ""
    return Failure(f"{who} {odd}, asked for {at}{first}")


def _off(stated: Array, asked: Array, begins: float) -> Array:
    """Which times (…, K) are not those asked for; the beginning is any before it."""
    if np.shape(stated) != asked.shape:
        return np.ones(1)  # more of them, or fewer
    within: float = SAME_INSTANT * np.abs(asked).max(initial=0)
    off = np.minimum(np.abs(stated - asked), np.abs(stated - np.maximum(asked, begins)))
    return np.where(off <= within, 0.0, 1.0)


def without_warnings() -> np.errstate:
    """Within, numpy does not warn of an overflow, say: a member that it spoils fails, and says so itself.

    What a model sets is for the model alone.
    """
    quiet: dict[str, Any] = {kind: "ignore" for kind, told in np.geterr().items() if told == "warn"}
    return np.errstate(**quiet)


class WorkerLostError(Exception):
    """A worker died under a call, with no other call around that could be the reason, and again when retried."""


class ExecutorError(En4dvarError):
    """The workers cannot be reached; what is finished is kept and the run can be resumed."""


class Executor(ABC):
    """Runs calls on ``workers`` workers; use it as a context manager. The results do not depend on the choice."""

    workers: int = 1
    reads: bool = False  # whether calls run in processes that see the files of this one

    @abstractmethod
    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        """``function(*call)`` of every call, as they end: (index of the call, value or what it raised).

        ``calls`` is consumed as workers become free, so that neither calls nor values pile up. A call whose worker
        dies is repeated; :class:`WorkerLostError` is its value where it takes every worker down. ``function`` and calls
        can be pickled.

        With ``hear`` the calls tell while they run: they are ``function(*call, tell)``, and ``tell(message)`` there
        becomes ``hear(index of the call, message)`` here, in the thread that iterates, in order and before the call
        ends. Messages are small, few and picklable. A call that is repeated tells again.

        Raises ExecutorError: the workers cannot be reached.
        """

    def results(self, function: Callable[..., T], calls: Iterable[Call]) -> Iterator[tuple[int, T]]:
        """As :meth:`map`, of calls of which none may fail: raises what one of them raises."""
        for i, value in self.map(function, calls):
            if isinstance(value, Exception):
                raise value
            yield i, value

    def trajectories(self, model: ForwardModel, x: Array, times: Array) -> Sequence[Outcome]:
        """Initial states (B, n_state) and times (K,) or (B, K) → B trajectories or failures, in the order of members.

        Members are cut into chunks at multiples of ``model.batch``, so that every compiled batch holds the same
        members for any number of workers. A batch that kills its worker fails; the others are not disturbed.
        """
        times = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return self._chunks(model, x, times, cut(len(x), model.batch, self.workers))

    def _chunks(self, model: ForwardModel, x: Array, times: Array, chunks: list[slice]) -> list[Outcome]:
        outcomes = dict(self.map(run_chunk, ((model, x[part], times[part]) for part in chunks)))
        results: list[Outcome] = []
        for i, part in enumerate(chunks):
            outcome, size = outcomes[i], part.stop - part.start
            if not isinstance(outcome, Exception):
                results += outcome
            elif size > model.batch:
                batches = cut(size, model.batch, size)
                results += self._chunks(model, x[part], times[part], batches)
            else:
                reason = str(outcome) if isinstance(outcome, WorkerLostError) else reason_of(outcome)
                results += [Failure(reason)] * size
        return results

    def once(self, run: Callable[..., Any], *asked: Array) -> Any:
        """What ``run`` makes of arrays. An executor that has kept it, as a journal does, does not run it again."""
        return run(*asked)

    @abstractmethod
    def close(self) -> None:
        """Stop the workers and wait for them."""

    def kill(self) -> None:
        """Stop the workers at once, whatever they are doing."""
        self.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        self.close() if kind is None else self.kill()


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
            self._pool = ThreadPoolExecutor(self.workers, "en4dvar", lambda: starts_again([threading.get_ident()]))
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
        if (pool := self._pool) is None:
            return
        threads = {thread.ident: thread for thread in pool._threads if thread.ident is not None}
        end_those_of(threads)
        self._pool = None  # from here on they stop, also where another Ctrl-C comes
        pool.shutdown(wait=False, cancel_futures=True)
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
                        return as_asked(model, results, times)
        except BaseException as error:  # told member by member
            own_fault(error)
        return super().trajectories(model, x, times)


def _join(threads: Collection[threading.Thread], seconds: float) -> None:
    """Wait for threads to end, not longer than so many seconds for all of them."""
    end = time.monotonic() + seconds
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
