"""Worker processes with a pipe each: the death of one, at any moment, costs its own call and nothing else.

``concurrent.futures.ProcessPoolExecutor`` has one pipe for all results. A worker killed while it writes to it leaves
half a message, and the pool waits for the other half for ever; a death elsewhere takes down every worker and leaves
unknown whose call was to blame.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import threading
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

from en4dvar.executor.base import ATTEMPTS_ALONE, Executor, T, WorkerLostError
from en4dvar.executor.blas import one_blas_thread_for_good
from en4dvar.executor.chunks import describe
from en4dvar.executor.limits import NO_LIMITS, Limits, apply_limits

CLOSE_TIMEOUT = 10.0  # s for a worker to end by itself
Call = tuple[Any, ...]
_SPAWN = get_context("spawn")


class _Dead(Exception):
    """The worker is gone."""


class _Worker:
    """A process and our end of its pipe; ``task`` is the index of the call it works on."""

    def __init__(self, limits: Limits):
        self.pipe, theirs = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(theirs, limits), name="en4dvar-worker")
        self.process.start()
        theirs.close()  # so that its end is closed when the process ends
        self.task = -1

    def send(self, task: int, message: bytes) -> None:
        self.task = task
        with contextlib.suppress(OSError):  # dead already: told when its answer is read
            self.pipe.send_bytes(message)

    def answer(self) -> Any:
        """The value of the call or what it raised. Raises :class:`_Dead`."""
        try:
            content = self.pipe.recv_bytes()
        except (EOFError, OSError):
            raise _Dead from None
        try:
            return pickle.loads(content)
        except Exception as error:  # a value that cannot be made again here
            return error

    def end(self, at_once: bool) -> None:
        if at_once:
            self.process.kill()
        self.pipe.close()  # the sign for a worker to end
        self.process.join(CLOSE_TIMEOUT)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class ProcessesExecutor(Executor):
    """Fresh (spawned) processes, within ``limits``; model and calls must be picklable and importable.

    They are started at first use and live until :meth:`close`.
    """

    def __init__(self, workers: int, limits: Limits = NO_LIMITS):
        if workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers}")
        self.workers, self.limits = workers, limits
        self._idle: list[_Worker] = []
        self._busy: list[_Worker] = []
        weakref.finalize(self, _end_all, self._idle, self._busy)  # also at the end of the interpreter

    def map(self, function: Callable[..., T], calls: Iterable[Call]) -> Iterator[tuple[int, T | Exception]]:
        following = enumerate(calls)
        again: deque[tuple[int, bytes]] = deque()  # calls whose worker has died
        sent: dict[int, bytes] = {}
        deaths: dict[int, int] = {}
        answers: deque[tuple[int, Any]] = deque()

        def dispatch() -> None:
            while len(self._busy) < self.workers:
                if again:
                    i, message = again.popleft()
                elif (item := next(following, None)) is None:
                    return
                else:
                    i, call = item
                    try:
                        message = bytes(ForkingPickler.dumps((function, call)))
                    except Exception as error:  # it cannot be sent
                        answers.append((i, error))
                        continue
                sent[i] = message
                self._hand_over(i, message)

        try:
            while True:
                dispatch()
                while answers:
                    yield answers.popleft()
                if not self._busy:
                    return
                for worker in self._ready():
                    i = worker.task
                    try:
                        answers.append((i, worker.answer()))
                    except _Dead:
                        self._bury(worker)
                        deaths[i] = deaths.get(i, 0) + 1
                        if deaths[i] <= ATTEMPTS_ALONE:
                            again.append((i, sent[i]))
                            continue
                        answers.append((i, WorkerLostError(self.limits.death)))
                    else:
                        self._busy.remove(worker)
                        self._idle.append(worker)
                    del sent[i]
        finally:  # given up half-way: what is under way is of no use to the next call
            for worker in list(self._busy):
                worker.process.kill()
                self._bury(worker)

    def _hand_over(self, i: int, message: bytes) -> None:
        worker = self._idle.pop() if self._idle else _Worker(self.limits)
        self._busy.append(worker)
        worker.send(i, message)

    def _ready(self) -> list[_Worker]:
        """Waits for workers that have answered or died."""
        ready = wait([worker.pipe for worker in self._busy])
        return [worker for worker in self._busy if worker.pipe in ready]

    def _bury(self, worker: _Worker) -> None:
        self._busy.remove(worker)
        worker.end(at_once=True)

    def close(self) -> None:
        _end_all(self._idle, self._busy)

    def kill(self) -> None:
        for worker in (*self._idle, *self._busy):
            worker.process.kill()
        self.close()


def _end_all(*groups: list[_Worker]) -> None:
    for workers in groups:
        while workers:
            workers.pop().end(at_once=False)


def _serve(pipe: Connection, limits: Limits) -> None:
    """What a worker does until its pipe is closed."""
    prepare_worker(limits)
    while True:
        try:
            message = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            function, call = pickle.loads(message)
            value: Any = function(*call)
        except Exception as error:
            error.add_note(f"in a worker process:\n{traceback.format_exc()}")
            value = error
        try:
            answer = bytes(ForkingPickler.dumps(value))
        except Exception as error:  # of the value or of an exception with something in it that stays here
            reason = value if isinstance(value, Exception) else error
            answer = bytes(ForkingPickler.dumps(RuntimeError(describe(reason))))
        try:
            pipe.send_bytes(answer)
        except OSError:
            return


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
