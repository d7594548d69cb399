"""Populations of data sets that tell upper limits alone, held against quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import norm

from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.hierarchy import Hierarchy
from en4dvar.estimation.population.own import OwnDraws, own_likelihoods

HYPER, CAMPAIGNS, DRAWS = HyperPrior(1.0, 0.25, odd=0.0), 5, 500
X, NU, TAU = np.linspace(-6, 6, 601), np.linspace(-4, 3, 141), np.geomspace(0.03, 0.9, 24)
BELOW = (0.05, 0.5, 0.95)


def quantiles(likely):
    """Of ν, 5, 50 and 95 %, for likelihoods (S, x)."""
    within = norm(NU[:, None, None], TAU[:, None]).pdf(X)
    within /= within.sum(axis=2, keepdims=True)
    log = -0.5 * (NU[:, None] / HYPER.mean_std) ** 2 - 0.5 * (TAU / HYPER.spread) ** 2
    log = log + sum(np.log(within @ like + 1e-300) for like in likely)
    shares = np.exp(log - log.max()) @ np.gradient(TAU)
    return np.interp(BELOW, np.cumsum(shares) / shares.sum(), NU)


@pytest.mark.parametrize("count", [5, 10])
@pytest.mark.parametrize("least", [0.0, 0.3])
def test_upper_limits_add_up_to_what_they_say(count, least):
    """Above a limit the likelihood falls to ``least`` of what it is below."""
    apart, width = [], []
    for seed in range(CAMPAIGNS):
        rng = np.random.default_rng([seed, count])
        edges, slopes = rng.uniform(0.3, 1.5, (count, 1)), rng.uniform(0.1, 0.4, (count, 1))
        likely = least + (1 - least) * expit((edges - X) / slopes)
        shares = likely * norm.pdf(X) / (likely @ norm.pdf(X))[:, None]
        drawn = [rng.choice(X, DRAWS, p=p) + (X[1] - X[0]) * rng.uniform(-0.5, 0.5, DRAWS) for p in shares]
        sets = [OwnDraws(z[:, None], 0.0, DRAWS / 2, 0) for z in drawn]
        likelihoods = own_likelihoods(sets, [0], [], seed, [f"set{s}" for s in range(count)], np.zeros(1))
        exact, estimated = quantiles(likely), Hierarchy(likelihoods, HYPER).sampled(seed, Effort()).nu
        told = np.quantile(estimated, BELOW)
        std = (exact[2] - exact[0]) / (2 * norm.ppf(0.95))
        apart.append((told - exact) / std)
        width.append((told[2] - told[0]) / (exact[2] - exact[0]))
    assert np.abs(np.mean(apart, axis=0)).max() < 0.25
    assert np.mean(width) == pytest.approx(1.0, abs=0.1)
