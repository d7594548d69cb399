"""Worker processes with a pipe each: the death of one, at any moment, costs its own call and nothing else.

``concurrent.futures.ProcessPoolExecutor`` has one pipe for all results. A worker killed while it writes to it leaves
half a message, and the pool waits for the other half for ever; a death elsewhere takes down every worker and leaves
unknown whose call was to blame. Here a thread waits for each worker, and starts another one where it is lost.
"""

import contextlib
import os
import pickle
import signal
import threading
import traceback
import weakref
from collections.abc import Callable, Collection
from concurrent.futures import Future
from multiprocessing import current_process, get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

from en4dvar.executor.base import Call, ExecutorError, PoolExecutor, T, Tell, WorkerLostError
from en4dvar.executor.limits import NO_LIMITS, Limits, apply_limits
from en4dvar.plumbing.files import here
from en4dvar.plumbing.user_code import describe, in_worker, own_fault

UNGUARDED = 86  # exit code of a worker that was about to start workers of its own while it read the main script
CLOSE_TIMEOUT = 10.0  # s for a worker to end by itself
MOST_STILLBORN = 8  # workers in a row that end before they have begun
ANSWER, TOLD = b"a", b"t"  # what a worker sends begins with one of them
_SPAWN = get_context("spawn")


class _DeadError(Exception):
    """The worker is gone."""


class _Worker:
    """A process and our end of its pipe."""

    def __init__(self, limits: Limits):
        self.pipe, theirs = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(theirs, limits, here()), name="en4dvar-worker")
        self.process.start()
        theirs.close()  # so that its end is closed when the process ends

    def send(self, message: bytes) -> None:
        with contextlib.suppress(OSError):  # dead already: told when its answer is read
            self.pipe.send_bytes(message)

    def answer(self, tell: Tell | None = None) -> Any:
        """Wait for the call to end; its value or what it raised. None as the worker starts.

        Raises :class:`_DeadError`.
        """
        while True:
            content = memoryview(self.receive())
            try:
                value = pickle.loads(content[1:])
            except BaseException as error:  # a value that cannot be made again here
                value = own_fault(error)
            if content[:1] == ANSWER:
                return value
            if tell:
                tell(value)

    def receive(self) -> bytes:
        """The next message, whole. Raises :class:`_DeadError`."""
        try:
            return self.pipe.recv_bytes()
        except (EOFError, OSError):
            raise _DeadError from None

    def end(self) -> None:
        self.pipe.close()  # the sign for a worker to end
        self.process.join(CLOSE_TIMEOUT)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class ProcessesExecutor(PoolExecutor):
    """Fresh (spawned) processes, within ``limits``; model and calls must be picklable and importable.

    They are started at first use and live until :meth:`close`.
    """

    attempts = 3
    reads = True

    def __init__(self, workers: int, limits: Limits = NO_LIMITS):
        end_unguarded()
        super().__init__(workers)
        self.limits = limits
        self._idle: list[_Worker] = []
        self._busy: list[_Worker] = []  # with those that are starting
        self._stillborn = 0  # one after the other
        self._given_up = 0  # how often calls under way were
        self._changing = threading.Lock()  # held while a worker goes from one list to another
        weakref.finalize(self, _end, self._idle)  # also at the end of the interpreter

    def _submit(self, function: Callable[..., T], call: Call, tell: Tell | None) -> Future[T]:
        try:
            message = bytes(ForkingPickler.dumps((function, call, tell is not None)))
        except Exception as error:
            refused: Future[T] = Future()
            refused.set_exception(_unsendable(error))
            return refused
        return super()._submit(self._on_worker, (message, tell, self._given_up), None)

    def _on_worker(self, message: bytes, tell: Tell | None, given_up: int) -> Any:
        """Have a worker answer ``message``; in a thread of the pool."""
        worker = self._take(given_up)
        worker.send(message)
        try:
            value = worker.answer(tell)
        except _DeadError:
            self._bury(worker)
            raise WorkerLostError(self.limits.death) from None
        with self._changing:
            self._busy.remove(worker)
            self._idle.append(worker)
        return value

    def _take(self, given_up: int) -> _Worker:
        """A worker that is ready, now a busy one. Raises :class:`ExecutorError` where none can be started."""
        while True:
            with self._changing:
                if given_up != self._given_up:
                    raise WorkerLostError("the call was cancelled")
                starts = not self._idle
                worker = _Worker(self.limits) if starts else self._idle.pop()
                self._busy.append(worker)
            if not starts:
                return worker
            try:
                worker.answer()
            except _DeadError:
                self._bury(worker)
                if worker.process.exitcode == UNGUARDED:
                    raise UnguardedError(
                        "worker processes read this script again as they start, and so its runs: put what it does "
                        "below   if __name__ == '__main__':"
                    ) from None
                self._stillborn += 1
                if self._stillborn > MOST_STILLBORN:
                    raise ExecutorError(
                        f"worker processes end while they start (exit code {worker.process.exitcode})"
                    ) from None
            else:
                self._stillborn = 0
                return worker

    def _bury(self, worker: _Worker) -> None:
        worker.process.kill()  # it may have closed its pipe only
        worker.end()
        with self._changing:
            self._busy.remove(worker)

    def _value(self, future: Future[T]) -> T | Exception:
        if isinstance(error := future.exception(), ExecutorError):
            raise error
        return super()._value(future)

    def _give_up(self, futures: Collection[Future[Any]]) -> None:
        super()._give_up(futures)
        if futures:
            self._kill_busy()

    def _kill_busy(self) -> None:
        """What is under way is of no use to the next call; with its worker gone, a thread need not wait for it."""
        with self._changing:
            self._given_up += 1
            for worker in self._busy:
                worker.process.kill()

    def close(self) -> None:
        self._kill_busy()
        super().close()
        _end(self._idle)

    def kill(self) -> None:
        for worker in list(self._idle):
            worker.process.kill()
        self.close()


