"""Workers that die at the worst moments, and what they hand back when it cannot be sent."""

import fcntl
import os
import socket
import sys
import termios
import time
from types import ModuleType

import pytest
from worker_calls import LARGE, cannot_be_sent, counted_suicide, fine, large, slow, tells_much

from en4dvar.executor import ExecutorError, ProcessesExecutor, WorkerLostError, processes
from en4dvar.executor.processes import _Worker


def announced(worker):
    """Bytes of the message that waits to be read: its head says how many."""
    with socket.socket(fileno=os.dup(worker.pipe.fileno())) as end:
        return int.from_bytes(end.recv(4, socket.MSG_PEEK), "big")


def arrived(worker):
    """Bytes that can be read."""
    return int.from_bytes(fcntl.ioctl(worker.pipe.fileno(), termios.FIONREAD, bytes(4)), sys.byteorder)


@pytest.fixture
def killed_while_it_writes(monkeypatch):
    """The first worker with a large message to hand over; it is dead before the first byte of that is read."""
    receive, killed = _Worker.receive, []

    def late(worker):
        worker.pipe.poll(None)
        if not killed and worker.process.is_alive() and announced(worker) > LARGE:
            while arrived(worker) < 65_536:
                time.sleep(0.001)
            killed.append(worker)
            worker.process.kill()
            worker.process.join()
        return receive(worker)

    monkeypatch.setattr(_Worker, "receive", late)
    return killed


@pytest.mark.fault("worker-killed")
def test_a_worker_killed_while_it_hands_back_its_result(killed_while_it_writes):
    """Half of a message: the rest never comes, and nobody waits for it."""
    with ProcessesExecutor(2) as executor:
        assert list(executor.map(large, [()])) == [(0, bytes(LARGE))]
        assert len(killed_while_it_writes) == 1
        assert [v[0] for _, v in sorted(executor.map(fine, [(j,) for j in range(5)]))] == list(range(5))


@pytest.mark.fault("worker-killed")
def test_a_worker_killed_while_it_tells_something(killed_while_it_writes):
    heard = []
    with ProcessesExecutor(1) as executor:
        calls = executor.map(tells_much, [()], lambda _, message: heard.append(message))
        assert list(calls) == [(0, "done")]
    assert len(killed_while_it_writes) == 1
    assert heard == ["before", "before", bytes(LARGE)]


@pytest.mark.fault("worker-killed")
def test_only_the_calls_of_killed_workers_are_repeated():
    with ProcessesExecutor(2) as executor:
        found = []
        for i, value in executor.map(slow, [(j,) for j in range(60)]):
            found.append((i, value))
            if len(found) in (10, 30):
                [*executor._busy, *executor._idle][0].process.kill()
        assert sorted(found) == [(j, j) for j in range(60)]


@pytest.mark.fault("worker-always")
def test_a_call_that_kills_is_given_up_after_three_workers(tmp_path):
    with ProcessesExecutor(2) as executor:
        found = dict(executor.map(counted_suicide, [(str(tmp_path),), (str(tmp_path / "none"),)]))
    assert isinstance(found[0], WorkerLostError)
    assert found[1] == 0
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.fault("worker-killed")
def test_what_cannot_be_sent_is_told():
    with ProcessesExecutor(1) as executor:
        found = dict(executor.map(cannot_be_sent, [("value",), ("exception",), (lambda: None,)]))
    assert "pickle" in str(found[0])
    assert "ValueError: ('with something in it'" in str(found[1])
    assert "pickle" in str(found[2])
    assert "in a module that workers can import" in str(found[2])


@pytest.mark.fault("worker-killed")
def test_what_workers_cannot_import_is_told(monkeypatch):
    """As a model of a notebook, whose main module workers do not have."""
    there = ModuleType("only_here")
    exec("class Model:\n    pass", there.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", there)
    with ProcessesExecutor(1) as executor:
        (((_, value)),) = executor.map(str, [(there.Model(),)])
    assert isinstance(value, TypeError)
    assert "No module named 'only_here'" in str(value)
    assert "in a module that workers can import" in str(value)


@pytest.mark.fault("worker-killed")
def test_a_worker_killed_at_its_start_is_nobodys_fault(monkeypatch):
    """Five in a row: more than a call may cost."""
    started = []
    start = _Worker.__init__

    def stillborn(worker, limits):
        start(worker, limits)
        started.append(worker)
        if len(started) <= 5:
            worker.process.kill()

    monkeypatch.setattr(_Worker, "__init__", stillborn)
    with ProcessesExecutor(1) as executor:
        assert list(executor.map(slow, [(7,)])) == [(0, 7)]
    assert len(started) == 6
    monkeypatch.setattr(processes, "MOST_STILLBORN", 2)
    started.clear()
    with ProcessesExecutor(1) as executor, pytest.raises(ExecutorError, match="worker processes end while they start"):
        list(executor.map(slow, [(7,)]))


def test_interrupted_workers_are_gone_at_once():
    executor = ProcessesExecutor(2)
    calls = executor.map(time.sleep, [(0,), (600,), (600,)])
    next(calls)
    begin = time.monotonic()
    processes = [worker.process for worker in (*executor._idle, *executor._busy)]
    executor.kill()
    calls.close()
    assert time.monotonic() - begin < 300  # not 600
    assert len(processes) == 2
    assert not any(p.is_alive() for p in processes)
