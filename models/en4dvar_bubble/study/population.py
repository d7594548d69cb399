r"""The population behind the data sets: mean and between-bubble spread of each parameter.

    x_i ~ N(ν, diag τ²)   (transformed coordinates: ln G, ln α, ln μ, ln R0),     data_i ~ L_i(x_i)

Stacking the per-set posteriors instead counts the prior once a set and so returns it where single sets are hardly
informative. Here the prior enters once, as a hyperprior: ν ~ N(prior mean, ``mean_std``²), τ ~ half-normal(``spread``).
Coordinates that are no property of the population (the time shift) keep their prior.

The per-set likelihoods are curved sheets (the elastic stress determines one combination of G, α and R0), which no
Gaussian describes, so a Gaussian two-stage step goes astray. In stages, each corrected by the next:

1. forward runs of every set around its posterior under a wide interim prior; polynomial emulators on them;
2. interim posteriors on the emulators, as Gaussian mixtures with the interim prior divided out (Lunn et al. 2013, Stat.
   Med. 32, 4139, reweight the draws themselves, which fails where τ is small); they tell where (ν, τ) are likely, and 1
   and 2 are repeated with the interim prior that this gives: in the tail of a wide one a mixture is poor;
3. a proposal for (ν, τ) with every x_i integrated out analytically (``study.hyper``);
4. importance weights of its draws: the marginal likelihood of every set from draws of x_i, with the emulators, then
   with forward runs (``study.weights``). What is returned is resampled by them. Where they leave few draws, the
   proposal is fitted to what they say, or the interim prior once more, and all after it is done again; the best is
   kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.executor import one_blas_thread
from en4dvar.prior import Prior, member_stream
from en4dvar.state import Array
from en4dvar_bubble.study.effort import Effort
from en4dvar_bubble.study.emulator import draw_interim
from en4dvar_bubble.study.hyper import Hyper, HyperPrior, Proposal, walk
from en4dvar_bubble.study.marginals import TEMPERATURE
from en4dvar_bubble.study.mixture import Mixtures, fit_mixtures
from en4dvar_bubble.study.set_runs import Runs
from en4dvar_bubble.study.training import Training
from en4dvar_bubble.study.weights import Weighed, normalised, with_emulators, with_runs

FEWEST = 100.0  # effective draws of a result that can be trusted
WIDER = 1.3  # the interim prior than the population found


@dataclass(frozen=True)
class Population:
    """Draws of ν and τ (M, p) in transformed coordinates, of the parameters ``names``.

    ``weighed`` are the effective sample sizes of the weights of stage 4, with emulators and with forward runs;
    ``log_evidence``: of all data, hyperpriors included, without Σ ln(std √2π).
    """

    names: tuple[str, ...]
    prior: Prior
    nu: Array
    tau: Array
    weighed: tuple[float, float]
    log_evidence: float
    forward_runs: int

    @property
    def converged(self) -> bool:
        """Whether the result can be trusted: at least 100 effective draws."""
        return self.size >= FEWEST

    @property
    def size(self) -> float:
        """Effective number of independent draws behind the result: the variances that both weights leave add up."""
        return 1 / (1 / self.weighed[0] + 1 / self.weighed[1])

    @property
    def mean(self) -> Array:
        """(M, p) draws of the population mean, physical: exp(ν + τ²/2) of a lognormal, ν of a normal.

        Raises
        ------
        ValueError: a logit prior, which has no closed mean.
        """
        return self._moments()[0]

    @property
    def std(self) -> Array:
        """(M, p) draws of the between-bubble standard deviation, physical."""
        return self._moments()[1]

    def interval(self, level: float = 0.95) -> Array:
        """(2, p) central interval of the population mean."""
        tail = (1 - level) / 2
        return np.asarray(np.quantile(self.mean, (tail, 1 - tail), axis=0))

    def _moments(self) -> tuple[Array, Array]:
        mean, std = self.nu.copy(), self.tau.copy()
        for j, name in enumerate(self.names):
            transform = self.prior.terms[self.prior.names.index(name)].transform
            if transform == "logit":
                raise ValueError(f"{name}: the population mean of a logit prior has no closed form")
            if transform == "lognormal":
                mean[:, j] = np.exp(self.nu[:, j] + self.tau[:, j] ** 2 / 2)
                std[:, j] = mean[:, j] * np.sqrt(np.expm1(self.tau[:, j] ** 2))
        return mean, std


def estimate_population(
    runs: Runs,
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
    ValueError: fewer than 3 sets, or too few successful runs about the best fit of one.
    """
    scales, effort = hyper or HyperPrior(), effort or Effort()
    if len(start) < 3:
        raise ValueError("a population needs at least 3 data sets")
    with one_blas_thread():
        return _Search(runs, start, prior, names, seed, scales, effort, workers).result(names)


