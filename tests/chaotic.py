"""Lorenz-96 whose initial state is estimated: 24 modes of it, and two parameters."""

from __future__ import annotations

import numpy as np

from en4dvar import Batch, Field, ForwardModel, Observable, Parameter, Prior, PriorTerm, StateLayout
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Part
from en4dvar.problem import InverseProblem
from en4dvar_lorenz.lorenz96 import integrate

MODES, STEP, NOISE = 24, 0.05, 1.0


class Chaotic(ForwardModel):
    """ẋ = Lorenz-96 of 24 variables with the forcing F, read as r x: parameters F, r and the initial x_i."""

    time_unit = "1"
    compiled = True

    def __init__(self):
        names = ["F", "r", *(f"x{i}" for i in range(MODES))]
        self.parameters = tuple(Parameter(name, "1") for name in names)
        self.layout = StateLayout((*(Field(f"x{i}") for i in range(MODES)), Field("F"), Field("r")))
        self.observables = tuple(Observable(f"y{i}", "1", _Read(i)) for i in range(MODES))

    def initial_state(self, theta):
        return np.array([*(theta[f"x{i}"] for i in range(MODES)), theta["F"], theta["r"]])

    def trajectories(self, x, times):
        own = np.empty((len(x), np.shape(times)[-1]))
        own[:] = times
        path = integrate(np.ascontiguousarray(x[:, :-1]), own, STEP)
        whole = np.concatenate([path, np.repeat(x[:, None, -1:], path.shape[1], axis=1)], axis=2)
        return Batch(own, whole, self.layout)


class _Read:
    def __init__(self, i):
        self.i = i

    def __call__(self, trajectory):
        return trajectory["r"] * trajectory[f"x{self.i}"]


def chaotic(seed, until=3.0, every=0.2, seen=2):
    """The problem, and J of its truth: every second variable read each 0.2 to the time 3: errors grow by e in 0.6."""
    rng, model = np.random.default_rng(seed), Chaotic()
    spun = rng.normal(3, 3, size=(1, MODES + 1))
    spun[0, -1] = 8.0
    x0 = integrate(spun, np.array([[10.0]]), STEP)[0, 0, :MODES]
    truth = np.array([8.0 + rng.normal() * 0.5, 1.0 + 0.05 * rng.normal(), *x0])
    centre = np.array([8.0, 1.0, *(x0 + 2.0 * rng.normal(size=MODES))])
    spread = np.array([0.5, 0.05, *np.full(MODES, 2.0)])
    times = np.arange(every, until + 1e-9, every)
    run = model.trajectories(np.array([[*x0, truth[0], truth[1]]]), times)
    read = [np.asarray(model.observables[i].operator(run))[0] for i in range(0, MODES, seen)]
    values = np.concatenate(read) + NOISE * rng.normal(size=len(read) * len(times))
    k = len(times)
    parts = tuple(
        Part(model.observables[i].name, model.observables[i], j * k, (j + 1) * k)
        for j, i in enumerate(range(0, MODES, seen))
    )
    data = Observations(
        np.tile(times, len(read)), values, noise_of(np.full(len(values), NOISE)), np.ones(len(values)), parts=parts
    )
    prior = Prior(tuple(PriorTerm.normal(p, m, s) for p, m, s in zip(model.parameters, centre, spread, strict=True)))
    truth_cost = (
        0.5 * np.sum(((truth - centre) / spread) ** 2) + 0.5 * np.sum((values - np.concatenate(read)) ** 2) / NOISE**2
    )
    return InverseProblem(model, model.observables[0], data, prior), float(truth_cost)
