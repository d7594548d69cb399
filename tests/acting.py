"""A model whose parameter acts at known times: for the ledger, and for files with every variable."""

from __future__ import annotations

import numpy as np
from toys import make_observations

from en4dvar.model.forward import ForwardModel, Observable, PathQuantity, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

BEGIN, END = 0.5, 0.9


def worked(t):
    """How long the parameter has acted by time t."""
    return np.clip(t, BEGIN, END) - BEGIN


class Acting(ForwardModel):
    """ẋ = θ u(t) with u = 1 between 0.5 and 0.9; x(0) = x0, which is not of the path."""

    def __init__(self, scale=1.0):
        self.scale = scale  # of the unit of θ
        self.parameters = (Parameter("theta", "1"), Parameter("x0", "1"))
        self.layout = StateLayout((Field("x"), Field("u"), Field("theta"), Field("x0")))
        self.observables = (Observable("x", "1", StateField("x")),)
        self.path_quantities = (PathQuantity("u", "1", label="input"), PathQuantity("x", "1"))
        self.path_parameters = ("theta",)

    def initial_state(self, theta):
        return np.array([theta["x0"], 0.0, theta["theta"], theta["x0"]])

    def step(self, x, t0, t1):
        moved = self.scale * x[2] * (worked(t1) - worked(t0))
        return np.array([x[0] + moved, float(BEGIN <= t1 <= END), x[2], x[3]])


def acting_problem(times, model=None, std=0.1):
    model = model or Acting()
    values = 1.0 + 2.0 * worked(np.asarray(times))
    terms = (
        PriorTerm.normal(model.parameters[0], 1.5 / model.scale, 1.0 / model.scale),
        PriorTerm.normal(model.parameters[1], 1.0, 0.5),
    )
    return InverseProblem(model, model.observables[0], make_observations(times, values, std), Prior(terms))
