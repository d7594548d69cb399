"""Campaigns of bubbles whose single posteriors are exact, for ``campaigns.py``.

Of every bubble G and μ, in units of their priors, are read with errors of their own, and with two modes in every third
(an alias that its likelihood knows of); all readings are shifted by scale, density and pressure, drawn from their
stated priors. Posteriors are Gaussian mixtures in closed form; as many draws of them enter as a run has effective ones,
and all behind them is the program's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import Population, population_from
from en4dvar.estimation.population.own import KEPT, OwnDraws
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Array, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

NAMES, COMMON = ("G", "mu"), ("scale", "rho", "p_inf")
EFFECTIVE = 200  # independent draws that the posterior of a single run stands for
LOG_STD = 2.0  # of the priors of G and μ
LIKE, FREEDOM = 0.1, 3.0  # spread of bubbles of one gel, in units of the prior; degrees of freedom of heavy tails
ERRORS = (0.03, 0.15)  # of single bubbles: G to 6 to 30 %
ALIAS = np.array([0.8, -0.8])  # of the second mode
# Slopes of ln G and ln μ with the logarithms of the common quantities, times their stated priors (2, 1, 1 %); how far
# off an odd bubble is in both, and its errors over those of the others: least squares on bubbles of 400 µm and 8 kPa
SLOPES = np.array([[14.0, -7.0, 6.5], [2.3, -0.8, 0.2]]) * [0.02, 0.01, 0.01] / LOG_STD
SHIFTS = {
    "gel": ((np.log(4), 0.0), (0.4, 1.0)),
    "scale": ((0.82, 0.16), (0.6, 1.0)),
    "law": ((1.35, 0.3), (0.35, 0.7)),
}
KINDS = ("normal", "like", "heavy", *SHIFTS)


def nothing(values: dict[str, float], times: Array) -> Array:
    return 0.0 * times


def bubble(name: str, common: Sequence[str] = COMMON) -> InverseProblem:
    """What a population asks of a data set beside its draws: its name and priors."""
    parameters = [Parameter(n, "1") for n in NAMES] + [Parameter(n, "1", common=True) for n in common]
    model = FunctionModel(nothing, parameters, {"y": "1"})
    none = np.zeros(2)
    data = Observations(np.array([0.0, 1.0]), none, noise_of(none + 1.0, none), none + 1.0, name=name)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in parameters))
    return InverseProblem(model, model.observables[0], data, prior)


@dataclass(frozen=True)
class Campaign:
    """Readings ``y`` (S, 2) with errors (S, 2), ``aliased`` (S,) where there are two modes, and the truth: ν and τ
    (2,), θ (3,), and which are ``odd``.
    """

    y: Array
    error: Array
    aliased: Array
    nu: Array
    tau: Array
    theta: Array
    odd: list[int]

    def drawn(self, rng: np.random.Generator, slopes: Array = SLOPES) -> list[OwnDraws]:
        """Draws of each bubble, which takes the common quantities of ``slopes`` (2, c) as uncertain."""
        each = zip(self.y, self.error, self.aliased, strict=True)
        return [own_draws_of(y, error, aliased, rng, slopes) for y, error, aliased in each]

    def odds(self) -> Array:
        """(S,) of being odd, with ν, τ, θ and the errors known."""
        hyper = HyperPrior()
        variance, middle = self.tau**2 + self.error**2, self.nu + SLOPES @ self.theta
        wider, wide = variance + hyper.mean_std**2, 1 + self.error**2
        of_it, elsewhere = self._density(middle, variance), np.zeros(len(self.y))
        for j in range(2):
            one = np.where(np.arange(2) == j, wider, variance)
            elsewhere = elsewhere + self._density(middle, one) / 4
        elsewhere = elsewhere + self._density(SLOPES @ self.theta, wide) / 2
        return np.asarray(hyper.odd / (1 - hyper.odd) * elsewhere / of_it)

    def _density(self, middle: Array, variance: Array) -> Array:
        first, second = (norm(middle, np.sqrt(variance)).pdf(y).prod(axis=1) for y in (self.y, self.y - ALIAS))
        return np.asarray(np.where(self.aliased, (first + second) / 2, first))


def own_draws_of(y: Array, error: Array, aliased: bool, rng: np.random.Generator, slopes: Array) -> OwnDraws:
    """Draws of (x, θ) given y = x + slopes θ + error, and perhaps the alias, x and θ being N(0, I)."""
    H = np.column_stack([np.eye(2), slopes])
    S = H @ H.T + np.diag(error**2)
    gain = H.T @ np.linalg.inv(S)
    left = np.eye(len(gain)) - gain @ H
    readings = [y, y - ALIAS] if aliased else [y]
    logs = np.array([-0.5 * r @ np.linalg.solve(S, r) for r in readings])
    share = np.exp(logs - np.logaddexp.reduce(logs))
    count = EFFECTIVE
    means = np.array([gain @ r for r in readings])[rng.choice(len(readings), count, p=share)]
    z = means + rng.multivariate_normal(np.zeros(len(gain)), left, count)
    return OwnDraws(z[rng.integers(count, size=KEPT)], float(np.logaddexp.reduce(logs)), float(count), 0)


def campaign(
    kind: str, bubbles: int, rng: np.random.Generator, truth: tuple[Array, Array] | None = None,
    errors: tuple[float, float] = ERRORS,
) -> Campaign:  # fmt: skip
    """Of one kind; ``truth``: θ and ν, instead of drawn."""
    hyper = HyperPrior()
    theta, nu = truth or (rng.standard_normal(len(COMMON)), hyper.mean_std * rng.standard_normal(2))
    tau = hyper.spread * np.abs(rng.standard_normal(2)) if kind == "normal" else np.full(2, LIKE)
    heavy = rng.standard_t(FREEDOM, (bubbles, 2)) / np.sqrt(FREEDOM / (FREEDOM - 2))
    x = nu + tau * (heavy if kind == "heavy" else rng.standard_normal((bubbles, 2)))
    error, odd = rng.uniform(*errors, (bubbles, 2)), []
    if kind in SHIFTS:
        shift, wider = SHIFTS[kind]
        x[0] += np.array(shift) / LOG_STD
        error[0] *= wider
        odd = [0]
    if kind == "normal":
        odd = np.flatnonzero(rng.uniform(size=bubbles) < hyper.odd).tolist()
        for i in odd:  # as if it belonged to none, or elsewhere in one parameter
            where = rng.choice(3, p=[0.5, 0.25, 0.25])
            x[i] = rng.standard_normal(2) if where == 0 else x[i]
            x[i, where - 1] += hyper.mean_std * rng.standard_normal() * (where > 0)
    aliased = np.arange(bubbles) % 3 == 2
    y = x + SLOPES @ theta + error * rng.standard_normal((bubbles, 2))
    y[aliased] += ALIAS * (rng.uniform(size=(int(aliased.sum()), 1)) < 0.5)
    return Campaign(y, error, aliased, nu, tau, theta, odd)


def found_of(
    drawn: Sequence[OwnDraws], seed: int, problems: Sequence[InverseProblem] = (), names: Sequence[str] = COMMON,
    hyper: HyperPrior | None = None,
) -> Population:  # fmt: skip
    problems = problems or [bubble(f"bubble{i}", names) for i in range(len(drawn))]
    start = [draws.z for draws in drawn]
    return population_from(dict(enumerate(drawn)), {}, start, problems, NAMES, seed, hyper or HyperPrior(), Effort())
