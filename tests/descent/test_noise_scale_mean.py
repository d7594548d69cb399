"""Where the noise scale is estimated: the ensemble's mean against the posterior summed over a grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from toys import Vectorised, make_problem, with_noise

from en4dvar.data.noise import noise_of
from en4dvar.estimation.assimilate import assimilate, log_posterior
from en4dvar.model.state import NOISE_SCALE
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.schemes.settings import AssimilationSettings

TERMS = {
    "lognormal": PriorTerm.lognormal(NOISE_SCALE, 1.0, 0.4),
    "normal": PriorTerm.normal(NOISE_SCALE, 1.0, 0.4),
    "logit": PriorTerm.logit(NOISE_SCALE, (0.2, 4.0), 1.0, 1.0),
    "beta": PriorTerm.beta(NOISE_SCALE, (0.2, 4.0), 2.0, 5.0),
}


def summed(problem, mode, std):
    """Mean and std (n,) of the posterior by the sum over a grid of 2 parameters."""
    axes = [m + s * np.linspace(-6, 10, 61) for m, s in zip(mode, std, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[problem.prior.to_physical(grid)[:, 1] > 0.05]
    log = log_posterior(problem, grid)
    p = np.exp(log - log.max())
    p /= p.sum()
    mean = p @ grid
    return mean, np.sqrt(p @ (grid - mean) ** 2)


@pytest.mark.parametrize("transform", TERMS)
@pytest.mark.parametrize("huber", [None, 1.345])
def test_mean_of_the_noise_scale(huber, transform):
    """The mode lies a good part of a standard deviation off, which is the leading order in 1/√K; the next is left."""
    offsets = []
    for seed in range(3):
        base = make_problem(Vectorised(("a",)), [1.0], k=30, seed=seed)
        prior = Prior((*base.prior.terms, TERMS[transform]))
        problem = replace(base, prior=prior, observations=with_noise(base.observations, huber=huber))
        analysis = assimilate(problem, AssimilationSettings(members=39), seed)
        x, mode = (prior.from_physical(values) for values in (analysis.posterior, analysis.centre))
        mean, std = summed(problem, mode, x.std(axis=0, ddof=1))
        offsets.append([(mode[1] - mean[1]) / std[1], (x[:, 1].mean() - mean[1]) / std[1]])
        assert abs(x[:, 0].mean() - mean[0]) < 0.1 * std[0]
    of_mode, of_mean = np.mean(offsets, axis=0)
    assert of_mode < -0.15
    assert abs(of_mean) < 2 * of_mode**2


@pytest.mark.parametrize("c", [0.7, 1.345, 3.0])
def test_expectations_under_hubers_density(c):
    def density(v):
        return np.exp(-0.5 * v * v if abs(v) < c else 0.5 * c * c - c * abs(v))

    def mean(of):
        parts = [quad(lambda v: of(v) * density(v), a, b)[0] for a, b in ((0, c), (c, 60))]
        return sum(parts) / sum(quad(density, a, b)[0] for a, b in ((0, c), (c, 60)))

    score = mean(lambda v: (v * min(v, c) - 1) ** 2)
    assert noise_of(np.ones(1), huber=c).scale_information == pytest.approx(score, rel=1e-8)
