"""A dask cluster: one started on this machine, or a running one at an address (extra ``distributed``).

    dask scheduler                       # prints tcp://host:8786
    dask worker tcp://host:8786          # on every machine that shall help
    en4dvar run CONFIG --scheduler tcp://host:8786

Workers need the packages of this machine in the same versions; they need none of its files, except those that a model
reads while it runs. Dask repeats the calls of a worker that dies; a worker that joins later takes part.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import pickle
import queue
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from en4dvar.executor.base import Executor, ExecutorError, Hear, T, WorkerLostError
from en4dvar.executor.blas import one_blas_thread_for_good
from en4dvar.executor.limits import NO_LIMITS, Limits, apply_limits

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

    News = queue.SimpleQueue[Future | tuple[int, Any]]  # calls that ended; what they tell

TOPIC = "en4dvar"  # of events that calls tell; one for all runs, for a scheduler keeps the last events of each
CONNECT_TIMEOUT = 15.0  # s
NO_WORKER_TIMEOUT = 60.0  # s without any worker before the run is given up
POLL = 2.0  # s
GATHER = 15.0  # s to fetch a value before it is asked whether there are workers; begun again then
FOREVER = "10000 days"  # dask would close the nanny of a worker that is not there 15 s after one of its deaths
CLOSE_TIMEOUT = 10.0  # s; workers end by themselves when their scheduler is gone
KILL_TIMEOUT = 0.5  # s for a worker of this machine to end by itself when it is killed


class DaskExecutor(Executor):
    """Calls as tasks of dask.distributed.

    Parameters
    ----------
    workers: processes of the local cluster; with an ``address``, how many calls to keep under way (default: one for
        each thread of the cluster).
    address: of a running scheduler, e.g. ``tcp://10.0.0.1:8786``; by default a cluster is started on this machine.
    limits: of a worker process, which a nanny (dask's default) starts again where they end it.

    Raises
    ------
    ExecutorError: dask is not installed, the scheduler cannot be reached, or it has no worker.
    """

    def __init__(self, workers: int | None = None, address: str | None = None, limits: Limits = NO_LIMITS):
        try:
            import dask.config
            import distributed
        except ImportError:
            raise ExecutorError("the dask executor needs the extra: pip install 'en4dvar[distributed]'") from None
        self._address, self._limits = address, limits
        self._cluster: LocalCluster | None = None
        self._client: Client | None = None
        self._listening: dict[str, News] = {}  # for what the calls of a map tell
        self._maps = itertools.count()
        self._seen = time.monotonic()  # when there was a worker
        self._configured = contextlib.ExitStack()
        for name in (
            "distributed.client",
            "distributed.comm",
            "distributed.core",
            "distributed.batched",
            "distributed.process",
        ):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what they tell of lost connections, we tell once
        try:
            if address is None:
                self._configured.enter_context(dask.config.set({"distributed.deploy.lost-worker-timeout": FOREVER}))
                self._cluster = distributed.LocalCluster(
                    n_workers=workers or 1,
                    threads_per_worker=1,
                    memory_limit=0,  # a member that needs memory is not a reason to kill its worker
                    dashboard_address=":0",
                    silence_logs=logging.CRITICAL,
                    preload=__name__,  # dask_setup
                )
            self._client = distributed.Client(
                self._cluster or address, timeout=CONNECT_TIMEOUT, set_as_default=False, heartbeat_interval="1s"
            )
            self._client.subscribe_topic(TOPIC, self._told)
            self._client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
            self.workers = workers or max(1, sum(self._client.nthreads().values()))
        except (OSError, ValueError) as error:
            connected = self._client is not None
            self.kill()
            message = "has no worker; start some with: dask worker" if connected else "cannot be reached"
            raise ExecutorError(f"dask scheduler {address or ''}: {message} ({error})") from None

    def map(
        self, function: Callable[..., T], calls: Iterable[tuple[Any, ...]], hear: Hear | None = None
    ) -> Iterator[tuple[int, T | Exception]]:
        news: News = queue.SimpleQueue()
        name = f"{getattr(self._client, 'id', '')}-{next(self._maps)}"
        if hear:
            self._listening[name] = news
        pending: dict[Any, tuple[int, tuple[Any, ...], Future]] = {}
        following = enumerate(calls)
        suspects: list[tuple[int, tuple[Any, ...]]] = []  # repeated when nothing else is under way

        def submit(i: int, call: tuple[Any, ...]) -> None:
            future = self._submit(function, call, (name, i) if hear else None)
            pending[future.key] = i, call, future
            future.add_done_callback(news.put)

        def ended() -> tuple[int, tuple[Any, ...], Any]:
            future = self._next(news, hear)
            i, call, _ = pending.pop(future.key)
            return i, call, self._value(future)

        try:
            while True:
                for i, call in itertools.islice(following, max(0, 2 * self.workers - len(pending))):
                    submit(i, call)
                if not pending:
                    break
                i, call, value = ended()
                if isinstance(value, WorkerLostError):
                    suspects.append((i, call))
                else:
                    yield i, value
            for i, call in suspects:  # several workers died under it; calls around it may have been the reason
                submit(i, call)
                *_, value = ended()
                yield i, value
        finally:
            self._listening.pop(name, None)
            for _, _, future in pending.values():
                future.release()

    def _submit(self, function: Callable[..., T], call: tuple[Any, ...], listener: tuple[str, int] | None) -> Future:
        if self._client is None or self._client.status != "running":
            raise self._lost()
        return self._client.submit(_on_worker, self._limits, function, call, listener, pure=False)

    def _told(self, event: tuple[float, tuple[str, int, bytes]]) -> None:
        """What a call tells, in dask's thread; calls of other runs tell it too."""
        name, i, message = event[1]
        if (news := self._listening.get(name)) is not None:
            news.put((i, pickle.loads(message)))

    def _next(self, news: News, hear: Hear | None) -> Future:
        """The next future that ends. Raises :class:`ExecutorError` where the cluster is gone."""
        self._seen = time.monotonic()
        while True:
            try:
                item = news.get(timeout=POLL)
            except queue.Empty:
                self._require_worker()
                continue
            if not isinstance(item, tuple):
                return item
            self._seen = time.monotonic()
            if hear:
                hear(*item)

    def _value(self, future: Future) -> Any:
        """What the call gave or raised. Waits where the value was lost with its worker and is computed again.

        Raises :class:`ExecutorError` where the cluster is gone.
        """
        from distributed import CancelledError, KilledWorker

        self._seen = time.monotonic()
        while True:
            try:
                return future.result(timeout=GATHER)
            except CancelledError:
                raise self._lost() from None
            except Exception as error:
                if future.status == "error":
                    own = future.exception()
                    return WorkerLostError(self._limits.death) if isinstance(own, KilledWorker) else own
                if not isinstance(error, TimeoutError):
                    raise self._lost() from error
            self._require_worker()

    def _require_worker(self) -> None:
        """Raises :class:`ExecutorError` where the cluster is gone, or has had no worker for too long."""
        if self._client is None or self._client.status != "running":
            raise self._lost()
        if self._client.scheduler_info()["workers"]:
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > NO_WORKER_TIMEOUT:
            reason = f"has had no worker for {NO_WORKER_TIMEOUT:.0f} s"
            raise ExecutorError(f"dask scheduler {self._address or 'of this machine'}: {reason}")

    def _lost(self) -> ExecutorError:
        return ExecutorError(f"lost the connection to the dask scheduler {self._address or 'of this machine'}")

    def close(self) -> None:
        client, cluster = self._client, self._cluster
        self._client = self._cluster = None
        with contextlib.suppress(TimeoutError):
            if client is not None:
                client.close(timeout=CLOSE_TIMEOUT)
        with contextlib.suppress(TimeoutError):
            if cluster is not None:
                cluster.close(timeout=CLOSE_TIMEOUT)
        self._configured.close()

    def kill(self) -> None:
        cluster = self._cluster
        if cluster is not None:  # workers elsewhere are not ours to end

            async def end_workers() -> None:
                await asyncio.gather(*(nanny.close(timeout=KILL_TIMEOUT) for nanny in cluster.workers.values()))

            with contextlib.suppress(OSError, TimeoutError):
                cluster.sync(end_workers)
        self.close()


def dask_setup(_: Any) -> None:
    """In a worker of this machine: Ctrl-C is the main process's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _on_worker(
    limits: Limits, function: Callable[..., T], call: tuple[Any, ...], listener: tuple[str, int] | None
) -> T:
    one_blas_thread_for_good()
    apply_limits(limits)
    if listener is None:
        return function(*call)
    from distributed import get_worker

    worker = get_worker()
    return function(*call, lambda message: worker.log_event(TOPIC, (*listener, pickle.dumps(message))))
