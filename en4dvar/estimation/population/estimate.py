r"""The population behind the data sets: mean and spread between them of each parameter.

    x_i ~ N(ν, diag τ²)   (transformed coordinates, e.g. ln θ),     data_i ~ L_i(x_i)

Stacking the per-set posteriors instead counts the prior once a set and so returns it where single sets are hardly
informative. Here the prior enters once, as a hyperprior: ν ~ N(prior mean, ``mean_std``²), τ ~ half-normal(``spread``).
Coordinates that are no property of the population (a time shift) keep their prior.

Where the data determine combinations of parameters only, the per-set likelihoods are curved sheets, which no Gaussian
describes, so that a Gaussian two-stage step goes astray. In stages, each corrected by the next:

1. forward runs of every set around its posterior under a wide interim prior; polynomial emulators on them;
2. interim posteriors on the emulators, as Gaussian mixtures with the interim prior divided out (Lunn et al. 2013, Stat.
   Med. 32, 4139, reweight the draws themselves, which fails where τ is small); they tell where (ν, τ) are likely, and 1
   and 2 are repeated with the interim prior that this gives: in the tail of a wide one a mixture is poor;
3. a proposal for (ν, τ) with every x_i integrated out analytically (:mod:`~en4dvar.estimation.population.hyper`);
4. importance weights of its draws: the marginal likelihood of every set from draws of x_i, with the emulators, then
   with forward runs (:mod:`~en4dvar.estimation.population.weights`). What is returned is resampled by them. Where
   they leave few draws, the proposal is fitted to what they say, or the interim prior once more, and all after
   it is done again; the best is kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.estimation.population.effort import Effort
from en4dvar.estimation.population.hyper import Hyper, HyperPrior, walk
from en4dvar.estimation.population.likelihoods import draw_interim
from en4dvar.estimation.population.marginals import TEMPERATURE, SetPosterior
from en4dvar.estimation.population.mixtures import Mixture, fit_mixtures
from en4dvar.estimation.population.training import Training
from en4dvar.estimation.population.weights import Weighed, normalised, with_emulators, with_runs
from en4dvar.executor import one_blas_thread
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior, PriorTerm, member_stream
from en4dvar.sampling.forward_runs import CampaignRuns
from en4dvar.sampling.mixture import StudentMixture

FEWEST_SETS = 3  # with fewer nothing is known of a spread
FEWEST = 100.0  # effective draws of a result that can be trusted
WIDER = 1.3  # the interim prior than the population found
NODES = 24  # of the quadrature


@dataclass(frozen=True)
class Population:
    """Draws of ν and τ (M, p) in transformed coordinates, of the parameters ``names``, and with each of them of the
    control vectors ``sets`` (M, S, n) of the data sets, given all data.

    ``weighed`` are the effective sample sizes of the weights of stage 4, with emulators and with forward runs;
    ``log_evidence``: of all data, hyperpriors included, without Σ ln(std √2π).
    """

    names: tuple[str, ...]
    prior: Prior
    nu: Array
    tau: Array
    sets: Array
    weighed: tuple[float, float]
    log_evidence: float
    forward_runs: int

    @property
    def converged(self) -> bool:
        """True if the result can be trusted: at least 100 effective draws."""
        return self.size >= FEWEST

    @property
    def size(self) -> float:
        """Effective number of independent draws behind the result: the variances that both weights leave add up."""
        return 1 / (1 / self.weighed[0] + 1 / self.weighed[1])

    @property
    def mean(self) -> Array:
        """(M, p) draws of the population mean, physical: exp(ν + τ²/2) of a lognormal, ν of a normal."""
        return self._moments()[0]

    @property
    def std(self) -> Array:
        """(M, p) draws of the standard deviation between the data sets, physical."""
        return self._moments()[1]

    def interval(self, level: float = 0.95) -> Array:
        """(2, p) central interval of the population mean."""
        tail = (1 - level) / 2
        return np.asarray(np.quantile(self.mean, (tail, 1 - tail), axis=0))

    def _moments(self) -> tuple[Array, Array]:
        terms = [self.prior.terms[self.prior.names.index(name)] for name in self.names]
        return moments(terms, self.nu, self.tau)


def moments(terms: Sequence[PriorTerm], nu: Array, tau: Array) -> tuple[Array, Array]:
    """Physical mean and standard deviation (M, p) of parameters whose coordinates are N(ν, τ²), (M, p) each.

    In closed form for normal and lognormal ones, else by Gauss–Hermite quadrature.
    """
    mean, std = nu.copy(), tau.copy()
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    for j, term in enumerate(terms):
        if term.transform == "lognormal":
            mean[:, j] = np.exp(nu[:, j] + tau[:, j] ** 2 / 2)
            std[:, j] = mean[:, j] * np.sqrt(np.expm1(tau[:, j] ** 2))
        elif term.transform != "normal":
            values = term.to_physical(nu[:, j, None] + tau[:, j, None] * nodes)
            mean[:, j] = values @ weights
            std[:, j] = np.sqrt((values - mean[:, j, None]) ** 2 @ weights)
    return mean, std


def estimate_population(
    runs: CampaignRuns,
    start: Array,
    prior: Prior,
    names: Sequence[str],
    seed: int,
    hyper: HyperPrior | None = None,
    effort: Effort | None = None,
    workers: int = 1,
) -> Population:
    """Sample the population of ``names`` given all data sets.

    Parameters
    ----------
    start: (S, N, n) control vectors near the posterior of each set (its ensemble); any rough ones will do.
    workers: threads besides those of ``runs``; the numbers do not depend on it.

    Raises
    ------
    ValueError: fewer than 3 sets, a correlated prior, or too few successful runs about the best fit of one.
    """
    scales, effort = hyper or HyperPrior(), effort or Effort()
    if len(start) < FEWEST_SETS:
        raise ValueError(f"a population needs at least {FEWEST_SETS} data sets")
    if prior.blocks:
        raise ValueError("a population needs a prior of independent parameters")
    with one_blas_thread():
        return _Estimate(runs, start, prior, names, seed, scales, effort, workers).result()


class _Estimate:
    """One estimate; see :func:`estimate_population`."""

    def __init__(
        self, runs: CampaignRuns, start: Array, prior: Prior, names: Sequence[str], seed: int, scales: HyperPrior,
        effort: Effort, workers: int,
    ):  # fmt: skip
        self.runs, self.prior, self.names, self.seed = runs, prior, tuple(names), seed
        self.effort, self.workers = effort, workers
        self.where = [prior.names.index(name) for name in names]
        self.hyper = Hyper(prior, self.where, scales)
        self.mean, self.std = prior.mean.copy(), prior.std.copy()  # of the interim prior
        self.std[self.where] = math.hypot(scales.mean_std, scales.spread)  # what ν and τ allow
        self.training = Training(runs, start, self.mean, self.std, seed, effort, workers)
        self.tries = 0

    def result(self) -> Population:
        """The best of the passes: with more of them the interim prior comes closer to the population."""
        self._narrow(self._walked(self._mixtures(draws=30, components=8))[-2000:])
        populations: list[Population] = []
        forward_runs = 0
        for turn in range(self.effort.passes):
            population, h, count = self._pass(turn)
            populations.append(population)
            forward_runs += count
            if min(population.weighed) >= self.effort.effective:
                break
            if population.size >= FEWEST:  # a few draws would make it too narrow
                self._narrow(h)
        best = max(populations, key=lambda population: population.size)
        return replace(best, forward_runs=self.training.count + forward_runs)

    def _pass(self, turn: int) -> tuple[Population, Array, int]:
        """The population with the interim prior as it is, its draws h (M, 2p), and forward runs made for weights."""
        self.training.refit(self.mean, self.std, self.effort.refits)
        likelihoods = self.training.likelihoods
        mixtures = self._mixtures(draws=60, components=self.effort.components)
        tempered = self._mixtures(draws=30, components=8, temperature=TEMPERATURE)
        sets = [SetPosterior(*parts) for parts in zip(likelihoods, mixtures, tempered, strict=True)]
        emulated = self._weighed(sets, self._walked(mixtures))
        stream = member_stream(self.seed, "forward runs", turn)
        exact, count = with_runs(emulated, likelihoods, self.runs, self.effort.exact, stream)
        taken, p = exact.resampled(self.effort.draws, stream), len(self.where)
        h, x = exact.h[taken], exact.x[taken, :, 0]
        evidence = normalised(emulated.logs)[1] + normalised(exact.logs)[1]
        sizes = emulated.effective, exact.effective
        return Population(self.names, self.prior, h[:, :p], np.exp(h[:, p:]), x, sizes, evidence, 0), h, count

    def _narrow(self, h: Array) -> None:
        """Make the interim prior a little wider than populations (B, 2p)."""
        p = len(self.where)
        self.mean[self.where] = h[:, :p].mean(axis=0)
        self.std[self.where] = WIDER * np.sqrt(h[:, :p].var(axis=0) + np.exp(2 * h[:, p:]).mean(axis=0))

    def _mixtures(self, draws: int, components: int, temperature: float = 1.0) -> list[Mixture]:
        """Mixtures of the interim posteriors under the interim prior as it is, to the power 1/temperature."""
        self.tries += 1
        interim = draw_interim(
            self.training.likelihoods, self.mean, self.std, self.seed, f"interim draws {self.tries}", draws,
            temperature=temperature, workers=self.workers,
        )  # fmt: skip
        wide = math.sqrt(temperature) * self.std
        return fit_mixtures(
            interim, self.mean, wide, self.seed, f"mixtures {self.tries}", components, workers=self.workers
        )

    def _walked(self, mixtures: Sequence[Mixture]) -> Array:
        """Populations (D, 2p) that the mixtures find likely."""
        stream = member_stream(self.seed, "population", self.tries)
        return walk(self.hyper, mixtures, stream, self.effort.hyper_walkers, self.effort.hyper_rounds)

    def _weighed(self, sets: Sequence[SetPosterior], h: Array) -> Weighed:
        """Draws of a proposal fitted to ``h``, with emulators; where few are left, of one fitted to those.

        Where they are fewer than a covariance needs, nothing can be fitted; that few are left is then told.
        """
        weighed = self._proposed(sets, h, 2 * self.tries)
        if 2 * (h.shape[1] + 1) <= weighed.effective < self.effort.effective:
            stream = member_stream(self.seed, "second fit", self.tries)
            weighed = self._proposed(sets, weighed.h[weighed.resampled(len(h), stream)], 2 * self.tries + 1)
        return weighed

    def _proposed(self, sets: Sequence[SetPosterior], h: Array, turn: int) -> Weighed:
        at = h[np.linspace(0, len(h) - 1, 3000).astype(int)]
        stream = member_stream(self.seed, "fit of the proposal", turn)
        proposal = StudentMixture.fitted(at, stream, self.effort.hyper_components)
        return with_emulators(self.hyper, proposal, sets, self.effort.draws, self.seed, turn, self.workers)
