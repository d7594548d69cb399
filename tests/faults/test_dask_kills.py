"""Scheduler, worker and client of a dask cluster of separate processes are killed at random moments of a run."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress

import psutil
import pytest
from rows import row
from run_files import assert_same_results, command, environment, make_campaign, run_cli

SECONDS = 120.0  # for a process to be there, or to notice
SETS = 4


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """The configuration, and the run that nothing disturbs."""
    folder = tmp_path_factory.mktemp("quiet")
    path = make_campaign(folder, SETS, "execution_models:Slow")
    done = run_cli("run", path, "--out", folder / "run", "--no-report", EN4DVAR_TEST_PAUSE=0)
    assert done.returncode == 0, done.stderr
    return path, folder / "run"


@pytest.fixture
def start(tmp_path):
    """Starts a process that is gone, with its children, at the end of the test."""
    with ExitStack() as stack:

        def begin(name, *words):
            log = stack.enter_context((tmp_path / f"{name}.log").open("w+"))
            process = subprocess.Popen(
                [str(word) for word in words], stdout=log, stderr=log, env=environment(EN4DVAR_TEST_PAUSE=0.02)
            )
            stack.callback(end, process)
            return process

        yield begin


def end(process):
    with suppress(psutil.NoSuchProcess):
        for one in (*psutil.Process(process.pid).children(recursive=True), process):
            with suppress(psutil.NoSuchProcess):
                one.kill()
    process.wait()


def wait_for(what, process):
    limit = time.monotonic() + SECONDS
    while not (found := what()):
        assert process.poll() is None
        assert time.monotonic() < limit
        time.sleep(0.01)
    return found


def at_work(start, tmp_path, path, out, *more):
    """Scheduler, nanny of one worker, and the run, once it has begun with a data set."""
    address = tmp_path / "address.json"
    dask = (sys.executable, "-m", "distributed.cli.dask_scheduler")
    scheduler = start("scheduler", *dask, "--port", 0, "--host", "127.0.0.1", "--scheduler-file", address,
                      "--dashboard-address", ":0")  # fmt: skip
    wait_for(address.exists, scheduler)
    nanny = start("nanny", sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", address,
                  "--nthreads", 1, "--no-dashboard", "--memory-limit", 0, "--local-directory", tmp_path)  # fmt: skip
    uri = wait_for(lambda: uri_in(address.read_text()), scheduler)
    run = start("run", *command("run", path, "--out", out, "--scheduler", uri, "--no-report", *more))
    wait_for(lambda: (out / "run.log").exists() and "iteration" in (out / "run.log").read_text(), run)
    return scheduler, nanny, run


def uri_in(text):
    return text.partition('"address": "')[2].partition('"')[0]


def worker_of(nanny):
    """Its child that works, which is the one that spawned last."""
    children = psutil.Process(nanny.pid).children()
    return max(children, key=lambda child: child.pid).pid


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    "who",
    [
        pytest.param("scheduler", marks=pytest.mark.fault("scheduler-lost")),
        pytest.param("worker", marks=pytest.mark.fault("worker-killed")),
        pytest.param("run", marks=pytest.mark.fault("kill")),
    ],
)
@pytest.mark.slow
@pytest.mark.long
def test_kills_at_random_moments(quiet, start, tmp_path, who, seed):
    path, expected = quiet
    out = tmp_path / "run"
    scheduler, nanny, run = at_work(start, tmp_path, path, out)
    time.sleep(random.Random(f"{who} {seed}").uniform(0, 2))
    ended = run.poll() is not None
    number = {"scheduler": scheduler.pid, "run": run.pid}.get(who)
    os.kill(worker_of(nanny) if number is None else number, signal.SIGKILL)
    code = run.wait(SECONDS)
    told = (tmp_path / "run.log").read_text()
    assert "Traceback" not in told
    if who == "worker" or ended:
        assert code == 0, told
    elif who == "run":
        assert code == -signal.SIGKILL
    elif code:
        assert code == 1
        assert row("scheduler-lost").told(told)
    if code:
        resumed = run_cli("run", path, "--out", out, "--resume", "--no-report", EN4DVAR_TEST_PAUSE=0)
        assert resumed.returncode == 0, resumed.stderr
    assert_same_results(out, expected)
