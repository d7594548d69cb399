r"""Mean ν and spread τ of a population: what the sets' mixtures say of them, and draws for importance sampling.

h = (ν, ln τ). Walkers on the density with all sets integrated out over their mixtures find where it is; a mixture of
Student t distributions fitted to them is the proposal q, from which draws are independent (adaptive importance
sampling: Cappé et al. 2008, Stat. Comput. 18, 447). A walker left behind in a secondary mode moves q a little; the
weights know what it is worth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Lt

from en4dvar.estimation.population.mixtures import Mixture, log_marginal
from en4dvar.model.state import Array
from en4dvar.priors.prior import Prior
from en4dvar.sampling.walkers import walked

SPREADS = (1e-3, 10.0)  # of τ; smaller ones are indistinguishable, and lost to rounding in the marginals


@dataclass(frozen=True)
class HyperPrior:
    """Standard deviation of ν about the prior mean and scale of τ, in transformed coordinates; share of odd sets."""

    mean_std: Annotated[
        float, Gt(0), "Hyperprior of the mean: normal about the prior's, with so many of its standard deviations."
    ] = 1.0
    spread: Annotated[
        float, Gt(0), "Hyperprior of the spread: half-normal, with so many of the prior's standard deviations."
    ] = 0.5
    odd: Annotated[
        float, Ge(0), Lt(1), "Probability that a data set is odd: of another population, in all parameters or in one."
    ] = 0.05


class Hyper:
    """The hyperprior over h = (ν, ln τ) of the coordinates ``where``; the others keep their prior."""

    def __init__(self, prior: Prior, where: list[int], scales: HyperPrior):
        self.prior, self.where, self.scales = prior, where, scales
        self.start, p = prior.mean[where], len(where)
        self.constant = -p * (0.5 * math.log(2 * math.pi) + math.log(scales.mean_std))
        self.constant += p * (0.5 * math.log(2 / math.pi) - math.log(scales.spread))

    def population(self, h: Array) -> tuple[Array, Array]:
        """Mean and variance (B, n) of x given h (B, 2p)."""
        p = len(self.where)
        mean = np.tile(self.prior.mean, (len(h), 1))
        variance = np.tile(self.prior.std**2, (len(h), 1))
        mean[:, self.where], variance[:, self.where] = h[:, :p], np.exp(2 * h[:, p:])
        return mean, variance

    def log_density(self, h: Array) -> Array:
        """(B,), normalised; −inf where a spread is out of bounds."""
        p = len(self.where)
        logs = -0.5 * np.sum(((h[:, :p] - self.start) / self.scales.mean_std) ** 2, axis=1)
        logs += np.sum(h[:, p:] - 0.5 * np.exp(2 * h[:, p:]) / self.scales.spread**2, axis=1)
        inside = np.all((h[:, p:] > math.log(SPREADS[0])) & (h[:, p:] < math.log(SPREADS[1])), axis=1)
        return np.where(inside, logs + self.constant, -np.inf)

    def scattered(self, count: int, stream: np.random.Generator) -> Array:
        """(count, 2p) somewhere in the bulk of the hyperprior."""
        p = len(self.where)
        nu = self.start + 0.5 * self.scales.mean_std * stream.standard_normal((count, p))
        return np.hstack([nu, math.log(0.6 * self.scales.spread) + 0.5 * stream.standard_normal((count, p))])


def walk(hyper: Hyper, mixtures: Sequence[Mixture], stream: np.random.Generator, walkers: int, rounds: int) -> Array:
    """(D, 2p) positions of walkers on p(h | mixtures), the first third left out."""

    def cost(h: Array) -> Array:
        logs = hyper.log_density(h)
        inside = np.isfinite(logs)
        logs[inside] += log_marginal(mixtures, *hyper.population(h[inside]))
        return np.where(np.isnan(logs), np.inf, -logs)

    return walked(cost, hyper.scattered(walkers, stream), stream, rounds, rounds // 3)
