"""Problems built to end badly, one for each warning, and problems that end well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from estimation.test_lost_frame import problem as filmed
from toys import (
    Decay,
    Fragile,
    Linear,
    Toy,
    Vectorised,
    Wave,
    make_observations,
    make_problem,
    with_discrepancy,
    with_noise,
)
from varying_models import Ramp

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Alternative, Observable, ValidityLimit
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying import RandomWalk
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

TWO = ("a", "b")


class Violent(Vectorised):
    """Says of itself that it does not hold where |y| exceeds 0.9 m."""

    validity = (ValidityLimit("y", 0.9, "m", "largest excursion", "a test"),)


class Coarse(Linear):
    """With outputs 0.6 s apart, and straight lines between them."""

    interpolated = ("y",)

    def curve(self, theta, t):
        before = 0.6 * np.floor(t / 0.6)
        y, after = super().curve(theta, before), super().curve(theta, before + 0.6)
        return y + (t - before) / 0.6 * (after - y)


class Doubtful(Vectorised):
    """Does not believe a reading that no prior member comes near."""

    def doubts(self, observable, times, values, predicted, members):
        assert (len(times), len(times)) == (len(values), predicted.shape[1])
        assert {name: len(value) for name, value in members.items()} == dict.fromkeys(TWO, len(predicted))
        return [f"no {observable} is like this"] * bool(len(predicted))


class Product(Toy):
    """y = a b: the data know the product alone, so the posterior is a bent ridge."""

    def curve(self, theta, t):
        a, b = theta
        return float(a * b)

    def rate(self, theta, t):
        return 0.0


class Signless(Toy):
    """y = a² t: the data do not know the sign of a."""

    def curve(self, theta, t):
        return float(theta[0] ** 2 * t)

    def rate(self, theta, t):
        return float(theta[0] ** 2)


def signless() -> InverseProblem:
    return make_problem(Signless(("a",)), (1.0,), prior=(PriorTerm.normal(Parameter("a", "m"), 0.0, 1.0),))


def run(problem: InverseProblem, **settings: object) -> Analysis:
    return assimilate(problem, AssimilationSettings(**settings), 1)  # type: ignore[arg-type]


def linear(truth: tuple[float, ...] = (1.0, 0.5), **options: object) -> InverseProblem:
    return make_problem(Vectorised(TWO), truth, **options)


def bounded(truth: float, term: Callable[[Parameter], PriorTerm], bounds: tuple[float, float]) -> InverseProblem:
    model = Vectorised(TWO)
    a = Parameter("a", "m", bounds=bounds)
    return make_problem(model, (truth, 0.5), prior=(term(a), PriorTerm.normal(model.parameters[1], 0.5, 1.0)))


def many(n: int, **options: object) -> InverseProblem:
    return make_problem(Vectorised(tuple(f"p{i}" for i in range(n))), (1.0,) * n, k=3 * n, std=0.01, **options)


def outlier() -> InverseProblem:
    problem = linear()
    values = problem.observations.values.copy()
    values[3] += 0.8
    return replace(problem, observations=with_noise(replace(problem.observations, values=values), huber=1.5))


def bent(std: float = 0.05) -> InverseProblem:
    """Data with a slow wave that the model lacks, smaller than the error that is stated."""
    problem = make_problem(Vectorised(TWO), (1.0, 0.5), k=40, std=std)
    y = problem.observations
    rough = np.random.default_rng(5).standard_normal(40)
    exact = y.values - std * np.random.default_rng(1).standard_normal(40)
    return replace(problem, observations=replace(y, values=exact + std * (0.9 * np.sin(5 * y.times) + 0.3 * rough)))


def waved(height: float) -> InverseProblem:
    """Data with a slow wave of so many errors that the model lacks, but a discrepancy allows for."""
    problem = make_problem(Vectorised(TWO), (1.0, 0.5), k=40, std=0.05)
    y = problem.observations
    wave = 0.05 * height * np.sin(5 * y.times)
    seen = replace(problem, observations=replace(y, values=y.values + wave))
    return with_discrepancy(seen, amplitude=(0.025, 1.5), length=(0.2, 0.7))


def half_known() -> InverseProblem:
    """What the prior says of b is far better than what the data could say."""
    model = Vectorised(TWO)
    a, b = model.parameters
    return make_problem(model, (1.0, 0.5), prior=(PriorTerm.normal(a, 0.8, 1.0), PriorTerm.normal(b, 0.5, 0.001)))


def near_zero(read: float, std: float = 0.1, log_std: float = 2.0) -> InverseProblem:
    """A positive slope, its prior about 1, that was read with an error."""
    model = Vectorised(("a",))
    a = Parameter("a", "m", bounds=(0.0, np.inf))
    problem = make_problem(model, (1.0,), k=1, prior=(PriorTerm.lognormal(a, 1.0, log_std),))
    t = problem.observations.times[0]
    data = replace(problem.observations, values=np.array([read * model.curve(np.ones(1), t)]))
    return replace_std(replace(problem, observations=data), std * model.curve(np.ones(1), t))


def spiked() -> InverseProblem:
    problem = make_problem(Vectorised(TWO), (1.0, 0.5), k=40)
    values = problem.observations.values.copy()
    values[12] += 0.8
    return replace(problem, observations=replace(problem.observations, values=values))


def chain_not_converged() -> Analysis:
    return run(linear(), refine="mcmc", members=12)


def ramp(knots) -> InverseProblem:
    """A rate that is halved at 2, with readings of high accuracy."""
    model, times = Ramp(), np.linspace(0.25, 5.0, 20)
    values = 1.0 + np.where(times < 2, 1.2 * times, 2.4 + 0.6 * (times - 2))
    first = PriorTerm.normal(model.parameters[0], 1.0, 0.5)
    data = make_observations(times, values, 0.05)
    constant = InverseProblem(model, model.observables[0], data, Prior((first,)))
    return constant.varied([RandomWalk.of(model, first, knots, 0.5)])


class Offered(Linear):
    """Offers a curve with a wave of another height."""

    def __init__(self, height: float) -> None:
        super().__init__(TWO)
        self.height = height

    def curve(self, theta, t):
        return super().curve(theta, t) + self.height * np.sin(9 * t)

    def rate(self, theta, t):
        return super().rate(theta, t) + 9 * self.height * np.cos(9 * t)

    @property
    def alternatives(self):
        other, options = Offered(0.6 - self.height), "" if self.height else "--set model.height='0.6 m'"
        return (
            Alternative("wave", "there were no wave" if self.height else "there were a wave", other, options=options),
        )


def waving(height: float = 0.0) -> InverseProblem:
    """Readings with that wave, and a model that has it, or offers it."""
    return replace(make_problem(Offered(0.6), (1.0, 0.5), k=40), model=Offered(height))


def turned(window: int) -> InverseProblem:
    """A line that turns where the window of so many readings ends."""
    model, times = Vectorised(TWO), np.linspace(0.2, 4.0, 20)
    problem = make_problem(model, (1.0, 0.5))
    values = np.array([model.curve(np.array([1.0, 0.5]), t) for t in times]) + 3 * np.maximum(times - times[9], 0)
    whole = make_observations(times, values, 0.1)
    first = make_observations(times[:window], values[:window], 0.1)
    return replace(problem, observations=replace(first, continued=whole if window < len(times) else None))


PROVOKED: dict[str, Callable[[], Analysis]] = {
    "not-converged": lambda: run(
        make_problem(Wave(), [1.5, 1.2], scale=0.4), members=16, max_iterations=1, start="prior-mean"
    ),
    "ensemble-collapse": lambda: run(many(40), members=4, sampling="random", scheme="es-mda"),
    "rank-deficient": lambda: run(many(8), members=6, sampling="random"),
    "future-missed": lambda: run(turned(10)),
    "missed-knots": lambda: run(ramp((2.6,))),
    "lost-frame": lambda: run(filmed(1.0), members=12),
    "misfit": lambda: run(replace_std(linear(scale=100.0), 0.01)),
    "overstated-error": lambda: run(replace_std(linear(scale=100.0), 10.0)),
    "prior-conflict": lambda: run(linear(scale=0.02, std=0.001)),
    "implausible-data": lambda: run(make_problem(Doubtful(TWO), (1.0, 0.5))),
    "coarse-outputs": lambda: run(make_problem(Coarse(TWO), (1.0, 1.5), k=40, std=0.04)),
    "model-validity": lambda: run(make_problem(Violent(TWO), (1.0, 0.5))),
    "members-lost": lambda: run(
        make_problem(Fragile(0.2, names=TWO), (-1.0, 0.5)), members=40, min_active_fraction=0.2
    ),
    "readings-missing": lambda: run(replace(linear(), observable=Observable("y", "m", gappy))),
    "at-bound": lambda: run(bounded(1.6, lambda a: PriorTerm.logit(a, (0.0, 1.0), 0.5, 1.5), (0.0, 1.0))),
    "non-gaussian": lambda: run(make_problem(Product(TWO), (1.0, 1.0), std=0.1)),
    "several-modes": lambda: run(signless(), members=16),
    "starts-disagree": lambda: run(make_problem(Wave(), [1.5, 3.0], scale=2.5), members=4),
    "residual-structure": lambda: run(bent()),
    "odd-residuals": lambda: run(spiked()),
    "discrepancy-found": lambda: run(waved(3.0)),
    "other-assumption": lambda: run(waving()),
    "one-descent": lambda: run(linear(), starts=1),
    "start-moved": lambda: run(
        make_problem(Fragile(-0.9, names=TWO), (-1.0, 0.5)), start="prior-mean", min_active_fraction=0.2
    ),
    "down-weighted": lambda: run(outlier()),
    "not-bayesian": lambda: run(make_problem(Vectorised(TWO), (1.0, 0.5), weights=1 / 9)),
    "upper-limit": lambda: run(near_zero(0.0), refine="mcmc"),
    "not-informed": lambda: run(half_known()),
}


def gappy(path: Any) -> Any:
    """y, of which some members lack the fourth reading."""
    y = np.array(path["y"], dtype=float)
    y[3] = np.nan if str(float(y[0]))[-1] in "0369" else y[3]
    return y


def replace_std(problem: InverseProblem, std: float) -> InverseProblem:
    problem.observations.std[:] = std
    return problem


def well_specified(model: Toy, terms: tuple[PriorTerm, ...], std: float, count: int, seed: int) -> list[InverseProblem]:
    """Experiments whose truth is drawn from the prior and whose noise is as stated."""
    prior = make_problem(model, (1.0,) * len(terms), prior=terms).prior
    truths = prior.to_physical(prior.sample(count, seed, "random"))
    return [make_problem(model, truth, prior=terms, seed=seed + 1 + i, std=std, k=9) for i, truth in enumerate(truths)]


def linear_experiments(count: int, seed: int) -> list[InverseProblem]:
    model = Vectorised(("a", "b", "c"))
    terms = tuple(PriorTerm.normal(p, 0.5, 1.0) for p in model.parameters)
    return well_specified(model, terms, 0.3, count, seed)


def decay_experiments(count: int, seed: int) -> list[InverseProblem]:
    model = Decay()
    a, b = model.parameters
    return well_specified(
        model, (PriorTerm.lognormal(a, 1.2, 0.3), PriorTerm.lognormal(b, 1.0, 0.3)), 0.05, count, seed
    )