class UnguardedError(SystemExit, ExecutorError):
    """A script starts worker processes, which run it again. Where it is not caught Python ends with its words alone."""


def end_unguarded() -> None:
    """End a worker that conducts the runs of the main script, which it should only read."""
    if getattr(current_process(), "_inheriting", False):
        os._exit(UNGUARDED)


def _end(workers: list[_Worker]) -> None:
    while workers:
        workers.pop().end()


def _serve(pipe: Connection, limits: Limits, folder: str) -> None:
    """What a worker does until its pipe is closed. Names of files mean what they mean in ``folder``."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's business
    in_worker()
    apply_limits(limits)
    threading.Thread(target=_end_with_parent, name="en4dvar-parent", daemon=True).start()
    with contextlib.suppress(OSError):  # a new process is where the main process was when that began
        os.chdir(folder)

    def tell(message: Any) -> None:
        pipe.send_bytes(TOLD + bytes(ForkingPickler.dumps(message)))

    with contextlib.suppress(EOFError, OSError):  # of a pipe that is closed
        pipe.send_bytes(ANSWER + pickle.dumps(None))  # ready: from here on a death may be a call's fault
        while True:
            answer = _answer(pipe.recv_bytes(), tell)
            pipe.send_bytes(ANSWER + answer)


def _answer(message: bytes, tell: Tell) -> bytes:
    """What the call of ``message`` gives or raises, pickled."""
    value: Any
    try:
        function, call, listening = pickle.loads(message)
    except BaseException as error:
        value = _unsendable(own_fault(error))
    else:
        try:
            value = function(*call, *([tell] if listening else []))
        except BaseException as error:
            value = own_fault(error)
            value.add_note(f"in a worker process:\n{traceback.format_exc()}")
    try:
        return bytes(ForkingPickler.dumps(value))
    except BaseException as error:  # of the value or of an exception with something in it that stays here
        reason = value if isinstance(value, Exception) else own_fault(error)
        return bytes(ForkingPickler.dumps(RuntimeError(describe(reason))))


def _unsendable(error: Exception) -> TypeError:
    """What a call is told that cannot be pickled here, or not be made again in a worker."""
    return TypeError(
        f"cannot be sent to a worker process ({describe(error)}); models and functions must be defined in a module "
        "that workers can import, not in a notebook or session, or run with the executor serial or threads"
    )


def _end_with_parent() -> None:
    """Nobody works for a main process that is gone."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
