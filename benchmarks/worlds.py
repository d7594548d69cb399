"""What makes the readings of a synthetic experiment, where it is not what they are fitted with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from en4dvar.ensemble.forecast import Forecast, forecast
from en4dvar.model.state import Array, Parameter
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar_bubble import BubbleModel

FAR_OFF = 8.0  # standard deviations of an outlier


@dataclass(frozen=True)
class Twin:
    """An inverse problem and the truth (n,), transformed, that made its data."""

    problem: InverseProblem
    truth: Array


@dataclass(frozen=True)
class World:
    """By default everything is as the fit has it; ``stream`` keeps its random numbers apart from an experiment's.

    ``renamed``: parameter of the fit → that of ``model`` which has its value. ``fixed`` values of ``model``, SI.
    Readings are ``scale`` times what they should be, each is made up to ``jitter`` (s) before or after its instant,
    errors forget themselves in ``correlation_time`` (s), and a share of them, ``outliers``, is 8 standard deviations.
    """

    model: BubbleModel | None = None
    renamed: Mapping[str, Parameter] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    scale: float = 1.0
    jitter: float = 0.0
    correlation_time: float = 0.0
    outliers: float = 0.0
    stream: int = 20212

    def run(self, problem: InverseProblem, truth: Array, seed: int) -> Forecast:
        """The experiment of a truth (n,), the values of the parameters of the fit, transformed."""
        model, observed = self.model or problem.model, problem.observations
        terms = (replace(t, parameter=self.renamed.get(t.parameter.name, t.parameter)) for t in problem.prior.terms)
        off = np.random.default_rng([self.stream, seed, 0]).uniform(-self.jitter, self.jitter, len(observed.times))
        made = InverseProblem(
            model,
            model.observables[0],
            replace(observed, times=observed.times + off),
            Prior(tuple(terms)),
            {**problem.fixed, **self.fixed},
        )
        return forecast(made, truth[None])

    def values(self, problem: InverseProblem, run: Forecast, normal: Array, seed: int) -> Array:
        """Readings (K,) of its run; ``normal`` (K,) are standard normal."""
        observed = problem.observations
        errors = normal
        if self.correlation_time:
            lags = np.abs(np.subtract.outer(observed.times, observed.times))
            errors = np.linalg.cholesky(np.exp(-lags / self.correlation_time)) @ errors
        random = np.random.default_rng([self.stream, seed, 1])
        far = random.random(len(normal)) < self.outliers
        errors = np.where(far, FAR_OFF * random.choice((-1.0, 1.0), len(normal)), errors)
        return np.asarray(self.scale * run.predictions[0] + observed.noise.std * errors)


RIGHT = World()


def read_once(problem: InverseProblem, seed: list[int], world: World = RIGHT) -> Twin:
    """Readings at the times of a problem, of a truth from its prior."""
    of, observed, rng = problem.prior, problem.observations, np.random.default_rng(seed)
    while True:
        truth = of.mean + of.std * rng.standard_normal(len(of.names))
        run = world.run(problem, truth, seed[-1])
        if not run.failures[0]:
            break
    values = world.values(problem, run, rng.standard_normal(len(observed.times)), seed[-1])
    return Twin(replace(problem, observations=replace(observed, values=values)), truth)