class _Search:
    """One estimate; see :func:`estimate_population`."""

    def __init__(
        self, runs: Runs, start: Array, prior: Prior, names: Sequence[str], seed: int, scales: HyperPrior,
        effort: Effort, workers: int,
    ):  # fmt: skip
        self.runs, self.prior, self.seed, self.effort, self.workers = runs, prior, seed, effort, workers
        self.where = [prior.names.index(name) for name in names]
        self.hyper = Hyper(prior, self.where, scales)
        self.mean, self.std = prior.mean.copy(), prior.std.copy()
        self.std[self.where] = math.hypot(scales.mean_std, scales.spread)  # what ν and τ allow
        self.training = Training(runs, start, self.mean, self.std, seed, effort, workers)
        self.tries = 0

    def result(self, names: Sequence[str]) -> Population:
        self.narrow(self.walked(self.mixtures(draws=30, components=8))[-2000:])
        forward_runs, passes = 0, list[Population]()
        for turn in range(self.effort.passes):
            self.training.refit(self.mean, self.std, self.effort.refits)
            mixtures = self.mixtures(draws=60, components=self.effort.components)
            tempered = self.mixtures(draws=30, components=8, temperature=TEMPERATURE)
            weighed = self.weighed(mixtures, tempered, self.walked(mixtures))
            stream = member_stream(self.seed, "forward runs", turn)
            found, count = with_runs(weighed, self.training.emulators, self.runs, self.effort.exact, stream)
            forward_runs += count
            h, p = found.h[found.resampled(self.effort.draws, stream)], len(self.where)
            evidence = normalised(weighed.logs)[1] + normalised(found.logs)[1]
            sizes = weighed.effective, found.effective
            passes.append(Population(tuple(names), self.prior, h[:, :p], np.exp(h[:, p:]), sizes, evidence, 0))
            if min(sizes) >= self.effort.effective:
                break
            if passes[-1].size >= FEWEST:  # a few draws would make it too narrow
                self.narrow(h)
        best = max(passes, key=lambda found: found.size)
        return replace(best, forward_runs=self.training.count + forward_runs)

    def narrow(self, h: Array) -> None:
        """Make the interim prior a little wider than populations (B, 2p)."""
        p = len(self.where)
        self.mean[self.where] = h[:, :p].mean(axis=0)
        self.std[self.where] = WIDER * np.sqrt(h[:, :p].var(axis=0) + np.exp(2 * h[:, p:]).mean(axis=0))

    def mixtures(self, draws: int, components: int, temperature: float = 1.0) -> Mixtures:
        """Of the interim posteriors under the interim prior as it is, to the power 1/temperature."""
        self.tries += 1
        words, root = f"interim draws {self.tries}", math.sqrt(temperature)
        interim = draw_interim(
            self.training.emulators, self.mean, self.std, self.seed, words, draws, temperature=temperature,
            workers=self.workers,
        )  # fmt: skip
        words = f"mixtures {self.tries}"
        return fit_mixtures(interim, self.mean, root * self.std, self.seed, words, components, workers=self.workers)

    def walked(self, mixtures: Mixtures) -> Array:
        """Populations (D, 2p) that the mixtures find likely."""
        stream = member_stream(self.seed, "population", self.tries)
        return walk(self.hyper, mixtures, stream, self.effort.hyper_walkers, self.effort.hyper_rounds)

    def weighed(self, mixtures: Mixtures, tempered: Mixtures, h: Array) -> Weighed:
        """Draws of a proposal fitted to ``h``, with emulators; where few are left, of one fitted to those."""
        found = self.proposed(mixtures, tempered, h, 0)
        if found.effective < self.effort.effective:
            stream = member_stream(self.seed, "second fit", self.tries)
            found = self.proposed(mixtures, tempered, found.h[found.resampled(len(h), stream)], 1)
        return found

    def proposed(self, mixtures: Mixtures, tempered: Mixtures, h: Array, turn: int) -> Weighed:
        number = 2 * self.tries + turn
        at = h[np.linspace(0, len(h) - 1, 3000).astype(int)]
        stream = member_stream(self.seed, "fit of the proposal", number)
        proposal = Proposal.fitted(at, stream, self.effort.hyper_components)
        return with_emulators(
            self.hyper, proposal, self.training.emulators, mixtures, tempered, self.effort.draws, self.seed, number,
            self.workers,
        )  # fmt: skip
