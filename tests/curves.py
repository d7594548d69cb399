"""Toy models in closed form. They import little, so that processes which are started for them begin soon."""

from __future__ import annotations

import os

import numpy as np

from en4dvar.model.forward import Batch, Failure, ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout

OBSERVABLE = Observable("y", "m", StateField("y", rate_of="v"))


class Toy(ForwardModel):
    """A curve y(t; θ) with its rate; the state carries (y, v, θ), so that ``step`` knows the curve."""

    observables = (OBSERVABLE,)
    of_arrays = False
    """Whether its ``curve`` and ``rate`` take the parameters (J, N) of many members."""

    def __init__(self, names=("a", "b"), batch=1, compiled=False):
        self.parameters = tuple(Parameter(name, "m") for name in names)
        self.layout = StateLayout((Field("y"), Field("v"), Field("theta", len(names))))
        self.batch, self.compiled = batch, compiled

    def curve(self, theta, t):
        raise NotImplementedError

    def rate(self, theta, t):
        raise NotImplementedError

    def initial_state(self, theta):
        values = np.array([theta[p.name] for p in self.parameters])
        return np.concatenate([[self.curve(values, 0.0), self.rate(values, 0.0)], values])

    def initial_states(self, theta):
        """All at once, where curves take arrays, as those below do."""
        kind = type(self)
        if kind.initial_state is not Toy.initial_state or not (kind.of_arrays or kind.curve in ARRAYS):
            return super().initial_states(theta)
        values = np.stack([theta[p.name] for p in self.parameters])
        return np.stack([self.curve(values, 0.0), self.rate(values, 0.0), *values], axis=1)

    def step(self, x, t0, t1):
        theta = x[2:]
        return np.concatenate([[self.curve(theta, t1), self.rate(theta, t1)], theta])


class Linear(Toy):
    """y = Σ_j θ_j cos(j t + j²/3): linear in θ."""

    def curve(self, theta, t):
        j = np.arange(len(theta))
        return np.cos(j * t + j**2 / 3) @ theta

    def rate(self, theta, t):
        j = np.arange(len(theta))
        return -(j * np.sin(j * t + j**2 / 3)) @ theta


class Closed(Toy):
    """All members in one array expression of ``curve`` and ``rate``, unless a class has a step or curve of its own."""

    def trajectories(self, x, times):
        kind = type(self)
        if kind.step is not Toy.step or not (kind.of_arrays or kind.curve in ARRAYS):
            return super().trajectories(x, times)
        own, theta = np.broadcast_to(times, (len(x), np.shape(times)[-1])), x[:, 2:]
        y, v = (np.broadcast_to(of(theta.T[..., None], own), own.shape) for of in (self.curve, self.rate))
        held = np.broadcast_to(theta[:, None], (*own.shape, theta.shape[1]))
        states = np.concatenate([y[..., None], v[..., None], held], axis=-1)
        return Batch(own, states, self.layout)


class Decay(Closed):
    """y = a exp(−b t) + 0.3 b t: mildly nonlinear."""

    def curve(self, theta, t):
        a, b = theta
        return a * np.exp(-b * t) + 0.3 * b * t

    def rate(self, theta, t):
        a, b = theta
        return -a * b * np.exp(-b * t) + 0.3 * b


class Wave(Closed):
    """y = a sin(3 b t) + 0.2 b²: strongly nonlinear in b."""

    def curve(self, theta, t):
        a, b = theta
        return a * np.sin(3 * b * t) + 0.2 * b * b

    def rate(self, theta, t):
        a, b = theta
        return 3 * a * b * np.cos(3 * b * t)


ARRAYS = (Linear.curve, Decay.curve, Wave.curve)


class Fragile(Linear):
    """Linear, but it cannot integrate members whose first parameter is beyond ``limit``, in one of three ways."""

    def __init__(self, limit, how="value", **options):
        super().__init__(**options)
        self.limit, self.how = limit, how

    def initial_state(self, theta):
        if self.how == "initial_state" and theta["a"] > self.limit:
            raise ArithmeticError("no equilibrium")
        return super().initial_state(theta)

    def trajectories(self, x, times):
        bad = x[:, 2] > self.limit
        if self.how == "raise" and bad.any():
            raise FloatingPointError("overflow")
        if self.how == "short" and bad.any():
            return super().trajectories(x[~bad], times[~bad])
        results = list(super().trajectories(x, times))
        for i in np.flatnonzero(bad):
            results[i] = Failure("too stiff", 0.1)
        return results


class Vectorised(Linear):
    """The fast path: all members in one array expression."""

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        j = np.arange(x.shape[1] - 2)
        phase = own[:, :, None] * j + j**2 / 3
        y = np.sum(x[:, None, 2:] * np.cos(phase), axis=-1)
        v = -np.sum(x[:, None, 2:] * j * np.sin(phase), axis=-1)
        theta = np.broadcast_to(x[:, None, 2:], (*own.shape, len(j)))
        states = np.concatenate([y[..., None], v[..., None], theta], axis=-1)
        return Batch(own, states, self.layout)


class Counted:
    """Of a model that this is mixed into, how many members have been run."""

    runs = 0

    def trajectories(self, x, times):
        self.runs += len(x)
        return super().trajectories(x, times)


class Dying(Linear):
    """Kills its process where the first parameter is negative."""

    def trajectories(self, x, times):
        if np.any(x[:, 2] < 0):
            os._exit(3)
        return super().trajectories(x, times)
