"""Two wells, sampled, against a tempered population of its own (benchmarks/tempered.py)."""

import numpy as np
import pytest
from tempered import tempered
from wells import UnlikeWells, Wells, two_wells

from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes.settings import AssimilationSettings


def population(problem, seed=3):
    prior, y = problem.prior, problem.observations

    def log_likelihood(x):
        residuals = y.values - problem.model.curve(x.T[..., None], y.times)
        return -0.5 * np.sum((residuals / y.std) ** 2, axis=1)

    return tempered(log_likelihood, prior.mean, prior.std, seed, count=4000, walk=40)


@pytest.mark.parametrize("kind", [Wells, UnlikeWells])
def test_a_sampled_posterior_is_that_of_the_population(kind):
    """Moments of all modes together, within three standard errors of 1500 effective draws."""
    problem = two_wells(kind, mean=0.3)
    found, other = assimilate(problem, AssimilationSettings(), 1), population(problem)
    assert np.abs((found.posterior.mean(axis=0) - other.mean) / other.std).max() < 3 / np.sqrt(1500)
    assert found.posterior.std(axis=0, ddof=1) / other.std == pytest.approx([1, 1], abs=0.05)


def test_the_population_knows_the_masses_of_two_peaks():
    def log_likelihood(x):
        low = np.log(0.3 / 0.2) - 0.5 * ((x[:, 0] + 2) / 0.2) ** 2
        high = np.log(0.7 / 0.4) - 0.5 * ((x[:, 0] - 2) / 0.4) ** 2
        return np.logaddexp(low, high) + 0.5 * x[:, 0] ** 2

    found = tempered(log_likelihood, np.zeros(2), np.ones(2), seed=1, count=2000, walk=20)
    assert np.mean(found.draws[:, 0] < 0) == pytest.approx(0.3, abs=0.03)
    assert found.std[1] == pytest.approx(1.0, abs=0.03)
