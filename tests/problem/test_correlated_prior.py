"""Correlated priors: draws, densities, and posteriors against the closed linear-Gaussian one."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from toys import Vectorised, make_problem

from en4dvar.config.dependence import term_of_members
from en4dvar.estimation.assimilate import assimilate, log_posterior
from en4dvar.model.state import NOISE_SCALE, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.dependence import Dependence
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.sampling.modes import sample_modes
from en4dvar.schemes.settings import AssimilationSettings

NAMES = ("a", "b", "c", "d")
MATRIX = np.array([[1.0, 0.7, -0.2], [0.7, 1.0, 0.3], [-0.2, 0.3, 1.0]])
BLOCK = Dependence(("d", "a", "c"), MATRIX)  # neither side by side nor in the order of the control vector


def linear_problem(block=BLOCK, scale=(1.0, 0.5, 2.0, 1.5)):
    problem = make_problem(Vectorised(NAMES), [1.0, -0.5, 0.3, 0.8], std=0.3)
    terms = tuple(replace(t, std=s) for t, s in zip(problem.prior.terms, scale, strict=True))
    return replace(problem, prior=Prior(terms, (block,) if block else ()))


def covariance(prior):
    """The prior's, written out."""
    full = np.eye(len(prior.names))
    for block in prior.blocks:
        for i, one in enumerate(block.names):
            for j, other in enumerate(block.names):
                full[prior.names.index(one), prior.names.index(other)] = block.matrix[i, j]
    return full * np.outer(prior.std, prior.std)


def closed_form(problem):
    """Mean, covariance and log evidence of the linear-Gaussian problem."""
    o, prior = problem.observations, problem.prior
    j = np.arange(len(prior.names))
    h = np.cos(j * o.times[:, None] + j**2 / 3)
    p, r = covariance(prior), np.diag(o.std**2)
    s = h @ p @ h.T + r
    gain = np.linalg.solve(s, h @ p).T
    evidence = stats.multivariate_normal(h @ prior.mean, s).logpdf(o.values)
    return prior.mean + gain @ (o.values - h @ prior.mean), p - gain @ h @ p, evidence


@pytest.mark.parametrize("members", [5, 24])
def test_posterior_is_the_closed_one(members):
    problem = linear_problem()
    found = assimilate(problem, AssimilationSettings(members=members), 1)
    mean, expected, evidence = closed_form(problem)
    assert found.posterior.mean(axis=0) == pytest.approx(mean, abs=1e-10)
    assert np.cov(found.posterior.T) == pytest.approx(expected, abs=1e-10)
    assert found.log_evidence == pytest.approx(evidence, abs=1e-8)
    independent = closed_form(linear_problem(None))[0]
    assert np.max(np.abs(independent - mean)) > 0.01  # the correlations matter


@pytest.mark.slow
def test_sampled_posterior_and_evidence_are_the_closed_ones():
    problem = linear_problem()
    mean, expected, evidence = closed_form(problem)
    chain = assimilate(problem, AssimilationSettings(members=200, refine="mcmc"), 1)
    assert chain.posterior.mean(axis=0) == pytest.approx(mean, abs=0.1 * np.sqrt(np.diag(expected)).max())
    assert np.cov(chain.posterior.T) == pytest.approx(expected, abs=0.15 * expected.max())
    found = assimilate(problem, AssimilationSettings(members=24), 1)
    assert found.modes == () or len(found.modes) == 1
    minimum = minimum_of(problem)
    draws = sample_modes(lambda x: -log_posterior(problem, x), problem.prior, [minimum], 1)
    assert draws.log_evidence - problem.observations.log_normalisation() == pytest.approx(evidence, abs=0.05)
    assert minimum.log_evidence(problem.prior) == pytest.approx(
        evidence + problem.observations.log_normalisation(), abs=1e-8
    )


def minimum_of(problem):
    from en4dvar.descent.minima import Minimum

    mean, expected, _ = closed_form(problem)
    return Minimum(mean, expected, float(-log_posterior(problem, mean[None])[0]))


@pytest.mark.parametrize("first", ["a", "sigma"])
@pytest.mark.parametrize("seed", range(2))
def test_a_parameter_that_is_correlated_with_the_size_of_the_errors(first, seed):
    """A level that is read five times: given ln σ it is Gaussian, before and after; over ln σ a sum."""
    rho, k = 0.9, 5
    problem = make_problem(Vectorised(("a",)), [1.0], seed=seed, k=k)
    terms = {"a": problem.prior.terms[0], "sigma": PriorTerm.lognormal(NOISE_SCALE, 1.5, 0.8)}
    names = (first, *terms.keys() - {first})
    blocks = (Dependence(names, np.array([[1, rho], [rho, 1]])),)
    problem = replace(problem, prior=Prior(tuple(terms[name] for name in names), blocks))
    found = assimilate(problem, AssimilationSettings(refine="none"), seed)

    z, y, term = np.linspace(-6, 6, 4001), problem.observations.values, terms["a"]
    size, before = 0.1 * 1.5 * np.exp(0.8 * z), term.std**2 * (1 - rho**2)
    apart = y - (term.mean + term.std * rho * z)[:, None]
    after = 1 / (1 / before + k / size**2)
    middle = term.mean + term.std * rho * z + after / size**2 * apart.sum(axis=1)
    squares = np.sum(apart**2, axis=1) / size**2 - after * (apart.sum(axis=1) / size**2) ** 2
    logs = -0.5 * (z**2 + squares + np.log(before / after)) - k * np.log(size) - 0.5 * (k + 1) * np.log(2 * np.pi)
    evidence = np.logaddexp.reduce(logs) + np.log(z[1] - z[0])
    weights = np.exp(logs - np.logaddexp.reduce(logs))
    mean = weights @ middle
    std = np.sqrt(weights @ (after + (middle - mean) ** 2))
    members = found.posterior[:, names.index("a")]
    assert found.log_evidence == pytest.approx(evidence, abs=0.1)
    assert members.mean() == pytest.approx(mean, abs=0.1 * std)
    assert members.std(ddof=1) == pytest.approx(std, rel=0.1)
    scale = np.log(found.posterior[:, names.index("sigma")])
    assert scale.mean() == pytest.approx(np.log(1.5) + 0.8 * weights @ z, abs=0.05)


