"""A process that is suspended and continued, as by Ctrl-Z and fg: the time that it was away does not count."""

import os
import signal
import time

import pytest

from en4dvar.executor import Limits, ProcessesExecutor
from en4dvar.executor.limits import within_time_limit

LIMIT = 1.5  # s


def naps(tell):
    def batch():
        tell(os.getpid())
        for _ in range(10):
            time.sleep(0.03)
        return "done"

    return within_time_limit(batch)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="a system without it")
def test_a_batch_that_was_suspended_is_not_past_its_time():
    def suspend(_, worker):
        os.kill(worker, signal.SIGSTOP)
        time.sleep(LIMIT + 0.1)
        os.kill(worker, signal.SIGCONT)

    with ProcessesExecutor(1, Limits(seconds=LIMIT)) as executor:
        assert list(executor.map(naps, [()], suspend)) == [(0, "done")]
