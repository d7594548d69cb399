"""Oscillators with a fault, told by environment variables so that worker processes hear of it too."""

from __future__ import annotations

import itertools
import os
import signal
import sys
import threading
import time
import warnings
from contextlib import suppress
from dataclasses import replace

import numpy as np
from toy_models import Oscillator

from en4dvar.model.forward import Failure, StateField

MEMBERS = 8
STIFF = 4.0  # N/m; one of the eight prior members is stiffer, none near the minimum


class Faulty(Oscillator):
    """Stiff members do what ``EN4DVAR_TEST_FAULT`` says."""

    def step(self, x, t0, t1):
        return FAULTS[os.environ["EN4DVAR_TEST_FAULT"]](self, x) if x[2] > STIFF else super().step(x, t0, t1)


def raises(model, x):
    raise ArithmeticError("no such oscillation")


def not_a_number(model, x):
    return np.full(x.shape, np.nan)


def wrong_shape(model, x):
    return np.zeros(3)


def hangs(model, x):
    while True:
        pass


def hangs_in_compiled_code(model, x):
    return sum(itertools.repeat(0))  # type: ignore[arg-type]  never looks at signals, never lets go of the interpreter


def allocates(model, x):
    held = []
    while True:
        held.append(np.ones(1 << 20))


def exits(model, x):
    sys.exit(0)


def raises_no_exception(model, x):
    raise GeneratorExit("enough")


def interrupts_itself(model, x):
    raise KeyboardInterrupt


def ends_its_process(model, x):
    os._exit(0)


FAULTS = {
    f.__name__: f
    for f in (
        raises, not_a_number, wrong_shape, hangs, hangs_in_compiled_code, allocates, exits, raises_no_exception,
        interrupts_itself, ends_its_process,
    )
}  # fmt: skip


class ExitsInInitialState(Oscillator):
    """Stiff members end the program before they have begun."""

    def initial_state(self, theta):
        return sys.exit(0) if theta["k"] > STIFF else super().initial_state(theta)


class ExitsInH(Oscillator):
    """H ends the program for stiff members."""

    class Operator(StateField):
        batched = False

        def __call__(self, trajectory):
            return sys.exit(0) if trajectory["k"][0] > STIFF else super().__call__(trajectory)

    observables = (replace(Oscillator.observables[0], operator=Operator("x", rate_of="v")),)


class Counts(Oscillator):
    """Every member is a little later than the one before, in this process."""

    runs = 0

    def initial_state(self, theta):
        type(self).runs += 1
        state = super().initial_state(theta)
        state[1] += 1e-6 * type(self).runs
        return state


class Remembers(Oscillator):
    """Starts each member a little towards where the one before ended."""

    last = 0.0

    def step(self, x, t0, t1):
        x = super().step(x, t0, t1)
        if t0 == 0:
            x[0] += 1e-6 * type(self).last
        type(self).last = x[0]
        return x


class Fails(Oscillator):
    """Fails every second time."""

    runs = 0

    def step(self, x, t0, t1):
        type(self).runs += t0 == 0
        if type(self).runs > 9:
            raise ArithmeticError("not again")
        return super().step(x, t0, t1)


class Closes(Oscillator):
    """Closes standard output as ``EN4DVAR_TEST_FAULT`` says: the file of Python, or that of the system, whose number
    another file may have from then on.
    """

    def step(self, x, t0, t1):
        if t0 == 0 and not sys.stdout.closed:
            whose = os.environ["EN4DVAR_TEST_FAULT"]
            with suppress(OSError):
                sys.stdout.close() if whose == "python" else os.close(1)
            if whose == "another":
                os.open(os.devnull, os.O_RDONLY)
        return super().step(x, t0, t1)


class Disturbs(Oscillator):
    """Changes what the process shares, on every occasion."""

    def __init__(self, settings):
        super().__init__(settings)
        disturb()

    def step(self, x, t0, t1):
        if t0 == 0:
            np.seterr(all="raise")
            np.random.seed(1)  # noqa: NPY002
            os.environ["EN4DVAR_TEST_DISTURBED"] = "1"
            threading.Thread(target=time.sleep, args=(0.01,), daemon=True).start()
        return super().step(x, t0, t1)


def disturb():
    np.seterr(all="raise")
    np.random.seed(1)  # noqa: NPY002
    os.chdir("/")
    warnings.simplefilter("error")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


class LosesAt(Oscillator):
    """Loses ``share`` of the members in the ensemble's forecast number ``at`` of this process, counting from 1."""

    at = 0
    share = 1.0
    calls = 0

    def trajectories(self, x, times):
        kind = type(self)
        outcomes = list(super().trajectories(x, times))
        if len(x) < MEMBERS:  # candidates of a search, and the mode alone
            return outcomes
        kind.calls += 1
        if kind.calls == kind.at:
            outcomes[: int(kind.share * MEMBERS)] = [Failure("lost on purpose")] * int(kind.share * MEMBERS)
        return outcomes
