"""Evidence and sweep on a campaign that is no bubble: linear, Gaussian, all is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm
from toys import Vectorised, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.estimation.population.own import own_draws
from en4dvar.executor import ProcessesExecutor
from en4dvar.model.forward import Batch
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.sampling.sweep import SweepSettings, run_sweep

STD, SETS = 0.3, 6


@pytest.fixture(scope="module")
def campaign() -> list[InverseProblem]:
    """y = a + b cos(t + 1/3) + noise of std 0.3; a varies from set to set, every other set has a second model."""
    rng, models = np.random.default_rng(4), (Vectorised(), Vectorised())
    truths = [(1.0 + 0.5 * rng.standard_normal(), 0.4) for _ in range(SETS)]
    problems = [make_problem(models[s % 2], truth, std=STD, seed=s, k=4 + s % 3) for s, truth in enumerate(truths)]
    a, b = models[0].parameters
    prior = Prior((PriorTerm.normal(a, 0.6, 0.9), PriorTerm.normal(b, 0.2, 0.5)))
    return [replace(p, prior=prior) for p in problems]


def matrix(problem: InverseProblem) -> np.ndarray:
    """H (K, 2) of y = H (a, b)."""
    t = problem.observations.times
    return np.stack([np.ones_like(t), np.cos(t + 1 / 3)], axis=1)


def log_marginal(problem: InverseProblem, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """ln ∫ L(x) N(x; mean, variance) dx (B,) for means (B, 2), without Σ ln(std √2π)."""
    H, k = matrix(problem), len(problem.observations)
    density = multivariate_normal(np.zeros(k), H @ np.diag(variance) @ H.T + STD**2 * np.eye(k))
    return density.logpdf(problem.observations.values - mean @ H.T) + k * np.log(STD * np.sqrt(2 * np.pi))


def test_evidence_of_each_set(campaign):
    start = 0.3 * np.random.default_rng(0).standard_normal((20, 2))
    for problem in campaign[:2]:
        exact = float(log_marginal(problem, problem.prior.mean, problem.prior.std**2))
        assert own_draws(problem, start, 1).log_evidence == pytest.approx(exact, abs=0.15)


class Spiked(Vectorised):
    """L = exp(−½|x − 1|²/0.01²) + 0.6 exp(−½|x + 1|²/0.4²): J is lowest in the first, the probability in the second."""

    parts = ((1.0, 1.0, 0.01), (0.6, -1.0, 0.4))

    def trajectories(self, x, times):
        theta = x[:, 2:]
        logs = [np.log(a) - 0.5 * np.sum((theta - c) ** 2, axis=1) / w**2 for a, c, w in self.parts]
        y = np.sqrt(np.maximum(-2 * np.logaddexp(*logs), 0.0))
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        states = np.stack([np.stack([y, 0 * y, *theta.T], axis=1)] * own.shape[1], axis=1)
        return Batch(own, states, self.layout)

    def exact(self):
        return sum(a * (np.sqrt(2 * np.pi) * w * norm(c, np.hypot(1, w)).pdf(0.0)) ** 2 for a, c, w in self.parts)


@pytest.mark.slow
def test_the_wide_mode_counts_not_the_lowest_spike():
    model = Spiked()
    ones = np.ones(1)
    observed = Observations(ones, 0 * ones, noise_of(ones, 0 * ones), ones)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problem = replace(make_problem(Vectorised(), [0.0, 0.0]), model=model, observations=observed, prior=prior)
    about_the_spike = 1.0 + 0.01 * np.random.default_rng(0).standard_normal((20, 2))
    told = [own_draws(problem, about_the_spike, seed).log_evidence for seed in range(5)]
    assert told == pytest.approx([np.log(model.exact())] * 5, abs=0.2)
    laplace = np.log(2 * np.pi * 0.01**2) + norm.logpdf(1.0) * 2  # at the lowest J
    assert laplace < min(told) - 5


def test_a_sweep_finds_the_time_shift():
    """A path with a minimum in time: what was observed 0.3 later than it happened."""
    problem = make_problem(Vectorised(), [0.5, 1.0], std=1e-6, k=10)
    o = problem.observations
    values = 0.5 + np.cos(o.times + 0.3 + 1 / 3)
    shifted = replace(problem, observations=replace(o, values=values))
    found = run_sweep([shifted], SweepSettings(1024, 0.4, 0.05, rounds=16), seed=1, earliest=-np.inf)
    assert found.shift[0] == pytest.approx(0.3)
    assert found.nrmse[0] > 0.999
    assert [p.name for p in found.parameters] == ["a", "b"]


@pytest.mark.slow
def test_a_sweep_has_the_same_bits_in_processes(campaign):
    sets = [replace(p, model=campaign[0].model) for p in campaign[:2]]
    settings = SweepSettings(64, 0.1, 0.05, chunk=32, rounds=1, local=8)
    alone = run_sweep(sets, settings, seed=1)
    with ProcessesExecutor(2) as executor:
        found = run_sweep(sets, settings, 1, executor)
    np.testing.assert_array_equal(found.theta, alone.theta)
    np.testing.assert_array_equal(found.nrmse, alone.nrmse)
