r"""The population of a campaign's data sets, whatever their law, start and priors.

All quantities are in white coordinates of each data set's own prior (:meth:`~en4dvar.prior.Prior.white`): hyperpriors
then have no unit, ν ~ N(prior mean, (``mean_std`` prior std)²) and τ ~ half-normal(``spread`` prior std), and what is a
data set's own (a radius, a time shift) may have a prior of its own in each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.errors import ConfigError
from en4dvar.executor import Executor
from en4dvar.hints import suggest
from en4dvar.population.effort import Effort
from en4dvar.population.estimate import FEWEST_SETS, Population, estimate_population, moments
from en4dvar.population.hyper import HyperPrior
from en4dvar.prior import Prior, PriorTerm, member_stream
from en4dvar.problem import InverseProblem
from en4dvar.sampling.forward_runs import ForwardRuns
from en4dvar.sampling.mixture import effective_number, resampled
from en4dvar.state import Array, Parameter

DETERMINED = 0.9  # of the hyperprior's variance, taken away by the data
IN_IT = 0.2  # of the largest exponent: a parameter that is part of a combination
HALF_NORMAL_VARIANCE = 1 - 2 / np.pi


@dataclass(frozen=True)
class Draws:
    """Physical draws (M, p) of the population mean, of the standard deviation between data sets, and of the next one;
    in units of the prior ``nu`` and ``tau``.
    """

    mean: Array
    between: Array
    next: Array
    nu: Array
    tau: Array


@dataclass(frozen=True)
class CampaignPopulation:
    """The population of ``names`` in ``problems``: ``posterior`` and ``prior`` draws; ``sets`` (M, S, n) physical, each
    data set given all of them; ``estimate`` in units of the prior.
    """

    problems: tuple[InverseProblem, ...]
    hyper: HyperPrior
    estimate: Population
    posterior: Draws
    prior: Draws
    sets: Array

    @property
    def names(self) -> tuple[str, ...]:
        return self.estimate.names

    @property
    def terms(self) -> tuple[PriorTerm, ...]:
        """Priors of ``names``, the same in all data sets."""
        return terms_of(self.problems, self.names)

    @property
    def learned(self) -> tuple[Array, Array]:
        """(p,) each: what share of the hyperprior's variance of ν and of τ the data have taken away."""
        nu, tau = self.posterior.nu, self.posterior.tau
        return (
            1 - nu.var(axis=0) / self.hyper.mean_std**2,
            1 - tau.var(axis=0) / (HALF_NORMAL_VARIANCE * self.hyper.spread**2),
        )

    def without_hyperprior(self, seed: int) -> tuple[Draws, float]:
        """Draws as they are where ν and τ are equally likely everywhere, and how many of them count.

        From the posterior's draws, weighed; fewer than :data:`~en4dvar.population.estimate.FEWEST` say that the
        hyperprior decides.
        """
        d, h = self.posterior, self.hyper
        logs = 0.5 * np.sum((d.nu / h.mean_std) ** 2 + (d.tau / h.spread) ** 2, axis=1)
        weights = np.exp(logs - logs.max())
        taken = resampled(weights / weights.sum(), len(weights), member_stream(seed, "without hyperprior"))
        kept = Draws(d.mean[taken], d.between[taken], d.next[taken], d.nu[taken], d.tau[taken])
        return kept, effective_number(weights) / len(weights) * self.estimate.size

    def combinations(self) -> tuple[Combination, ...]:
        """What the data determine of the means together, where they determine one of them not by itself."""
        if np.all(self.learned[0] >= DETERMINED):
            return ()
        values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(self.posterior.nu.T)) / self.hyper.mean_std**2)
        scales = np.array([term.std for term in self.terms])
        found = []
        for value, vector in zip(values, vectors.T, strict=True):
            slopes = vector / scales  # Σ v_j z_j = Σ (v_j / s_j) x_j + …
            slopes = slopes / slopes[np.argmax(np.abs(vector))]
            kept = np.abs(vector) > IN_IT * np.abs(vector).max()
            if 1 - value >= DETERMINED and kept.sum() > 1:
                std = float((self.posterior.nu[:, kept] * scales[kept] @ slopes[kept]).std())
                parts = tuple((self.names[j], float(slopes[j])) for j in np.flatnonzero(kept))
                found.append(Combination(parts, std))
        return tuple(found)


