"""Oscillators with a fault, told by environment variables so that worker processes hear of it too."""

from __future__ import annotations

import itertools
import os

import numpy as np
from toy_models import Oscillator

from en4dvar.forward import Failure

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


FAULTS = {f.__name__: f for f in (raises, not_a_number, wrong_shape, hangs, hangs_in_compiled_code, allocates)}


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
