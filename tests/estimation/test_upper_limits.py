"""Populations of data sets that tell upper limits alone, or have their mean in their tails, held against quadrature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import halfnorm, norm
from toys import make_observations

from en4dvar.estimation.population import Effort, HyperPrior, population_of
from en4dvar.estimation.population.hierarchy import Hierarchy
from en4dvar.estimation.population.own import OwnDraws, own_likelihoods
from en4dvar.executor import ThreadsExecutor
from en4dvar.model.function_model import FunctionModel
from en4dvar.model.state import Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem

HYPER, CAMPAIGNS, DRAWS = HyperPrior(1.0, 0.25, odd=0.0), 5, 500
X, NU, TAU = np.linspace(-6, 6, 601), np.linspace(-4, 3, 351), np.geomspace(0.01, 0.9, 24)
BELOW = (0.05, 0.5, 0.95)
STEEP, KEPT = 1.5, 250
MODEL = FunctionModel(
    lambda p, t: np.exp(STEEP * p["a"]) + 0 * t, [Parameter("a", "1")], {"y": "1"}, members=400, cheap=True
)
PRIOR = Prior((PriorTerm.normal(MODEL.parameters[0], 0.0, 1.0),))


def quadrature(likely):
    """Of ν, 5, 50 and 95 %, for likelihoods (S, x), and ln of their evidence."""
    within = norm(NU[:, None, None], TAU[:, None]).pdf(X)
    within /= within.sum(axis=2, keepdims=True)
    log = -0.5 * (NU[:, None] / HYPER.mean_std) ** 2 - 0.5 * (TAU / HYPER.spread) ** 2
    log = log + sum(np.log(within @ like + 1e-300) for like in likely)
    shares = np.exp(log - log.max()) @ np.gradient(TAU)
    of_nu_and_tau = norm.pdf(0, scale=HYPER.mean_std) * halfnorm.pdf(0, scale=HYPER.spread)
    evidence = log.max() + np.log(shares.sum() * (NU[1] - NU[0]) * of_nu_and_tau)
    return np.interp(BELOW, (np.cumsum(shares) - shares / 2) / shares.sum(), NU), evidence


def drawn_from(likely, rng, count):
    """(count,) of the posteriors whose likelihoods on the grid are ``likely`` (S, x)."""
    shares = likely * norm.pdf(X) / (likely @ norm.pdf(X))[:, None]
    return [rng.choice(X, count, p=p) + (X[1] - X[0]) * rng.uniform(-0.5, 0.5, count) for p in shares]


def campaign(nu, noise, seed, count=20):
    """Data sets of one reading exp(1.5 x) about ``nu``, with errors of ``noise`` times as much, the likelihoods of
    each, and draws of its posterior.
    """
    rng = np.random.default_rng([seed, count])
    stds = noise * np.exp(STEEP * nu) * rng.uniform(0.7, 1.4, count)
    values = np.exp(STEEP * (nu + 0.15 * rng.standard_normal(count))) + stds * rng.standard_normal(count)
    likely = np.exp(-0.5 * ((values[:, None] - np.exp(STEEP * X)) / stds[:, None]) ** 2)
    problems = [
        InverseProblem(MODEL, MODEL.observables[0], make_observations([1.0], [y], std, name=f"set{i}"), PRIOR)
        for i, (y, std) in enumerate(zip(values, stds, strict=True))
    ]
    evidences = np.log(likely @ norm.pdf(X) * (X[1] - X[0]))
    drawn = zip(drawn_from(likely, rng, KEPT), evidences, strict=True)
    return problems, likely, [OwnDraws(z[:, None], evidence, KEPT, 0) for z, evidence in drawn]


def population(problems, kept, seed=0, **how):
    return population_of(problems, [own.z[:40] for own in kept], ["a"], seed, kept=kept, **{"hyper": HYPER, **how})


@pytest.mark.slow
def test_a_mean_in_the_tails_of_all_is_where_quadrature_has_it():
    """Each reading tells a limit, and few of its draws lie near the mean that all together tell."""
    apart, evidence = [], []
    for seed in range(3):
        problems, likely, kept = campaign(2.0, 1.4, seed)
        (exact, exact_evidence), estimated = quadrature(likely), population(problems, kept)
        std = (exact[2] - exact[0]) / (2 * norm.ppf(0.95))
        apart.append((np.quantile(estimated.posterior.nu, BELOW) - exact) / std)
        evidence.append(estimated.log_evidence - exact_evidence)
        assert estimated.forward_runs > 0
    assert np.sqrt(np.mean(np.square(apart))) < 0.4
    assert np.sqrt(np.mean(np.square(evidence))) < 0.5


@pytest.mark.slow
def test_draws_that_tell_the_mean_are_not_taken_anew():
    problems, likely, kept = campaign(1.0, 0.5, 0, 8)
    estimated = population(problems, kept)
    std = np.diff(quadrature(likely)[0][[0, 2]])[0] / (2 * norm.ppf(0.95))
    assert estimated.forward_runs == 0
    assert estimated.posterior.nu.std() == pytest.approx(std, rel=0.05)


@pytest.mark.slow
def test_an_odd_data_set_is_named_where_the_others_are_drawn_anew():
    problems, likely, kept = campaign(2.0, 1.4, 3)
    others, _, its_draws = campaign(-0.5, 0.1, 1, 1)
    others = [replace(others[0], observations=replace(others[0].observations, name="odd"))]
    hyper = replace(HYPER, odd=0.05)
    exact, estimated = quadrature(likely)[0], population(problems + others, kept + its_draws, hyper=hyper)
    assert estimated.odd == (20,)
    assert np.median(estimated.posterior.nu) == pytest.approx(exact[1], abs=0.5 * (exact[2] - exact[0]) / 3.3)


@pytest.mark.slow
def test_draws_taken_anew_are_the_same_on_any_workers():
    problems, _, kept = campaign(2.0, 1.4, 3, 5)
    apart = []
    for workers in (1, 3):
        with ThreadsExecutor(workers) as executor:
            apart.append(population(problems, kept, executor=executor, effort=Effort(16, 20, 3, 600, 60)))
    assert apart[0].forward_runs == apart[1].forward_runs > 0
    np.testing.assert_array_equal(apart[0].posterior.nu, apart[1].posterior.nu)


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 10])
@pytest.mark.parametrize("least", [0.0, 0.3])
def test_upper_limits_add_up_to_what_they_say(count, least):
    """Above a limit the likelihood falls to ``least`` of what it is below."""
    apart, width = [], []
    for seed in range(CAMPAIGNS if count > 5 else 3):
        rng = np.random.default_rng([seed, count])
        edges, slopes = rng.uniform(0.3, 1.5, (count, 1)), rng.uniform(0.1, 0.4, (count, 1))
        likely = least + (1 - least) * expit((edges - X) / slopes)
        sets = [OwnDraws(z[:, None], 0.0, DRAWS / 2, 0) for z in drawn_from(likely, rng, DRAWS)]
        likelihoods = own_likelihoods(sets, [0], [], seed, [f"set{s}" for s in range(count)], np.zeros(1))
        exact, estimated = quadrature(likely)[0], Hierarchy(likelihoods, HYPER).sampled(seed, Effort()).nu
        told = np.quantile(estimated, BELOW)
        std = (exact[2] - exact[0]) / (2 * norm.ppf(0.95))
        apart.append((told - exact) / std)
        width.append((told[2] - told[0]) / (exact[2] - exact[0]))
    assert np.abs(np.mean(apart, axis=0)).max() < 0.25
    assert np.mean(width) == pytest.approx(1.0, abs=0.1)
