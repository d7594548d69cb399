"""Problems of small forward models, which are in ``curves``, and what else several tests do with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from curves import OBSERVABLE as OBSERVABLE
from curves import Closed as Closed
from curves import Counted as Counted
from curves import Decay as Decay
from curves import Dying as Dying
from curves import Fragile as Fragile
from curves import Linear as Linear
from curves import Toy as Toy
from curves import Vectorised as Vectorised
from curves import Wave as Wave
from scipy.linalg import expm

import en4dvar
from en4dvar.data.noise import Kernel, noise_of
from en4dvar.data.observations import Observations
from en4dvar.descent.window import DataWindow, Descent
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import NOISE_SCALE, Field, StateLayout
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem, discrepancy_parameters
from en4dvar.schemes.base import Weights


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


def cost_by_definition(problem, x):
    """J_b and J_o (B,) of parameters (B, n), written out for normal priors and independent errors of known std."""
    o, (mean, std) = problem.observations, np.array([(term.mean, term.std) for term in problem.prior.terms]).T
    curve = problem.model.curve
    if problem.model.of_arrays:
        predictions = curve(x.T[..., None], o.times)
    else:
        predictions = np.array([[curve(row, t) for t in o.times] for row in x])
    misfits = (o.values - predictions) / o.std
    return 0.5 * np.sum(((x - mean) / std) ** 2, axis=1), 0.5 * np.sum(o.weights * misfits**2, axis=1)


def assert_cost_by_definition(analysis):
    """J_b and J_o where the iterations ended are those of :func:`cost_by_definition`."""
    last = analysis.iterations[-1]
    background, observation = cost_by_definition(analysis.problem, last.centre[None])
    assert last.background == pytest.approx(background[0], rel=1e-9)
    assert last.observation == pytest.approx(observation[0], rel=1e-9)


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
