"""A dask cluster: one started on this machine, or a running one at an address (extra ``distributed``).

    dask scheduler                       # prints tcp://host:8786
    dask worker tcp://host:8786          # on every machine that shall help
    en4dvar run CONFIG --scheduler tcp://host:8786

Workers need the packages of this machine in the same versions; they need none of its files, except those that a model
reads while it runs. Dask repeats the calls of a worker that dies; a worker that joins later takes part.
"""

import asyncio
import contextlib
import itertools
import logging
import pickle
import queue
import signal
import time
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

from en4dvar.executor.base import Call, Events, ExecutorError, FuturesExecutor, T, Tell, WorkerLostError
from en4dvar.executor.limits import NO_LIMITS, Limits, apply_limits
from en4dvar.executor.processes import ProcessesExecutor, end_unguarded
from en4dvar.plumbing.user_code import in_worker, own_fault

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

TOPIC = "en4dvar"  # of events that calls tell; one for all runs, for a scheduler keeps the last events of each
CONNECT_TIMEOUT = 15.0  # s
NO_WORKER_TIMEOUT = 60.0  # s without any worker before the run is given up
POLL = 2.0  # s
GATHER = 15.0  # s to fetch a value before it is asked whether there are workers; begun again then
FOREVER = "10000 days"  # dask would close the nanny of a worker that is not there 15 s after one of its deaths
CLOSE_TIMEOUT = 10.0  # s; workers end by themselves when their scheduler is gone
KILL_TIMEOUT = 0.5  # s for a worker of this machine to end by itself when it is killed


class DaskExecutor(FuturesExecutor):
    """Calls as tasks of dask.distributed.

    ``workers``: processes of the local cluster; with an ``address``, how many calls to keep under way (default: one for
    each thread of the cluster). ``address``: of a running scheduler, e.g. ``tcp://10.0.0.1:8786``; by default a cluster
    is started on this machine. ``limits``: of a worker process, which a nanny (dask's default) starts again where they
    end it.

    Raises ExecutorError: dask is not installed, the scheduler cannot be reached, or it has no worker.
    """

    def __init__(self, workers: int | None = None, address: str | None = None, limits: Limits = NO_LIMITS):
        try:
            import dask.config
            import distributed
        except ImportError:
            raise ExecutorError("the dask executor needs dask and distributed: pip install dask distributed") from None
        self._address, self._limits = address, limits
        self._cluster: LocalCluster | None = None
        self._client: Client | None = None
        self._listening: dict[str, Tell] = {}  # for what calls tell, by their keys
        self._calls = itertools.count()
        self._seen = time.monotonic()  # when there was a worker
        self._configured = contextlib.ExitStack()
        for name in ("client", "comm", "core", "batched", "process"):
            # what they tell of lost connections, we tell once
            logging.getLogger(f"distributed.{name}").setLevel(logging.CRITICAL)
        try:
            if address is None:
                end_unguarded()
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
            self._client.subscribe_topic(TOPIC, self._pass_on)
            self._client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
            self.workers = workers or max(1, sum(self._client.nthreads().values()))
        except RuntimeError as error:  # a worker of this machine ends while it starts
            self.kill()
            with ProcessesExecutor(1) as own:  # which knows why
                list(own.map(str, [()]))
            raise ExecutorError(f"workers of dask end while they start ({error})") from None
        except (OSError, ValueError) as error:
            connected = self._client is not None
            self.kill()
            message = "has no worker; start some with: dask worker" if connected else "cannot be reached"
            raise ExecutorError(f"dask scheduler {address or ''}: {message} ({error})") from None

    def _submit(self, function: Callable[..., T], call: Call, tell: Tell | None) -> "Future[Any]":
        if self._client is None or self._client.status != "running":
            raise self._lost()
        key = f"en4dvar-{self._client.id}-{next(self._calls)}"
        if tell:
            self._listening[key] = tell
        listener = key if tell else None
        return self._client.submit(_on_worker, self._limits, function, call, listener, key=key, pure=False)

    def _pass_on(self, event: tuple[float, tuple[str, bytes]]) -> None:
        """What a call tells, in dask's thread; calls of other runs tell it too."""
        key, message = event[1]
        if (tell := self._listening.get(key)) is not None:
            tell(pickle.loads(message))

    def _next(self, events: Events) -> Any:
        """Raises :class:`ExecutorError` where the cluster is gone."""
        self._seen = time.monotonic()
        while True:
            try:
                return events.get(timeout=POLL)
            except queue.Empty:
                self._require_worker()

    def _give_up(self, futures: "Collection[Future[Any]]") -> None:
        for future in futures:
            self._listening.pop(str(future.key), None)
            future.release()

    def _value(self, future: "Future[Any]") -> Any:
        """What the call gave or raised. Waits where the value was lost with its worker and is computed again.

        Raises :class:`ExecutorError` where the cluster is gone.
        """
        from distributed import CancelledError, KilledWorker

        self._listening.pop(str(future.key), None)
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
        workers = self._client.scheduler_info()["workers"].values()
        if any(map(_takes_work, workers)):
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > NO_WORKER_TIMEOUT:
            reason = f"has had no worker for {NO_WORKER_TIMEOUT:.0f} s"
            if workers:
                reason += " that takes work: all are paused near their limit of memory (dask worker --memory-limit)"
            raise ExecutorError(f"dask scheduler {self._address or 'of this machine'}: {reason}")

    def _lost(self) -> ExecutorError:
        return ExecutorError(f"lost the connection to the dask scheduler {self._address or 'of this machine'}")

    def close(self) -> None:
        client, cluster = self._client, self._cluster
        self._client = self._cluster = None
        for part in (client, cluster):
            with contextlib.suppress(TimeoutError):
                if part is not None:
                    part.close(timeout=CLOSE_TIMEOUT)
        self._configured.close()

    def kill(self) -> None:
        cluster = self._cluster
        if cluster is not None:  # workers elsewhere are not ours to end

            async def end_workers() -> None:
                await asyncio.gather(*(nanny.close(timeout=KILL_TIMEOUT) for nanny in cluster.workers.values()))

            with contextlib.suppress(OSError, TimeoutError):
                cluster.sync(end_workers)
        self.close()


def _takes_work(worker: Mapping[str, Any]) -> bool:
    """Whether a worker, as its scheduler describes it, will begin a call, or is at one.

    Dask pauses a worker near its memory limit: it ends the calls that it is at, and begins none.
    """
    return worker.get("status") != "paused" or worker["metrics"]["task_counts"].get("executing", 0) > 0


def dask_setup(_: Any) -> None:
    """In a worker of this machine: Ctrl-C is the main process's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    in_worker()


def _on_worker(limits: Limits, function: Callable[..., T], call: Call, listener: str | None) -> T:
    apply_limits(limits)
    tell: list[Tell] = []
    if listener is not None:
        from distributed import get_worker

        worker = get_worker()
        tell = [lambda message: worker.log_event(TOPIC, (listener, pickle.dumps(message)))]
    try:
        return function(*call, *tell)
    except BaseException as error:  # dask takes SystemExit for the end of the worker
        raise own_fault(error) from None
