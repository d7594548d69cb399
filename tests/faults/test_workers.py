"""Workers that die at the worst moments, and what they hand back when it cannot be sent."""

import contextlib
import os
import signal
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

from en4dvar.executor import ExecutorError, ProcessesExecutor, WorkerLostError, processes
from en4dvar.executor.processes import _Worker

LARGE = 4_000_000  # bytes; a pipe holds 65 536, so that a worker is writing until we have read most of it


class DiesWhileItIsSent:
    """Pickled, it is large; the process is killed by a child of its own while most of it is still to be written."""

    def __init__(self, flag):
        self.flag = flag

    def __reduce__(self):
        if not Path(self.flag).exists():
            Path(self.flag).touch()
            victim = os.getpid()
            if os.fork() == 0:
                time.sleep(0.3)
                os.kill(victim, signal.SIGKILL)
                os._exit(0)
        return bytes, (bytes(LARGE),)


def half_a_message(flag):
    return DiesWhileItIsSent(flag)


def fine(number):
    return number, bytes(LARGE)


def slow(number):
    time.sleep(0.02)
    return number


@pytest.fixture
def reads_late(monkeypatch):
    """Within, a worker has filled its pipe, and is dead before the first byte is read."""
    answer = _Worker.answer

    def late(worker, tell=None):
        worker.pipe.poll(None)
        time.sleep(1.0)
        return answer(worker, tell)

    @contextlib.contextmanager
    def within():
        with monkeypatch.context() as patch:
            patch.setattr(_Worker, "answer", late)
            yield

    return within


@pytest.mark.fault("worker-killed")
def test_a_worker_killed_while_it_hands_back_its_result(tmp_path, reads_late):
    """Half of a message: the rest never comes, and nobody waits for it."""
    flag = str(tmp_path / "died")
    with ProcessesExecutor(2) as executor:
        with reads_late():
            ((i, value),) = executor.map(half_a_message, [(flag,)])
        assert (i, len(value)) == (0, LARGE)
        assert [v[0] for _, v in sorted(executor.map(fine, [(j,) for j in range(5)]))] == list(range(5))


def half_a_word(flag, tell):
    tell("before")
    tell(DiesWhileItIsSent(flag))
    return "done"


@pytest.mark.fault("worker-killed")
def test_a_worker_killed_while_it_tells_something(tmp_path, reads_late):
    heard = []
    with ProcessesExecutor(1) as executor, reads_late():
        calls = executor.map(half_a_word, [(str(tmp_path / "died"),)], lambda _, message: heard.append(message))
        assert list(calls) == [(0, "done")]
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


def counted_suicide(folder):
    if not Path(folder).is_dir():
        return 0
    (Path(folder) / f"{os.getpid()}").touch()
    os.kill(os.getpid(), signal.SIGKILL)
    return 1


def cannot_be_sent(what):
    if what == "value":
        return lambda: None
    raise ValueError("with something in it", lambda: None)


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
    assert time.monotonic() - begin < 20
    assert len(processes) == 2
    assert not any(p.is_alive() for p in processes)
