"""The noise scale over many synthetic experiments: truths from the prior, linear model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chisquare
from toys import Linear, make_problem

from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.state import NOISE_SCALE
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.schemes.settings import AssimilationSettings

RUNS, K = 300, 40


@pytest.mark.slow
@pytest.mark.long
def test_noise_scale_is_calibrated():
    """Ranks uniform (p > 0.01), 50 % and 90 % intervals within three binomial errors, mean and std of the z-scores.

    An ensemble centred at the mode fails here: that lies a third of a standard deviation below the mean of ln σ.
    """
    base = make_problem(Linear(("a", "b")), [1.0, 0.5], k=K)
    terms = (*base.prior.terms, PriorTerm.lognormal(NOISE_SCALE, 1.0, 0.4))
    prior = Prior(terms)
    rng = np.random.default_rng(5)
    ranks, z = [], []
    for run in range(RUNS):
        truth = prior.mean + prior.std * rng.standard_normal(3)
        clean = np.array([base.model.curve(truth[:2], t) for t in base.observations.times])
        values = clean + np.exp(truth[2]) * 0.1 * rng.standard_normal(K)
        problem = replace(base, prior=prior, observations=replace(base.observations, values=values))
        analysis = assimilate(problem, AssimilationSettings(members=39), run)
        assert analysis.converged
        x = prior.from_physical(analysis.posterior)
        ranks.append(np.sum(x < truth, axis=0))
        z.append((truth - x.mean(axis=0)) / x.std(axis=0, ddof=1))
    for j, name in enumerate(prior.names):
        counts = np.bincount(np.array(ranks)[:, j] // 4, minlength=10)
        assert chisquare(counts).pvalue > 0.01, (name, counts)
        scores = np.array(z)[:, j]
        assert abs(scores.mean()) < 3 / np.sqrt(RUNS), (name, scores.mean())
        assert abs(scores.std() - 1) < 3 / np.sqrt(2 * RUNS), (name, scores.std())
        for share, width in ((0.5, 0.6745), (0.9, 1.6449)):
            inside = np.mean(np.abs(scores) < width)
            assert abs(inside - share) < 3 * np.sqrt(share * (1 - share) / RUNS), (name, share, inside)
