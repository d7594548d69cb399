"""Populations with common quantities, odd data sets, uncertain errors: closed forms of a linear hierarchy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from toys import Vectorised, make_problem, with_discrepancy

from en4dvar.data.noise import noise_of
from en4dvar.estimation.population import Effort, HyperPrior
from en4dvar.estimation.population.campaign import _empirical, population_of, sampled_sets
from en4dvar.estimation.population.following import Following
from en4dvar.estimation.population.hierarchy import Hierarchy, named
from en4dvar.estimation.population.own import (
    Mixture,
    OwnDraws,
    OwnLikelihood,
    empirical,
    median_of,
    own_draws,
    own_likelihoods,
    pooled_slopes,
)
from en4dvar.model.forward import Failure
from en4dvar.model.state import NOISE_SCALE, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm, member_stream
from en4dvar.runs.together import _cautions

STD, SETS, SLOPE = 0.3, 8, 0.5
A, B = (Parameter(name, "m") for name in "ab")
D = Parameter("d", "m", common=True)
OF_A, OF_B, OF_D = PriorTerm.normal(A, 0.6, 0.9), PriorTerm.normal(B, 0.2, 0.5), PriorTerm.normal(D, 0.0, 0.4)
HYPER = HyperPrior(1.0, 0.5, odd=0.0)
ROUGH = Effort(hyper_rounds=20, hyper_components=3, draws=600, effective=60)


class Shifted(Vectorised):
    """y = a + d/2 + b cos(t + 1/3): the data never tell a from d."""

    def __init__(self):
        super().__init__()
        self.parameters = (A, B, D)

    def initial_state(self, theta):
        values = np.array([theta["a"] + SLOPE * theta["d"], theta["b"]])
        return np.concatenate([[self.curve(values, 0.0), self.rate(values, 0.0)], values])


class Broken(Shifted):
    """Cannot integrate anything."""

    def trajectories(self, x, times):
        return [Failure("too stiff", 0.1)] * len(x)


def campaign(truths, d=0.3, seed=4, terms=(OF_A, OF_B, OF_D), std=STD):
    """Data sets with b = 0.4 each, errors of ``std``."""
    model, toy, problems = Shifted(), Vectorised(), []
    for s, a in enumerate(truths):
        one = make_problem(toy, (a + SLOPE * d, 0.4), std=std, seed=100 * seed + s, k=6 + s % 3)
        observations = replace(one.observations, name=f"set{s}")
        problems.append(replace(one, model=model, observations=observations, prior=Prior(terms)))
    return problems


def likely(problems, std=STD):
    """Of each data set mean and variance of a + d/2, b integrated over its prior."""
    found = []
    for p in problems:
        column = np.cos(p.observations.times + 1 / 3)
        C = std**2 * np.eye(len(column)) + OF_B.std**2 * np.outer(column, column)
        solved = np.linalg.solve(C, np.column_stack([np.ones(len(column)), p.observations.values - 0.2 * column]))
        information = solved[:, 0].sum()
        found.append((solved[:, 1].sum() / information, 1 / information))
    return np.array(found).T


def exact(problems, hyper, common=OF_D.std, doubted=()):
    """Mean and std of ν, and mean of τ, on a grid of m = ν + d/2 and τ: given m the data say nothing of ν."""
    odds = [max(0.9, hyper.odd) if p.observations.name in doubted else hyper.odd for p in problems]
    m, tau = np.linspace(-3, 4, 281), np.geomspace(1e-3, 3, 121)
    of_nu, of_d = (0.9 * hyper.mean_std) ** 2, (SLOPE * common) ** 2
    log = norm(0.6, np.sqrt(of_nu + of_d)).logpdf(m)[:, None] - 0.5 * (tau / (0.9 * hyper.spread)) ** 2
    wide = np.sqrt(0.9**2 + of_d)
    for best, variance, share in zip(*likely(problems), odds, strict=True):
        inside = norm(best, np.sqrt(variance + tau**2)).logpdf(m[:, None])
        outside = norm(0.6, np.sqrt(variance + wide**2)).pdf(best)
        elsewhere = norm(best, np.sqrt(variance + tau**2 + (0.9 * hyper.mean_std) ** 2)).pdf(m[:, None])
        odd = np.log(share / 2) + np.log(outside + elsewhere) if share else -np.inf
        log = log + np.logaddexp(np.log1p(-share) + inside, odd)
    weights = np.exp(log - log.max()) * np.gradient(tau)
    weights /= weights.sum()
    share, left = of_nu / (of_nu + of_d), of_nu * of_d / (of_nu + of_d)
    middle, variance = weights.sum(axis=1) @ m, weights.sum(axis=1) @ m**2
    variance -= middle**2
    return 0.6 + share * (middle - 0.6), np.sqrt(share**2 * variance + left), weights.sum(axis=0) @ tau


def members(problems):
    return [0.5 * member_stream(s, "start").standard_normal((30, len(p.prior.names))) for s, p in enumerate(problems)]


def known(problems, but):
    """Exact draws of the posteriors of all data sets but one, which is to be sampled."""
    found = []
    for s, p in enumerate(problems):
        t, stds = p.observations.times, np.array([term.std for term in p.prior.terms])
        of_units = np.stack([np.ones(len(t)), np.cos(t + 1 / 3), np.full(len(t), SLOPE)], axis=1)
        columns = of_units * stds / STD
        misfit = (p.observations.values - of_units @ [term.mean for term in p.prior.terms]) / STD
        covariance = np.linalg.inv(np.eye(3) + columns.T @ columns)
        z = member_stream(s, "known").multivariate_normal(covariance @ columns.T @ misfit, covariance, 2000)
        found.append(None if s == but else OwnDraws(z, 0.0, 2000.0, 0))
    return found


def truths(spread, count=SETS, seed=1):
    return 1.0 + spread * np.random.default_rng(seed).standard_normal(count)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_what_is_common_does_not_average_out(spread):
    problems = campaign(truths(spread))
    kept = known(problems, 0) if spread else ()
    found = population_of(problems, members(problems), ["a"], 2, kept=kept, hyper=HYPER)
    mean, std, between = exact(problems, HYPER)
    assert found.common == ("d",)
    assert found.posterior.mean.mean() == pytest.approx(mean, abs=0.15 * std)
    assert found.posterior.mean.std() == pytest.approx(std, rel=0.07)
    assert found.posterior.between.mean() == pytest.approx(between, rel=0.1)
    own, shared = found.parts
    assert shared[0] == pytest.approx(SLOPE * OF_D.std, rel=0.1)
    assert np.hypot(own[0], shared[0]) == pytest.approx(found.posterior.mean.std(), rel=1e-6)
    of_own = OF_D if spread else replace(OF_D, parameter=Parameter("d", "m"))
    if not spread:  # a quantity of its own in each data set averages out, and the interval becomes too narrow
        alone = campaign(truths(spread), terms=(OF_A, OF_B, of_own))
        assert population_of(alone, members(alone), ["a"], 2, hyper=HYPER).posterior.mean.std() < 0.8 * std


def test_an_odd_data_set_is_named_and_moves_nothing():
    values = truths(0.1)
    values[3] = -1.8
    problems, hyper = campaign(values), replace(HYPER, odd=0.05)
    kept = known(problems, 3)
    kept[3] = own_draws(problems[3], members(problems)[3], 2)
    found = population_of(problems, members(problems), ["a"], 2, kept=kept, hyper=hyper)
    assert found.belongs[3] < 0.05
    assert np.delete(found.belongs, 3).min() > 0.8
    (one,) = (c for c in _cautions(found) if c.code == "odd-data-set")
    assert "set3" in one.words
    assert "set2" not in one.words
    assert "left out" not in one.advice
    mean, std, between = exact(problems, hyper)
    assert found.posterior.mean.mean() == pytest.approx(mean, abs=0.15 * std)
    assert found.posterior.mean.std() == pytest.approx(std, rel=0.1)
    assert found.posterior.between.mean() == pytest.approx(between, rel=0.15)
    strict = population_of(problems, members(problems), ["a"], 2, kept=kept, hyper=HYPER, effort=ROUGH)
    assert np.median(strict.posterior.tau) > 2 * np.median(found.posterior.tau)


def test_one_whose_readings_are_doubted_counts_where_the_others_bear_it_out():
    """Too near to be odd by its data, it would widen the spread, and move the mean to its side."""
    values = truths(0.1)
    values[3] += 0.35
    problems, hyper = campaign(values), replace(HYPER, odd=0.05)
    found = population_of(
        problems, members(problems), ["a"], 2, kept=known(problems, -1), hyper=hyper, doubted={"set3"}
    )
    mean, std, between = exact(problems, hyper, doubted={"set3"})
    assert found.posterior.mean.mean() == pytest.approx(mean, abs=0.15 * std)
    assert found.posterior.mean.std() == pytest.approx(std, rel=0.1)
    assert found.posterior.between.mean() == pytest.approx(between, rel=0.15)
    assert exact(problems, hyper)[2] > 1.3 * between
    assert found.odd == ()
    assert hyper.odd_before([False, True]).tolist() == [0.05, 0.9]
    assert replace(hyper, odd=0.0).odd_before([True]).tolist() == [0.0]


def test_one_that_is_odd_in_one_parameter_alone_is_named():
    """Of twelve sets of two parameters, whose probabilities are those of normal distributions in closed form."""
    rng, hyper, error = np.random.default_rng(6), HyperPrior(1.0, 0.5, odd=0.05), 0.08
    y = np.array([0.3, -0.2]) + np.hypot(0.1, error) * rng.standard_normal((12, 2))
    y[0] = 1.0, -0.2
    left = 1 / (1 + error**-2)
    each = ((r, Mixture.divided(left / error**2 * r[None], left * np.eye(2)[None], np.zeros(1), np.ones(2))) for r in y)
    following = Following(np.zeros((2, 0)), np.zeros(2))
    likelihoods = [OwnLikelihood(m, m, following, r + error * rng.standard_normal((400, 2))) for r, m in each]
    hierarchy, h = Hierarchy(likelihoods, hyper), np.array([[0.3, -0.2, *np.log([0.1, 0.2])]])
    variances = np.array([[0.01, 0.04], [0.01 + 1, 0.04], [0.01, 0.04 + 1]]) + error**2
    under_prior = norm(0, np.hypot(1, error)).pdf(y).prod(axis=1)
    exact_parts = [norm(h[0, :2], np.sqrt(v)).pdf(y).prod(axis=1) / under_prior for v in variances]
    shares = np.array([0.95, 0.025, 0.0125, 0.0125])
    expected = shares * np.stack([exact_parts[0], np.ones(12), *exact_parts[1:]], axis=1)
    np.testing.assert_allclose(np.exp(hierarchy.log_parts(h)[0]), expected, rtol=1e-8)
    np.testing.assert_allclose(hierarchy.belongs(h)[0], expected / expected.sum(axis=1, keepdims=True), rtol=1e-8)
    belongs = hierarchy.sampled(1, Effort()).belongs
    assert named(belongs, hyper.odd) == (0,)
    assert belongs[1:].min() > 0.7


def test_a_slope_that_is_known_badly_counts_little():
    rng = np.random.default_rng(3)
    errors = np.array([*[0.01] * 20, 1.0])
    alike = 0.5 + errors * rng.standard_normal(21)
    of_all = pooled_slopes(alike[:, None, None], errors[:, None, None] ** 2)[0, 0]
    assert of_all == pytest.approx(np.average(alike, weights=errors**-2.0), abs=1e-3)
    differ = alike + rng.standard_normal(21)
    assert pooled_slopes(differ[:, None, None], errors[:, None, None] ** 2)[0, 0] == pytest.approx(
        differ.mean(), abs=0.1
    )


@pytest.mark.slow
def test_slopes_that_differ_with_what_varies_tell_nothing_of_what_is_common():
    """Of y = exp(x) + θ b + e, slopes of x with θ are steeper where x is small; exact by quadrature."""
    rng, b, error, count = np.random.default_rng(11), 0.15, 0.08, 12
    z, u = np.meshgrid(np.linspace(-1.5, 1.5, 301), np.linspace(-4, 4, 81), indexing="ij")
    far = []
    for trial in range(8):
        x = 0.25 * rng.standard_normal(count)
        y = np.exp(x) + b * rng.standard_normal() + error * rng.standard_normal(count)
        likely = [norm(np.exp(z) + b * u, error).pdf(reading) for reading in y]
        sets = []
        for like in likely:
            shares = (like * norm.pdf(z) * norm.pdf(u)).ravel()
            taken = rng.choice(z.size, size=2000, p=shares / shares.sum())
            jitter = np.array([0.01, 0.1]) * rng.uniform(-0.5, 0.5, (2000, 2))
            sets.append(OwnDraws(np.stack([z.ravel()[taken], u.ravel()[taken]], axis=1) + jitter, 0.0, 2000.0, 0))
        hyper = HyperPrior(1.0, 0.5, odd=0.0)
        likelihoods = own_likelihoods(sets, [0], [1], trial, [f"set{s}" for s in range(count)], np.zeros(1))
        found = Hierarchy(likelihoods, hyper).sampled(trial, Effort())
        mean, std = by_quadrature(np.array(likely), z, hyper)
        far.append((found.nu.mean() - mean) / std)
        assert found.nu.std() == pytest.approx(std, rel=0.25)
    assert abs(np.mean(far)) < 0.25


def by_quadrature(likely, z, hyper):
    """Mean and std of ν where likelihoods (S, x, θ) are of x at ``z`` and of θ, a priori N(0, 1)."""
    nu, tau, u = np.linspace(-1.2, 1.2, 97), np.geomspace(0.02, 1.5, 40), np.linspace(-4, 4, likely.shape[2])
    log = -0.5 * (nu[:, None, None] / hyper.mean_std) ** 2 - 0.5 * (tau[:, None] / hyper.spread) ** 2 - 0.5 * u**2
    within = norm(nu[:, None, None], tau[:, None]).pdf(z[:, 0])  # (ν, τ, x)
    for like in likely:
        log = log + np.log(within @ like + 1e-300)
    weights = (np.exp(log - log.max()) * np.gradient(tau)[:, None]).sum(axis=(1, 2))
    mean = np.average(nu, weights=weights)
    return mean, np.sqrt(np.average((nu - mean) ** 2, weights=weights))


def test_more_data_sets_are_named_only_by_more_evidence():
    """Of three the odds have to rise fivefold, of forty tenfold."""
    for count, factor in ((3, 5.0), (12, 5.0), (40, 10.0)):
        odds = factor * 0.05 / 0.95 * np.array([1.01, 0.99, *[0.1] * (count - 2)])
        assert named(1 / (1 + odds), 0.05) == (0,)
    assert named(np.array([0.0, 1.0, 1.0]), 0.05) == (0,)
    assert named(np.array([1.0, 1.0, 1.0]), 0.0) == ()


@pytest.mark.slow
def test_uncertain_errors_are_quantities_of_each_data_set():
    """A scale of the errors that is all but known changes nothing; a wide one, a timing error and a discrepancy are
    taken as they are.
    """
    values = truths(0.3)
    known = (OF_A, OF_B, OF_D, PriorTerm.lognormal(NOISE_SCALE, 1.0, 0.01))
    problems = campaign(values, terms=known)
    found = population_of(problems, members(problems), ["a"], 2, hyper=HYPER)
    mean, std, _ = exact(problems, HYPER)
    assert found.posterior.mean.mean() == pytest.approx(mean, abs=0.15 * std)
    assert found.posterior.mean.std() == pytest.approx(std, rel=0.1)
    robust = [with_discrepancy(p, sigma=0.4, huber=2.0, amplitude=(0.03, 0.5)) for p in campaign(values)]
    timed = [replace(p, observations=replace(p.observations, noise=timing(p.observations))) for p in campaign(values)]
    for uncertain in (robust, timed):
        taken = population_of(uncertain, members(uncertain), ["a"], 2, hyper=HYPER)
        assert taken.posterior.mean.mean() == pytest.approx(mean, abs=0.5 * std)


def timing(observations):
    return noise_of(observations.std, np.full(len(observations), 0.02))


def test_the_median_one_by_one_of_sets_that_only_what_is_common_makes_uncertain():
    """Their members scatter by chance less than the common quantity alone would say; what is their own is 0.01."""
    rng, count = np.random.default_rng(1), 12
    theta, own = rng.standard_normal((400, 1)), 0.01 * rng.standard_normal((count, 400, 1))
    likelihoods = [OwnLikelihood(None, None, Following(np.array([[0.5]]), np.zeros(1)), z) for z in own]
    sets = [0.9 * (0.5 * theta + z) for z in own]
    (median,) = _empirical([PriorTerm.normal(A, 0.0, 1.0)], sets, likelihoods, 1, np.zeros(len(sets)))
    assert median.common == pytest.approx(0.5, rel=1e-6)
    assert 0.8 * 0.01 / np.sqrt(count) < median.between < 4 * 0.01 / np.sqrt(count)


def test_data_sets_that_cannot_be_sampled_are_named():
    problems = campaign(truths(0.2))
    kept = known(problems, 2)
    problems[2] = replace(problems[2], model=Broken())
    found = population_of(problems, members(problems), ["a"], 2, kept=kept, hyper=HYPER, effort=ROUGH)
    assert list(found.left_out) == ["set2"]
    assert len(found.problems) == SETS - 1
    assert any("set2 is left out" in c.words for c in _cautions(found))


def test_a_data_set_whose_draws_coincide_is_told_in_words():
    """Readings with errors of a millionth, which one draw alone fits."""
    problems = campaign(truths(0.2))[:3]
    kept, observations = known(problems, 2), problems[2].observations
    noise = noise_of(1e-6 * observations.std, 0 * observations.std)
    problems[2] = replace(problems[2], observations=replace(observations, noise=noise))
    with pytest.raises(ValueError, match="only 2 of 3 data sets can be sampled; set2: its draws coincide"):
        sampled_sets(problems, members(problems), 2, None, list, [*kept[:2], None])


def test_one_draw_that_has_all_the_weight_is_told_as_too_few(monkeypatch):
    """Nothing can be fitted to it for another round."""
    problems, weighed = campaign(truths(0.2)), Hierarchy._weighed

    def one_of_all(self, *how):
        h, logs = weighed(self, *how)
        return h, np.append(logs[0] + 1e4, logs[1:])

    monkeypatch.setattr(Hierarchy, "_weighed", one_of_all)
    found = population_of(problems, members(problems), ["a"], 2, kept=known(problems, None), hyper=HYPER, effort=ROUGH)
    assert found.size < 1.01
    assert "chain-not-converged" in {c.code for c in _cautions(found)}


def test_two_data_sets_of_one_name_would_have_the_same_random_numbers():
    problems = campaign(truths(0.2))
    problems[1] = replace(problems[1], observations=replace(problems[1].observations, name="set2"))
    with pytest.raises(ConfigError, match="a population need different names: set2 twice"):
        population_of(problems, members(problems), ["a"], 2)


def test_parameters_must_be_the_same_in_all():
    problems = campaign(truths(0.2))
    other = (OF_A, OF_D, OF_B)
    problems[1] = replace(problems[1], prior=Prior(other))
    with pytest.raises(ConfigError, match="set1: a population needs the same parameters"):
        population_of(problems, members(problems), ["a"], 2)


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 6, 20])
def test_the_median_of_data_sets_holds_the_truth_as_often_as_it_says(count):
    """Sets of std 0.5 ± 0.3 about 0, with a common error of std 0.4."""
    rng, inside = np.random.default_rng(count), []
    term = PriorTerm.lognormal(Parameter("G", "Pa"), 1000.0, 1.0)
    for trial in range(300):
        std = 0.3 * rng.uniform(0.5, 1.5, count)
        middle = 0.5 * rng.standard_normal(count) + std * rng.standard_normal(count) + 0.4 * rng.standard_normal()
        low, _, high = empirical(term, middle, std, Following(np.array([[0.4]]), np.zeros(1)), trial).quantiles
        inside.append(low < 1000.0 < high)
    assert 0.84 < np.mean(inside) < 0.98


def test_a_weighted_median():
    x, std = np.array([0.0, 1.0, 2.0, 30.0]), np.full(4, 0.1)
    middle, spread = median_of(x, std, member_stream(1, "a"))
    assert middle == pytest.approx(1.5)
    assert spread < x.std()
    assert median_of(np.array([0.0, 1.0, 2.0]), np.array([0.01, 50.0, 50.0]), member_stream(1, "a"))[0] < 1.0


def test_the_interval_of_data_sets_that_say_little_holds_what_they_all_say():
    """Each says 2 with an error that leaves half of the prior's width, and so has 1.5: they agree, but not with 2."""
    centre, spread = median_of(np.full(12, 1.5), np.full(12, 0.5), member_stream(1, "a"))
    assert centre == pytest.approx(1.5)
    assert centre + 1.645 * spread > 2.0


