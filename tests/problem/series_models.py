"""A linear model with two observables in time and a field, for data of several series."""

from __future__ import annotations

import numpy as np

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

CELLS = np.array([0.0, 1.0, 3.0, 4.0, 6.0])


class Two(ForwardModel):
    """p = a + b t, q = 2a − b t² (m), and a field f_i = a x_i + b t at coordinates x_i (m)."""

    parameters = (Parameter("a", "1"), Parameter("b", "1"))
    layout = StateLayout(
        (
            Field("p"), Field("q", unit="m"), Field("f", 5, coordinates=CELLS, coordinate_unit="m"), Field("v"),
            Field("w", unit="m"), Field("theta", 2),
        )
    )  # fmt: skip
    observables = (
        Observable("p", "1", StateField("p", rate_of="v")),
        Observable("q", "m", StateField("q", rate_of="w"), display_unit="cm"),
        Observable("f", "1", StateField("f")),
    )

    def initial_state(self, theta):
        return self.of(theta["a"], theta["b"], 0.0)

    def step(self, x, t0, t1):
        return self.of(x[-2], x[-1], t1)

    def of(self, a, b, t):
        return np.array([a + b * t, 2 * a - b * t**2, *(a * CELLS + b * t), b, -2 * b * t, a, b])


MODEL = Two()
P, Q, F = MODEL.observables
TIMES = {"p": np.linspace(0.1, 1.0, 7), "q": np.linspace(0.1, 1.0, 7)[2:], "f": np.full(4, 0.5)}
AT = np.array([0.0, 2.0, 3.5, 6.0])  # m, where the field is read: in cells and between them


def rows(name, times=None):
    """∂m/∂(a, b) (K, 2) of the readings of a series."""
    t = TIMES[name] if times is None else times
    return {
        "p": np.column_stack([np.ones_like(t), t]),
        "q": np.column_stack([np.full_like(t, 2.0), -(t**2)]),
        "f": np.column_stack([AT if len(t) == len(AT) else t, t]),
    }[name]


def all_series(seed=0, std=(0.3, 0.2, 0.5), weights=None, **noise):
    rng = np.random.default_rng(seed)
    found = []
    for observable, s in zip((P, Q, F), std, strict=True):
        t = TIMES[observable.name]
        values = rows(observable.name) @ [1.0, 0.5] + s * rng.standard_normal(len(t))
        places = Places.at_coordinates(AT, CELLS, "m") if observable is F else None
        own = None if weights is None else weights[observable.name]
        kind = noise.get(observable.name, {})
        found.append(Series(observable, t, values, noise_of(np.full(len(t), s), **kind), own, places=places))
    return found


def problem_of(series, correlation=None, observations=None):
    data = observations or Observations.of_series(series, correlation)
    prior = Prior(tuple(PriorTerm.normal(p, 0.3, 2.0) for p in MODEL.parameters))
    return InverseProblem(MODEL, series[0].observable, data, prior)


def closed_form(G, y, precision):
    """Mean and covariance of N(0.3, 2²) updated by y with a precision matrix β R⁻¹."""
    covariance = np.linalg.inv(np.eye(2) / 4 + G.T @ precision @ G)
    return covariance @ (G.T @ precision @ y + np.full(2, 0.3) / 4), covariance
