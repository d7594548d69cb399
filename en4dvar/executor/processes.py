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
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

from en4dvar.executor.base import ATTEMPTS_ALONE, Executor, ExecutorError, Hear, T, WorkerLostError
from en4dvar.executor.blas import one_blas_thread_for_good
from en4dvar.executor.chunks import describe
from en4dvar.executor.limits import NO_LIMITS, Limits, apply_limits

CLOSE_TIMEOUT = 10.0  # s for a worker to end by itself
MOST_STILLBORN = 8  # workers in a row that end before they have begun
ANSWER, TOLD = b"a", b"t"  # what a worker sends begins with one of them
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

    def answer(self) -> tuple[bool, Any]:
        """Whether the call has ended, and its value or what it raised, else what it tells; None as it starts.

        Raises :class:`_Dead`.
        """
        try:
            content = memoryview(self.pipe.recv_bytes())
        except (EOFError, OSError):
            raise _Dead from None
        ended = content[:1] == ANSWER
        try:
            return ended, pickle.loads(content[1:])
        except Exception as error:  # a value that cannot be made again here
            return ended, error

    def end(self, at_once: bool) -> None:
        if at_once:
            self.process.kill()
        self.pipe.close()  # the sign for a worker to end
        self.process.join(CLOSE_TIMEOUT)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


@dataclass
class _Crew:
    """The workers, by what they are doing."""

    starting: list[_Worker] = field(default_factory=list)
    idle: list[_Worker] = field(default_factory=list)
    busy: list[_Worker] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.starting) + len(self.idle) + len(self.busy)

    def __iter__(self) -> Iterator[_Worker]:
        return iter((*self.starting, *self.idle, *self.busy))

    def end(self) -> None:
        for workers in (self.starting, self.idle, self.busy):
            while workers:
                workers.pop().end(at_once=False)


class ProcessesExecutor(Executor):
    """Fresh (spawned) processes, within ``limits``; model and calls must be picklable and importable.

    They are started at first use and live until :meth:`close`.
    """

    def __init__(self, workers: int, limits: Limits = NO_LIMITS):
        if workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers}")
        self.workers, self.limits = workers, limits
        self._crew = _Crew()
        self._stillborn = 0  # one after the other
        weakref.finalize(self, self._crew.end)  # also at the end of the interpreter

    def map(
        self, function: Callable[..., T], calls: Iterable[Call], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        crew, following = self._crew, enumerate(calls)
        todo: deque[tuple[int, bytes]] = deque()
        sent: dict[int, bytes] = {}
        deaths: dict[int, int] = {}
        answers: deque[tuple[int, Any]] = deque()

        def fetch() -> None:
            """Have a call ready for every worker that is not at work."""
            while len(todo) < self.workers - len(crew.busy) and (item := next(following, None)) is not None:
                i, call = item
                try:
                    todo.append((i, bytes(ForkingPickler.dumps((function, call, hear is not None)))))
                except Exception as error:
                    answers.append((i, _unsendable(error)))

        def hand_over() -> None:
            while todo and crew.idle:
                i, message = todo.popleft()
                worker, sent[i] = crew.idle.pop(), message
                crew.busy.append(worker)
                worker.send(i, message)
            while len(todo) > len(crew.starting) and len(crew) < self.workers:
                crew.starting.append(_Worker(self.limits))

        try:
            while True:
                fetch()
                hand_over()
                while answers:
                    yield answers.popleft()
                if not crew.busy and not todo:
                    return
                for worker in self._ready():
                    i = worker.task
                    try:
                        ended, value = worker.answer()
                    except _Dead:
                        if worker in crew.starting:
                            self._bury(worker, crew.starting)
                            self._count_stillborn(worker)
                            continue
                        self._bury(worker, crew.busy)
                        deaths[i] = deaths.get(i, 0) + 1
                        if deaths[i] <= ATTEMPTS_ALONE:
                            todo.append((i, sent.pop(i)))
                            continue
                        value = WorkerLostError(self.limits.death)
                    else:
                        if not ended:
                            if hear:
                                hear(i, value)
                            continue
                        crew.idle.append(worker)
                        if worker in crew.starting:
                            crew.starting.remove(worker)
                            self._stillborn = 0
                            continue
                        crew.busy.remove(worker)
                    del sent[i]
                    answers.append((i, value))
        finally:  # given up half-way: what is under way is of no use to the next call
            for worker in list(crew.busy):
                self._bury(worker, crew.busy)

    def _ready(self) -> list[_Worker]:
        """Waits for workers that have started, answered or died."""
        active = [*self._crew.starting, *self._crew.busy]
        ready = wait([worker.pipe for worker in active])
        return [worker for worker in active if worker.pipe in ready]

    def _bury(self, worker: _Worker, among: list[_Worker]) -> None:
        among.remove(worker)
        worker.end(at_once=True)

    def _count_stillborn(self, worker: _Worker) -> None:
        self._stillborn += 1
        if self._stillborn > MOST_STILLBORN:
            raise ExecutorError(
                f"worker processes end while they start (exit code {worker.process.exitcode}); a script that starts "
                "them needs: if __name__ == '__main__':"
            )

    def close(self) -> None:
        self._crew.end()

    def kill(self) -> None:
        for worker in self._crew:
            worker.process.kill()
        self.close()


def _serve(pipe: Connection, limits: Limits) -> None:
    """What a worker does until its pipe is closed."""
    prepare_worker(limits)

    def tell(message: Any) -> None:
        pipe.send_bytes(TOLD + bytes(ForkingPickler.dumps(message)))

    pipe.send_bytes(ANSWER + pickle.dumps(None))  # ready: from here on a death may be a call's fault
    while True:
        try:
            message = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        value: Any
        try:
            function, call, listening = pickle.loads(message)
        except Exception as error:
            value = _unsendable(error)
        else:
            try:
                value = function(*call, *([tell] if listening else []))
            except Exception as error:
                error.add_note(f"in a worker process:\n{traceback.format_exc()}")
                value = error
        try:
            answer = bytes(ForkingPickler.dumps(value))
        except Exception as error:  # of the value or of an exception with something in it that stays here
            reason = value if isinstance(value, Exception) else error
            answer = bytes(ForkingPickler.dumps(RuntimeError(describe(reason))))
        try:
            pipe.send_bytes(ANSWER + answer)
        except OSError:
            return


def _unsendable(error: Exception) -> TypeError:
    """What a call is told that cannot be pickled here, or not be made again in a worker."""
    return TypeError(
        f"cannot be sent to a worker process ({describe(error)}); models and functions must be defined in a module "
        "that workers can import, not in a notebook or session, or run with the executor serial or threads"
    )


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
