"""Workers of a dask cluster that die and come again, or do not."""

import logging
import os
import signal
import time
from contextlib import contextmanager
from pathlib import Path

import dask
import pytest
from distributed import LocalCluster
from rows import row
from run_files import assert_same_results, configuration, make_campaign

from en4dvar.executor import ExecutorError
from en4dvar.executor import dask as dask_executor
from en4dvar.executor.dask import DaskExecutor
from en4dvar.runs.runner import run_campaign


@pytest.fixture
def cluster():
    """A running one of one worker, which nobody starts again once its nanny is closed."""
    with LocalCluster(n_workers=1, threads_per_worker=1, memory_limit=0, dashboard_address=":0") as cluster:
        yield cluster


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(dask_executor, "NO_WORKER_TIMEOUT", 2.0)
    monkeypatch.setattr(dask_executor, "GATHER", 1.0)
    monkeypatch.setattr(dask_executor, "POLL", 0.5)


def end_workers(cluster):
    for nanny in list(cluster.workers.values()):
        cluster.sync(nanny.close, timeout=0.5)


def square(number):
    return number**2


def dies_at_first(flag, number):
    if not Path(flag).exists():
        Path(flag).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.slow
def test_a_worker_that_is_slow_to_come_again_is_waited_for(tmp_path):
    """Dask closes what starts workers again where one is not there some time after a death: here before it can be."""
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "10ms"}):
        with DaskExecutor(1) as executor:
            assert list(executor.map(dies_at_first, [(tmp_path / "flag", 7)])) == [(0, 7)]
        assert dask.config.get("distributed.deploy.lost-worker-timeout") == "10ms"


@pytest.mark.slow
def test_a_value_lost_with_the_last_worker_is_not_waited_for_without_end(cluster, impatient):
    with DaskExecutor(address=cluster.scheduler_address) as executor:
        calls = executor.map(square, [(3,), (4,)])
        next(calls)
        while {task.state for task in cluster.scheduler.tasks.values()} != {"memory"}:
            time.sleep(0.01)  # until the second has ended; its value is still the worker's
        end_workers(cluster)
        with pytest.raises(ExecutorError, match="has had no worker for 2 s"):
            next(calls)


@contextmanager
def small_cluster(limit, **settings):
    """One worker with a limit of memory that its nanny watches, and starts again however long that takes."""
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": dask_executor.FOREVER}),
        dask.config.set({f"distributed.{key}": value for key, value in settings.items()}),
        LocalCluster(n_workers=1, threads_per_worker=1, memory_limit=limit, dashboard_address=":0",
                     silence_logs=logging.CRITICAL) as cluster,
    ):  # fmt: skip
        yield cluster.scheduler_address


@pytest.mark.slow
@pytest.mark.fault("worker-memory")
@pytest.mark.parametrize("again", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_worker_past_its_limit_of_memory(tmp_path, monkeypatch, again):
    """Dask ends it: once is repeated to the same bits; a data set that does it again and again is lost alone."""
    path, out = make_campaign(tmp_path, 3, "execution_models:Hungry", large=1), tmp_path / "run"
    (tmp_path / "fed").touch()
    monkeypatch.setenv("EN4DVAR_TEST_FLAG", str(tmp_path / "fed"))
    assert run_campaign(configuration(path, tmp_path / "quiet", executor="serial")).exit_code == 0
    monkeypatch.setenv("EN4DVAR_TEST_FLAG", "" if again else str(tmp_path / "flag"))
    failures = {"scheduler.allowed-failures": 0} if again else {}  # each takes seconds; dask allows three
    with small_cluster("1 GB", **failures) as address:
        ended = run_campaign(configuration(path, out, address=address))
    if not again:
        assert (tmp_path / "flag").exists()
        assert ended.exit_code == 0
        assert_same_results(out, tmp_path / "quiet")
        return
    assert str(ended.exit_code) == row("worker-memory").exit_code
    failures = {o.name: o.failure for o in ended.outcomes if o.failure}
    assert failures.keys() == {"set1"}
    assert row("worker-memory").told(failures["set1"])
    with (tmp_path / "quiet" / "summary.csv").open() as whole, (out / "summary.csv").open() as rest:
        assert [line for line in rest if "set1" not in line] == [line for line in whole if "set1" not in line]


@pytest.mark.slow
@pytest.mark.fault("worker-paused")
def test_workers_paused_for_memory_are_not_waited_for_without_end(tmp_path, impatient):
    path, out = make_campaign(tmp_path, 2), tmp_path / "run"
    with small_cluster("8 GB", **{"worker.memory.pause": 0.001}) as address, pytest.raises(ExecutorError) as lost:
        run_campaign(configuration(path, out, address=address))
    assert row("worker-paused").told(str(lost.value))
    assert run_campaign(configuration(path, out, executor="serial"), resume=True).exit_code == 0


def test_a_worker_that_is_paused_at_a_call_is_waited_for():
    paused = {"status": "paused", "metrics": {"task_counts": {"executing": 1, "memory": 2}}}
    assert dask_executor._takes_work(paused)
    assert not dask_executor._takes_work({"status": "paused", "metrics": {"task_counts": {"memory": 2}}})
    assert dask_executor._takes_work({"status": "running"})


@pytest.mark.slow
@pytest.mark.fault("no-worker")
def test_without_any_worker_the_run_ends_and_can_be_resumed(tmp_path, cluster, impatient):
    path, out = make_campaign(tmp_path, 3, "execution_models:Slow"), tmp_path / "run"
    assert run_campaign(configuration(path, tmp_path / "quiet", executor="serial")).exit_code == 0
    config = configuration(path, out, address=cluster.scheduler_address)
    with pytest.raises(ExecutorError) as lost:
        run_campaign(config, progress=lambda *_: end_workers(cluster))
    told = str(lost.value)
    assert told.startswith(f"dask scheduler {cluster.scheduler_address}: has had no worker for 2 s; ")
    assert told.endswith(f"of 3 data sets are done and kept in {out}; give resume=True to continue")
    assert run_campaign(configuration(path, out, executor="serial"), resume=True).exit_code == 0
    assert_same_results(out, tmp_path / "quiet")
