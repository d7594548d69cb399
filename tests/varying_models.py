"""Models whose parameters can vary: importable, so that spawned processes find them."""

from __future__ import annotations

import numpy as np

from en4dvar.model.forward import Batch, Failure, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout

KNOTS = (1.0, 2.0, 3.5)


class Ramp(ForwardModel):
    """y' = r from y = 1."""

    parameters = (Parameter("r", "m/s", label="rate"),)
    layout = StateLayout((Field("y", unit="m"), Field("r", unit="m/s")))
    observables = (Observable("y", "m", StateField("y", rate_of="r")),)

    def initial_state(self, theta):
        return np.array([1.0, theta["r"]])

    def step(self, x, t0, t1):
        return np.array([x[0] + x[1] * (t1 - t0), x[1]])


class Steep(Ramp):
    """The same, which ends where the rate exceeds ``limit``."""

    def __init__(self, limit):
        self.limit = limit

    def step(self, x, t0, t1):
        if x[1] > self.limit:
            raise ArithmeticError("too steep")
        return super().step(x, t0, t1)


class Batched(Ramp):
    """The same with all members at once."""

    def resumed(self, x, start, times):
        since = np.maximum(times - start[:, None], 0.0)
        y = x[:, :1] + x[:, 1:] * since
        return Batch(
            np.maximum(times, start[:, None]), np.stack([y, np.broadcast_to(x[:, 1:], y.shape)], -1), self.layout
        )


class Ending(Batched):
    """A batch, members of which fail above a rate of ``limit``."""

    def __init__(self, limit):
        self.limit = limit

    def resumed(self, x, start, times):
        batch = super().resumed(x, start, times)
        return [Failure("too steep") if row[1] > self.limit else batch[i] for i, row in enumerate(x)]
