"""The smallest model with a state and a parameter: dx/dt = c, in closed form."""

from __future__ import annotations

import numpy as np

from en4dvar import Field, ForwardModel, Observable, Parameter, StateField, StateLayout


class Drift(ForwardModel):
    """``x`` grows at the constant rate ``c``; it starts at zero."""

    parameters = (Parameter("c", "1", label="rate"),)
    layout = StateLayout((Field("x"), Field("c")))
    observables = (Observable("x", "1", StateField("x")),)
    time_unit = "1"

    def initial_state(self, theta):
        return np.array([0.0, theta["c"]])

    def step(self, x, t0, t1):
        return np.array([x[0] + (t1 - t0) * x[1], x[1]])
