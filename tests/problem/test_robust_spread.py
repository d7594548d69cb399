"""The spread of an ensemble with a robust cost is that of the posterior, by quadrature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import Vectorised, make_problem, with_noise

from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes.settings import AssimilationSettings

STD, THRESHOLD = 0.1, 1.345


def ratio(count: int, outliers: float, seed: int) -> float:
    """Std of the ensemble over the exact one, of readings with errors of the density, some of them far off."""
    random, model = np.random.default_rng(seed), Vectorised(("a",))
    problem = make_problem(model, (1.0,), k=count, std=STD)
    slope, rest = (np.array([model.curve(np.array([a]), t) for t in problem.observations.times]) for a in (1.0, 0.0))
    slope = slope - rest
    read = with_noise(problem.observations, huber=THRESHOLD)
    values = rest + slope + STD * read.noise._white(random, (count,))
    values = values + 20 * STD * random.choice([-1, 1], count) * (random.random(count) < outliers)
    robust = replace(problem, observations=replace(read, values=values))
    a = np.linspace(-1, 3, 4001)
    v = np.abs(values - rest - a[:, None] * slope) / STD
    inner = np.minimum(v, THRESHOLD)
    (term,) = problem.prior.terms
    costs = np.sum(inner * (v - inner / 2), axis=1) + 0.5 * ((a - term.mean) / term.std) ** 2
    weights = np.exp(-(costs - costs.min()))
    weights /= weights.sum()
    exact = np.sqrt(weights @ (a - weights @ a) ** 2)
    return float(assimilate(robust, AssimilationSettings(), 1).posterior.std(ddof=1) / exact)


@pytest.mark.parametrize(("count", "outliers"), [(12, 0.0), (60, 0.0), (60, 0.1)])
def test_the_spread_is_that_of_the_posterior(count, outliers):
    """Of single sets it may be some per cent off: which readings lie beyond the threshold is chance."""
    ratios = [ratio(count, outliers, seed) for seed in range(5200, 5216)]
    assert np.median(ratios) == pytest.approx(1.0, abs=0.04)
    assert np.all(np.abs(np.log(ratios)) < 0.15)