@dataclass(frozen=True)
class Combination:
    """Σ a_j x_j of transformed population means, known to ``std``: of lognormal ones a product Π θ_j^{a_j}."""

    parts: tuple[tuple[str, float], ...]
    std: float


def terms_of(problems: Sequence[InverseProblem], names: Sequence[str]) -> tuple[PriorTerm, ...]:
    """Priors of ``names``. Raises :class:`ConfigError`: not estimated in all problems, or with other priors."""
    found = []
    for name in names:
        for problem in problems:
            if name not in problem.prior.names:
                words = f"{name}: not estimated in {problem.observations.name}{suggest(name, problem.prior.names)}"
                raise ConfigError(words)
        terms = [one.prior.terms[one.prior.names.index(name)] for one in problems]
        if any(term != terms[0] for term in terms):
            raise ConfigError(f"{name}: its prior must be the same in all data sets of a population")
        found.append(terms[0])
    return tuple(found)


def runs_of(problems: Sequence[InverseProblem], names: Sequence[str], executor: Executor | None = None) -> ForwardRuns:
    """Forward runs for the population of ``names``. Raises :class:`ConfigError`, see :func:`population_of`."""
    if any(one.prior.blocks for one in problems):
        raise ConfigError("a population needs priors that are not correlated")
    terms_of(problems, names)
    return ForwardRuns(problems, executor, white=True)


def population_of(
    problems: Sequence[InverseProblem],
    start: Sequence[Array],
    names: Sequence[str],
    seed: int,
    *,
    executor: Executor | None = None,
    hyper: HyperPrior | None = None,
    effort: Effort | None = None,
    workers: int = 1,
) -> CampaignPopulation:
    """The population of ``names`` behind data sets of the same parameters.

    Parameters
    ----------
    start: of each data set control vectors (N_i, n) near its posterior, in white coordinates of its prior.
    hyper: in units of the prior's standard deviations.

    Raises
    ------
    ConfigError: fewer than 3 data sets; parameters or errors that :class:`~en4dvar.sampling.forward_runs.ForwardRuns`
        cannot take; a correlated prior; a prior of ``names`` that is not the same in all. ValueError: too few
        successful runs about the best fit of one.
    """
    if len(problems) < FEWEST_SETS:
        raise ConfigError(f"a population needs at least {FEWEST_SETS} data sets")
    runs = runs_of(problems, names, executor)
    terms, scales = terms_of(problems, names), hyper or HyperPrior()
    count = min(map(len, start))
    starts = np.stack([one[:count] for one in start])
    found = estimate_population(runs, starts, white_prior(problems[0].prior), names, seed, scales, effort, workers)
    stream = member_stream(seed, "hyperprior")
    shape = found.nu.shape
    nu, tau = stream.standard_normal(shape), np.abs(stream.standard_normal(shape))
    prior = _draws(terms, scales.mean_std * nu, scales.spread * tau, stream)
    posterior = _draws(terms, found.nu, found.tau, member_stream(seed, "next"))
    sets = np.stack(
        [one.prior.to_physical(one.prior.from_white(found.sets[:, s])) for s, one in enumerate(problems)], axis=1
    )
    return CampaignPopulation(tuple(problems), scales, found, posterior, prior, sets)


def white_prior(prior: Prior) -> Prior:
    """N(0, I) of parameters with the names of ``prior``."""
    return Prior(tuple(PriorTerm.normal(Parameter(name, "1"), 0.0, 1.0) for name in prior.names))


def _draws(terms: Sequence[PriorTerm], nu: Array, tau: Array, stream: np.random.Generator) -> Draws:
    """Physical draws of white ν and τ (M, p)."""
    mean, std = np.array([term.mean for term in terms]), np.array([term.std for term in terms])
    x = mean + std * (nu + tau * stream.standard_normal(nu.shape))
    following = np.stack([term.to_physical(x[:, j]) for j, term in enumerate(terms)], axis=1)
    return Draws(*moments(terms, mean + std * nu, std * tau), following, nu, tau)
