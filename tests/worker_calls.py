"""What workers are asked to do in tests: a process started for one of these imports nothing else of the tests."""

import os
import signal
import sys
import time
from pathlib import Path

LARGE = 4_000_000  # bytes; a pipe holds some 200 000, so that a worker is writing until we have read most of it


def exits(number):
    return sys.exit(number)


def counts(n, tell):
    for i in range(n):
        tell(i)
    if not n:
        raise ValueError("nothing to count")
    return n


def large():
    return bytes(LARGE)


def fine(number):
    return number, bytes(LARGE)


def slow(number):
    time.sleep(0.02)
    return number


def tells_much(tell):
    tell("before")
    tell(large())
    return "done"


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
