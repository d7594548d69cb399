"""Small forward models for tests: importable, so that spawned processes find them."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
from scipy.linalg import expm

import en4dvar
from en4dvar.data.noise import Kernel, noise_of
from en4dvar.data.observations import Observations
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.model.forward import Failure, ForwardModel, Observable, StateField, Trajectory
from en4dvar.model.state import NOISE_SCALE, Field, Parameter, StateLayout
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem, discrepancy_parameters
from en4dvar.schemes.base import Weights

OBSERVABLE = Observable("y", "m", StateField("y", rate_of="v"))


class Toy(ForwardModel):
    """A curve y(t; θ) with its rate; the state carries (y, v, θ), so that ``step`` knows the curve."""

    observables = (OBSERVABLE,)

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
        """All at once, of the curves below, which take arrays."""
        kind = type(self)
        if kind.initial_state is not Toy.initial_state or kind.curve not in (Linear.curve, Decay.curve, Wave.curve):
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
        if kind.step is not Toy.step or kind.curve not in (Decay.curve, Wave.curve):
            return super().trajectories(x, times)
        own, theta = np.broadcast_to(times, (len(x), np.shape(times)[-1])), x[:, 2:]
        y, v = (np.broadcast_to(of(theta.T[..., None], own), own.shape) for of in (self.curve, self.rate))
        held = np.broadcast_to(theta[:, None], (*own.shape, theta.shape[1]))
        states = np.concatenate([y[..., None], v[..., None], held], axis=-1)
        return [Trajectory(t, s, self.layout) for t, s in zip(own, states, strict=True)]


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
        return [Trajectory(t, s, self.layout) for t, s in zip(own, states, strict=True)]


def make_observations(times, values, std=0.1, time_std=0.0, weights=1.0, name="toy"):
    k = len(times)
    std, time_std, weights = (
        np.broadcast_to(np.asarray(v, dtype=float), (k,)).copy() for v in (std, time_std, weights)
    )
    y = np.asarray(values, dtype=float)
    return Observations(np.asarray(times, dtype=float), y, noise_of(std, time_std), weights, name=name)


def cosines_estimated(n, y, std, seed):
    """The default estimate of a sum of n cosines and of the scale of its errors from readings y over half a period of
    the slowest; ``std`` is the stated error."""
    return en4dvar.estimate(
        lambda p, t: sum(p[f"c{i}"] * np.cos(i * np.pi * t) for i in range(n)),
        (np.linspace(0, 1, len(y)), y),
        {f"c{i}": {"prior": "normal", "mean": 0, "std": 3} for i in range(n)}
        | {"sigma": {"prior": "lognormal", "median": 1, "log_std": 1}},
        error=std,
        seed=seed,
        progress=False,
    )


def with_noise(observations, **kind):
    """The same readings with correlated errors, or robust ones."""
    noise = observations.noise
    return replace(observations, noise=noise_of(noise.std, noise.time_std, **kind))


def make_problem(model, truth, *, std=0.1, time_std=0.0, weights=1.0, seed=1, k=9, prior=None, scale=1.0):
    """A twin experiment: data of the toy at ``truth`` plus noise, prior N(0.8 truth, scale²) unless given."""
    times = np.linspace(0.2, 2.0, k)
    noise = np.random.default_rng(seed).standard_normal(k)
    values = np.array([model.curve(np.asarray(truth, dtype=float), t) for t in times]) + std * noise
    terms = prior or tuple(
        PriorTerm.normal(p, 0.8 * value, scale) for p, value in zip(model.parameters, truth, strict=True)
    )
    observations = make_observations(times, values, std, time_std, weights)
    return InverseProblem(model, OBSERVABLE, observations, Prior(tuple(terms)))


def with_discrepancy(
    problem, *, sigma=None, huber=None, correlation=None, amplitude=(0.2, 0.5), length=(0.6, 0.4), **kernel
):
    """The problem with a discrepancy whose amplitude and length have lognormal priors (median, log std)."""
    o = problem.observations
    noise = noise_of(o.noise.std, o.noise.time_std, correlation, huber, Kernel(o.times, **kernel))
    parameters = discrepancy_parameters(problem.model, problem.observable)
    terms = [*problem.prior.terms, *map(PriorTerm.lognormal, parameters, *zip(amplitude, length, strict=True))]
    if sigma is not None:
        terms.append(PriorTerm.lognormal(NOISE_SCALE, 1.0, sigma))
    return replace(problem, observations=replace(o, noise=noise), prior=Prior(tuple(terms)))


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


def visit(space, w):
    """The descent at weights ``w`` of a space: J there and the Gauss–Newton step."""
    descent = Descent(Weights(w, np.eye(len(space.members))))
    window = DataWindow(space)
    (descent.step,) = window.linearise([descent])
    return descent


SLOPE = np.array([[0.0, 1.0], [-2.0, -0.15]])  # of the state (x, v) of a swing


class Swing(ForwardModel):
    """ẍ = −2 x − 0.15 ẋ from x = 1 m at rest; no parameters."""

    parameters = ()
    layout = StateLayout((Field("x", unit="m"), Field("v", unit="m/s")))
    observables = (Observable("x", "m", StateField("x")),)

    def initial_state(self, theta):
        return np.array([1.0, 0.0])

    def step(self, x, t0, t1):
        return expm(SLOPE * (t1 - t0)) @ x
