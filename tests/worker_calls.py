"""What workers are asked to do in tests: a process started for one of these imports nothing else of the tests."""

import sys


def exits(number):
    return sys.exit(number)


def counts(n, tell):
    for i in range(n):
        tell(i)
    if not n:
        raise ValueError("nothing to count")
    return n
