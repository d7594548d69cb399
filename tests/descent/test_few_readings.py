"""Few readings with errors of unknown size: the default estimate against quadrature over the noise scale."""

import math
from dataclasses import replace

import numpy as np
import pytest
from toys import Vectorised, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.state import NOISE_SCALE
from en4dvar.priors.prior import PriorTerm
from en4dvar.schemes.settings import AssimilationSettings

SETS, STD = 40, 0.1


def _exact(problem, log_std):
    """Means and standard deviations (p + 1,), the last of ln σ, and ln p(y); the Gaussian given σ in closed form."""
    y, times, prior = problem.observations.values, problem.observations.times, problem.prior
    p = len(prior.names) - 1
    j = np.arange(p)
    H, centre = np.cos(times[:, None] * j + j**2 / 3), prior.mean[:p]
    logs, means, variances = [], [], []
    grid, step = np.linspace(-6, 6, 601, retstep=True)
    for z in grid:
        R = (STD * math.exp(log_std * z)) ** 2 * np.eye(len(y))
        S = R + H @ np.diag(prior.std[:p] ** 2) @ H.T
        gain = np.linalg.solve(S, H * prior.std[:p] ** 2).T
        off = y - H @ centre
        logs.append(-0.5 * (off @ np.linalg.solve(S, off) + np.linalg.slogdet(2 * np.pi * S)[1] + z**2))
        means.append([*(centre + gain @ off), log_std * z])
        variances.append([*np.diag(np.diag(prior.std[:p] ** 2) - gain @ H * prior.std[:p] ** 2), 0.0])
    logs, means, variances = np.array(logs), np.array(means), np.array(variances)
    weights = np.exp(logs - logs.max())
    evidence = logs.max() + math.log(weights.sum() * step / math.sqrt(2 * math.pi))
    weights /= weights.sum()
    mean = weights @ means
    return mean, np.sqrt(weights @ (variances + (means - mean) ** 2)), evidence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "p", "log_std"),
    [(6, 2, 1.5), (6, 2, 0.7), (24, 10, 0.7)],
)
def test_few_readings_with_errors_of_unknown_size(k, p, log_std):
    """The Gaussian about the mode is 0.6 to 0.75 as wide, and its σ up to half a standard deviation too small."""
    model, ratios, shifts, evidences, within, told = Vectorised(tuple("abcdefghij"[:p])), [], [], [], [], []
    scale = PriorTerm.lognormal(NOISE_SCALE, 1.0, log_std)
    prior = (*(PriorTerm.normal(parameter, 0.0, 1.0) for parameter in model.parameters), scale)
    for seed in range(SETS):
        truth = np.random.default_rng([k, seed]).standard_normal(p + 1) * [*np.ones(p), log_std]
        problem = make_problem(model, truth[:p], std=STD * math.exp(truth[p]), seed=[seed, k], k=k, prior=prior)
        problem = replace(problem, observations=replace(problem.observations, noise=noise_of(np.full(k, STD))))
        analysis = assimilate(problem, AssimilationSettings(), seed)
        told += [caution.code for caution in analysis.cautions]
        x = problem.prior.from_physical(analysis.posterior)
        mean, std, evidence = _exact(problem, log_std)
        ratios.append(x.std(axis=0, ddof=1) / std)
        shifts.append((x.mean(axis=0) - mean) / std)
        evidences.append(analysis.log_evidence - evidence)
        low, high = member_quantiles(x, (0.05, 0.95), axis=0)
        within.append((low < truth) & (truth < high))
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.02)
    assert "non-gaussian" not in told
    assert np.sqrt(np.mean(np.square(shifts), axis=0)).max() < 0.1
    assert np.sqrt(np.mean(np.square(evidences))) < 0.1
    assert abs(np.mean(within) - 0.9) < 3 * math.sqrt(0.9 * 0.1 / SETS / 2)  # of two independent numbers in each set