def test_a_few_that_are_sure_do_not_outweigh_many_others():
    """Seven of ten lie about 0 ± 0.6, three at 1.4 ± 0.1."""
    middle, std = np.array([-0.5, -0.3, -0.1, 0.1, 0.2, 0.3, 0.5, 1.4, 1.4, 1.4]), np.array([0.6] * 7 + [0.1] * 3)
    assert median_of(middle, std, member_stream(1, "a"))[0] < 0.6


@pytest.mark.slow
def test_the_median_of_soft_gels_is_not_pulled_to_the_stiffest():
    """A modulus of 2.5 ± 0.7 kPa and a wide prior of its logarithm: low values have wide posteriors of it."""
    rng, grid, inside = np.random.default_rng(3), np.linspace(-6, 5, 800), []
    for trial in range(100):
        truths = 2.5 * np.exp(0.4 * rng.standard_normal(24))
        seen = truths + 0.7 * rng.standard_normal(24)
        log = -0.5 * ((seen[:, None] - np.exp(grid)) / 0.7) ** 2 - 0.5 * ((grid - 1) / 2) ** 2
        weights = np.exp(log - log.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        middle = np.array([np.interp(0.5, np.cumsum(row), grid) for row in weights])
        std = np.sqrt(weights @ grid**2 - (weights @ grid) ** 2)
        term = PriorTerm.lognormal(Parameter("G", "kPa"), np.e, 2.0)
        alone = Following(np.zeros((1, 0)), np.zeros(1))
        low, _, high = empirical(term, (middle - 1) / 2, std / 2, alone, trial).quantiles
        inside.append(low < 2.5 < high)
    assert 0.82 < np.mean(inside) < 0.98  # of 0.9; by weights 1/(s² + T²) of T² how much they differ 0.33


def test_a_data_set_that_tells_nothing_does_not_count():
    middle, std = np.array([2.0, 2.1, 2.2, 0.0, 0.0, 0.0, 0.0]), np.array([0.1] * 3 + [1.0] * 4)
    assert median_of(middle, std, member_stream(1, "a"))[0] == pytest.approx(2.1, abs=0.05)


def test_a_data_set_with_wrong_readings_counts_a_tenth_in_the_median_one_by_one():
    """Two of five whose readings are wrong lie far above; full members of the median, they would be its upper end."""
    rng, level = np.random.default_rng(2), np.array([0.0, 0.1, 0.2, 3.0, 3.1])
    own = 0.01 * rng.standard_normal((5, 400, 1))
    likelihoods = [OwnLikelihood(None, None, Following(np.array([[0.5]]), np.zeros(1)), z) for z in own]
    sets = [middle + z for middle, z in zip(level, own, strict=True)]
    before = HyperPrior().odd_before([False] * 3 + [True] * 2)
    alike, doubted = (
        _empirical([PriorTerm.normal(A, 0.0, 1.0)], sets, likelihoods, 1, odd)[0] for odd in (np.full(5, 0.05), before)
    )
    assert alike.quantiles[1] == pytest.approx(0.2, abs=0.02)
    assert doubted.quantiles[1] == pytest.approx(0.11, abs=0.03)
    assert doubted.between < 0.5 * alike.between
    without = _empirical([PriorTerm.normal(A, 0.0, 1.0)], sets, likelihoods, 1, np.zeros(5))[0]
    np.testing.assert_allclose(without.quantiles, alike.quantiles, rtol=1e-9)


def test_data_sets_known_exactly_have_their_median():
    for x in ([0.0, 1.0, 2.0], [0.1, 0.2, 0.7, 0.9, 1.3], [3.0, 3.0, 3.0]):
        middle, spread = median_of(np.array(x), np.zeros(len(x)), member_stream(1, "a"))
        assert middle == pytest.approx(np.median(x))
        assert np.isfinite(spread)