@pytest.mark.parametrize("method", ["exact", "random"])
def test_draws_have_the_covariance(method):
    prior = linear_problem().prior
    drawn = prior.sample(20_000, 3, method)
    tolerance = 1e-10 if method == "exact" else 0.1
    assert np.cov(drawn.T) == pytest.approx(covariance(prior), abs=tolerance)
    assert drawn.mean(axis=0) == pytest.approx(prior.mean, abs=tolerance)


def test_density_and_white_coordinates():
    prior = linear_problem().prior
    x = np.random.default_rng(1).normal(size=(5, 7, 4))
    density = stats.multivariate_normal(prior.mean, covariance(prior))
    assert prior.log_density(x) == pytest.approx(density.logpdf(x), abs=1e-10)
    assert prior.from_white(prior.white(x)) == pytest.approx(x, abs=1e-12)
    some = covariance(prior)
    assert prior.white_covariance(some) == pytest.approx(np.eye(4), abs=1e-12)


def test_the_marginals_stay_and_the_correlation_is_that_of_the_logarithms():
    a, b = Parameter("a", "Pa"), Parameter("b", "1")
    terms = PriorTerm.lognormal(a, 2.0, 0.5), PriorTerm.uniform(b, (0.0, 1.0))
    prior = Prior(terms, (Dependence(("a", "b"), np.array([[1.0, 0.8], [0.8, 1.0]])),))
    theta = prior.to_physical(prior.sample(4000, 1))
    assert stats.kstest(theta[:, 1], "uniform").pvalue > 0.01
    assert np.corrcoef(np.log(theta[:, 0]), stats.norm.ppf(theta[:, 1]))[0, 1] == pytest.approx(0.8, abs=1e-10)


def test_a_prior_of_some_of_the_parameters_keeps_their_correlations():
    prior = linear_problem().prior
    kept = prior.of(prior.terms[2:])
    assert covariance(kept) == pytest.approx(covariance(prior)[2:, 2:])
    assert prior.of(prior.terms[:2]).blocks == ()
    assert pickle.loads(pickle.dumps(prior)) == prior


@pytest.mark.parametrize(
    ("names", "matrix", "words"),
    [
        (("a", "b"), [[1, 0.5], [0.4, 1]], "must be symmetric"),
        (("a", "b"), [[2, 0.5], [0.5, 2]], "the diagonal must be 1"),
        (("a", "b"), [[1, 1], [1, 1]], "not positive definite"),
        (("a", "b"), [[1, 1.5], [1.5, 1]], "not positive definite"),
        (("a", "b"), [[1, 0.5]], "the matrix is 1 by 2, not 2 by 2"),
        (("a", "a"), [[1, 0.5], [0.5, 1]], "a name occurs twice"),
        (("a", "b"), [[1, np.nan], [np.nan, 1]], "finite"),
    ],
)
def test_what_is_no_correlation_is_refused(names, matrix, words):
    with pytest.raises(ConfigError, match=words):
        Dependence(names, np.array(matrix, dtype=float))


def test_blocks_that_do_not_suit_the_prior_are_refused():
    terms = linear_problem().prior.terms
    pair = np.array([[1.0, 0.5], [0.5, 1.0]])
    with pytest.raises(ConfigError, match="in two blocks"):
        Prior(terms, (BLOCK, Dependence(("a", "b"), pair)))
    with pytest.raises(ConfigError, match="e is correlated, but not estimated"):
        Prior(terms, (Dependence(("a", "e"), pair),))


@pytest.mark.parametrize("members", [12, 30])
def test_posterior_with_an_ensemble_as_prior(members):
    """Its Gaussian, whatever the number of members; with as many as the file has, they are the file's."""
    problem, found = linear_problem(None), np.random.default_rng(2).standard_normal((12, 4)) @ np.diag([1, 2, 0.5, 1])
    made = [term_of_members(p, x, None) for p, x in zip(problem.prior.parameters, found.T, strict=True)]
    y = np.stack([scores for _, scores in made], axis=1)
    block = Dependence(NAMES, np.corrcoef(y.T), y)
    problem = replace(problem, prior=Prior(tuple(term for term, _ in made), (block,)))
    assert covariance(problem.prior) == pytest.approx(np.cov(found.T), abs=1e-12)
    analysis = assimilate(problem, AssimilationSettings(members=members), 1)
    mean, expected, _ = closed_form(problem)
    assert analysis.posterior.mean(axis=0) == pytest.approx(mean, abs=1e-10)
    assert np.cov(analysis.posterior.T) == pytest.approx(expected, abs=1e-10)
    assert np.allclose(analysis.prior[:12], found, atol=1e-10) == (members == 12)
