"""Population, evidence and sweep on a campaign that is no bubble: linear, Gaussian, all is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import halfnorm, multivariate_normal, norm
from toys import Fragile, Vectorised, make_problem, with_noise

from en4dvar.estimation.population import Effort, HyperPrior, estimate_population
from en4dvar.executor import ProcessesExecutor
from en4dvar.model.state import NOISE_SCALE, TIME_SHIFT
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.sampling.evidence import sampled_evidence
from en4dvar.sampling.forward_runs import ForwardRuns
from en4dvar.sampling.sweep import SweepSettings, run_sweep

STD, SETS = 0.3, 6
SMALL = Effort(rounds=36, refits=1, degree=1, components=2, hyper_walkers=32, draws=1500, exact=200)
HYPER = HyperPrior(mean_std=0.8, spread=0.5)


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


@pytest.mark.slow
def test_population_of_a_linear_hierarchy(campaign):
    prior, runs = campaign[0].prior, ForwardRuns(campaign)
    start = prior.mean + 0.3 * np.random.default_rng(0).standard_normal((SETS, 20, 2))
    found = estimate_population(runs, start, prior, ["a"], 2, HYPER, SMALL)
    nu, tau = np.linspace(-2, 3, 81), np.geomspace(5e-3, 3, 41)
    means = np.stack([nu, np.full(81, 0.2)], axis=1)
    log = np.stack([sum(log_marginal(p, means, np.array([t**2, 0.25])) for p in campaign) for t in tau], axis=1)
    log += norm(0.6, HYPER.mean_std).logpdf(nu)[:, None] + halfnorm(scale=HYPER.spread).logpdf(tau)
    weights = np.exp(log - log.max()) * (nu[1] - nu[0]) * np.gradient(tau)
    assert found.converged
    assert found.log_evidence == pytest.approx(log.max() + np.log(weights.sum()), abs=0.1)
    weights /= weights.sum()
    mean, spread = weights.sum(axis=1) @ nu, weights.sum(axis=0) @ tau
    error = np.sqrt(weights.sum(axis=1) @ (nu - mean) ** 2 / found.size)
    assert found.mean.mean() == pytest.approx(mean, abs=4 * error)
    assert found.std.mean() == pytest.approx(spread, rel=0.15)


def test_evidence_of_each_set(campaign):
    prior = campaign[0].prior
    found = sampled_evidence(ForwardRuns(campaign[:2]), prior, seed=1)
    exact = [float(log_marginal(p, prior.mean[None], prior.std**2)) for p in campaign[:2]]
    assert found.log == pytest.approx(exact, abs=0.25)


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


def test_members_that_cannot_be_run_and_time_shifts():
    problem = make_problem(Fragile(limit=2.0), [1.0, 0.5])
    term = PriorTerm.normal(TIME_SHIFT, 0.0, 0.1)
    problem = replace(problem, prior=replace(problem.prior, terms=(*problem.prior.terms, term)))
    runs = ForwardRuns([problem])
    x = np.array([[[1.0, 0.5, 0.05]], [[3.0, 0.5, 0.05]]])
    predictions = runs.predictions(x)
    t = problem.observations.times + 0.05
    assert predictions[0, 0] == pytest.approx(1.0 + 0.5 * np.cos(t + 1 / 3))
    assert np.isnan(predictions[1]).all()


def test_errors_that_it_cannot_take(campaign):
    prior = campaign[0].prior
    other = replace(campaign[1], prior=replace(prior, terms=prior.terms[::-1]))
    with pytest.raises(ConfigError, match="one prior"):
        ForwardRuns([campaign[0], other])
    scaled = replace(prior, terms=(*prior.terms, PriorTerm.lognormal(NOISE_SCALE, 1.0, 0.2)))
    robust = replace(campaign[0], observations=with_noise(campaign[0].observations, huber=1.5))
    for problem in (replace(campaign[0], prior=scaled), robust):
        with pytest.raises(ConfigError, match="independent Gaussian errors"):
            ForwardRuns([problem])
