"""What leaving out a reading does, against fits done without it; Pareto smoothing, against ArviZ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import Decay, Vectorised, make_problem, with_noise

from en4dvar.data.noise import Kernel, Predicted, noise_of
from en4dvar.data.observations import Observations
from en4dvar.diagnosis.influence import (
    LINEAR,
    UNKNOWN,
    WEIGHTED,
    Influence,
    ReadingTangent,
    believed_shape,
    pareto_smoothed,
    prior_distance,
)
from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings()
TIMES = np.linspace(0.0, 2.0, 7)
CORRELATION = np.exp(-np.abs(np.subtract.outer(TIMES, TIMES)) / 0.5)


@pytest.mark.parametrize(("draws", "heavy"), [(48, 0.1), (48, 0.6), (48, 1.5), (500, 0.3), (500, 0.9), (30, 0.5)])
def test_smoothed_weights_are_those_of_arviz(draws, heavy):
    import arviz  # takes seconds, which every worker would spend where it stands above

    ratios = heavy * np.random.default_rng(draws).standard_exponential((draws, 6))
    log_weights, shape = pareto_smoothed(ratios)
    expected, k = arviz.psislw(ratios.T)
    np.testing.assert_allclose(shape, k, rtol=1e-9)
    np.testing.assert_allclose(log_weights.T, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.exp(log_weights).sum(axis=0), 1.0)


def test_few_draws_and_equal_ratios():
    _, shape = pareto_smoothed(np.random.default_rng(1).standard_normal((20, 3)))
    assert np.all(shape == np.inf)
    log_weights, shape = pareto_smoothed(np.zeros((48, 2)))
    assert np.all(shape == -np.inf)
    np.testing.assert_allclose(log_weights, -np.log(48.0))


def conditional_by_hand(observations, predicted):
    """ln p(y) − ln p(y without k) of a Gaussian with the covariance at the prediction."""
    noise = observations.noise
    residual = observations.values - predicted.values

    def log_density(kept):
        s = noise.error_std(predicted)
        covariance = noise.covariance(predicted) if noise.discrepant else np.outer(s, s) * noise.correlation.matrix
        covariance, r = covariance[np.ix_(kept, kept)], residual[kept]
        return -0.5 * (r @ np.linalg.solve(covariance, r) + np.linalg.slogdet(2 * np.pi * covariance)[1])

    every = np.arange(len(residual))
    return np.array([log_density(every) - log_density(np.delete(every, k)) for k in every])


@pytest.mark.parametrize("kind", ["correlated", "discrepant", "both"])
def test_density_of_a_reading_given_all_others(kind):
    random = np.random.default_rng(3)
    more = {"discrepancy": Kernel(TIMES, 1.5)} if kind != "correlated" else {}
    more |= {"correlation": CORRELATION} if kind != "discrepant" else {}
    noise = noise_of(0.2 + 0.1 * random.random(7), 0.05 * np.ones(7), **more)
    observations = Observations(TIMES, random.standard_normal(7), noise, np.ones(7))
    values, rates, scale = random.standard_normal((3, 7)), random.standard_normal((3, 7)), np.array([0.7, 1.0, 1.6])
    discrepancy = np.array([[0.3, 0.4], [0.1, 1.0], [0.5, 0.2]]) if noise.discrepant else None
    predicted = Predicted(values, rates, scale, discrepancy)
    found = observations.log_conditional(predicted)
    for i in range(3):
        np.testing.assert_allclose(found[i], conditional_by_hand(observations, predicted[i]), rtol=0, atol=1e-10)


def without(problem, k):
    """The same problem without one reading."""
    o, kept = problem.observations, np.arange(len(problem.observations)) != k
    correlation = getattr(o.noise, "correlation", None)
    more = {} if correlation is None else {"correlation": correlation.matrix[np.ix_(kept, kept)]}
    if np.isfinite(o.noise.counts_within):
        more["huber"] = o.noise.counts_within
    noise = noise_of(o.std[kept], o.noise.time_std[kept], **more)
    return replace(problem, observations=Observations(o.times[kept], o.values[kept], noise, o.weights[kept]))


def refitted(problem):
    """The analysis, and the change (n, K) of its posterior mean in fits without each reading, in its std."""
    analysis = assimilate(problem, SETTINGS, 1)
    mean, std = analysis.posterior.mean(axis=0), analysis.posterior.std(axis=0, ddof=1)
    done = [
        assimilate(without(problem, k), SETTINGS, 1).posterior.mean(axis=0) for k in range(len(analysis.observations))
    ]
    return analysis, (np.stack(done, axis=1) - mean[:, None]) / std[:, None]


def test_of_a_linear_model_against_refits():
    """The tangent knows the answer, at any influence."""
    problem = make_problem(Vectorised(("a", "b", "c")), [1.0, 0.5, -0.3], k=9, seed=4)
    analysis, change = refitted(problem)
    found = analysis.influence
    assert np.all(found.how == LINEAR)
    assert np.abs(change).max() > 0.5
    np.testing.assert_allclose(found.in_std, change, rtol=0, atol=1e-6)


def test_members_that_do_not_differ_tell_nothing():
    problem = make_problem(Vectorised(("a", "b")), [1.0, 0.5])
    analysis = assimilate(problem, SETTINGS, 1)
    coordinates = analysis.posterior - analysis.centre
    coordinates[:, 1] = 0.0
    flat = ReadingTangent(np.zeros((9, 1)), np.ones((9, 1, 2)), coordinates, np.eye(2))
    found = Influence.by_tangent(problem.prior, analysis.posterior, flat)
    assert np.all(found.how == UNKNOWN)
    assert np.isnan(found.in_std).all()


def test_parts_of_readings_agree_with_all_of_them_at_once(monkeypatch):
    analysis = assimilate(make_problem(Vectorised(("a", "b")), [1.0, 0.5], k=11), SETTINGS, 1)
    monkeypatch.setattr("en4dvar.diagnosis.influence.AT_ONCE", 3 * 48)
    again = assimilate(make_problem(Vectorised(("a", "b")), [1.0, 0.5], k=11), SETTINGS, 1)
    np.testing.assert_allclose(again.influence.in_std, analysis.influence.in_std, rtol=0, atol=1e-12)


def test_weights_alone_tell_a_linear_model_roughly():
    """Pareto-smoothed, of many draws."""
    problem = make_problem(Vectorised(("a", "b")), [1.0, 0.5], k=20)
    _, change = refitted(problem)  # its means are exact with any number of members
    analysis = assimilate(problem, AssimilationSettings(members=1000), 1)
    found = Influence.by_weights(analysis.posterior, -analysis.log_likelihood)
    assert np.all(found.how == WEIGHTED)
    assert np.abs(change).max() > 0.3
    np.testing.assert_allclose(found.in_std, change, rtol=0, atol=0.07)


@pytest.mark.parametrize(
    "kind", ["decay", "huber", *(pytest.param(k, marks=pytest.mark.slow) for k in ("timed", "weighted"))]
)
def test_of_a_nonlinear_model_against_refits(kind):
    problem = make_problem(
        Decay(), [1.0, 0.8], std=0.03, k=12, scale=0.5, time_std=0.05 * (kind == "timed"),
        weights=0.5 if kind == "weighted" else 1.0,
    )  # fmt: skip
    if kind == "huber":
        values = problem.observations.values.copy()
        values[4] += 0.2
        changed = replace(problem.observations, values=values)
        problem = replace(problem, observations=with_noise(changed, huber=1.5))
    analysis, change = refitted(problem)
    found = analysis.influence
    assert not np.any(found.how == UNKNOWN)
    assert np.abs(change).max() > 0.25
    np.testing.assert_allclose(found.in_std, change, rtol=0, atol=0.15 if kind == "huber" else 0.05)
    assert np.corrcoef(found.in_std.ravel(), change.ravel())[0, 1] > 0.95


def test_of_draws_of_a_bent_posterior_against_quadrature():
    """Draws as a chain gives them, from the posterior on a fine grid; without each reading by sums over the grid."""
    problem = make_problem(Decay(), [1.0, 0.8], std=0.15, k=20, scale=0.5)
    o, prior = problem.observations, problem.prior
    grid = np.stack(np.meshgrid(np.linspace(0.0, 2.0, 161), np.linspace(-0.5, 2.5, 161)), axis=-1).reshape(-1, 2)
    a, b = grid[:, :1], grid[:, 1:]
    log_density = -0.5 * ((o.values - (a * np.exp(-b * o.times) + 0.3 * b * o.times)) / 0.15) ** 2
    joint = log_density.sum(axis=1) + prior.log_density(grid)

    def mean_and_std(log_weights):
        weights = np.exp(log_weights - log_weights.max())
        mean = weights @ grid / weights.sum()
        return mean, np.sqrt(weights @ (grid - mean) ** 2 / weights.sum()), weights / weights.sum()

    mean, std, weights = mean_and_std(joint)
    exact = np.stack([(mean_and_std(joint - log_density[:, k])[0] - mean) / std for k in range(20)], axis=1)
    chosen = np.random.default_rng(1).choice(len(grid), 2000, p=weights)
    found = Influence.by_weights(grid[chosen], -log_density[chosen])
    assert np.all(found.how == WEIGHTED)
    assert np.abs(exact).max() > 0.3
    np.testing.assert_allclose(found.in_std, exact, rtol=0, atol=0.05)
    few = Influence.by_weights(grid[chosen[:48]], -log_density[chosen[:48]])
    known = few.how == WEIGHTED
    assert known.sum() > 5
    np.testing.assert_allclose(few.in_std[:, known], exact[:, known], rtol=0, atol=0.15)


def test_with_correlated_errors_the_density_is_the_conditional_one():
    problem = make_problem(Vectorised(("a", "b")), [1.0, 0.5], k=12)
    times = problem.observations.times
    C = np.exp(-np.abs(np.subtract.outer(times, times)) / 0.3)
    problem = replace(problem, observations=with_noise(problem.observations, correlation=C))
    analysis, change = refitted(problem)
    found = analysis.influence
    by_weights = found.how == WEIGHTED
    assert by_weights.sum() >= 6
    assert not np.any(found.how == LINEAR)
    assert np.isnan(found.change[:, found.how == UNKNOWN]).all()
    np.testing.assert_allclose(found.in_std[:, by_weights], change[:, by_weights], rtol=0, atol=0.05)
    # the density given those before it alone, as stored for WAIC, would be far off
    naive = Influence.by_weights(analysis.posterior, -analysis.log_likelihood)
    assert np.nanmax(np.abs(naive.in_std - change)[:, by_weights]) > 0.15


def test_a_reading_without_weight_changes_nothing_and_sizes_are_those_of_the_parameter():
    weights = np.ones(9)
    weights[3] = 0.0
    problem = make_problem(Vectorised(("a", "b")), [1.0, 0.5], weights=weights)
    analysis = assimilate(problem, SETTINGS, 1)
    found = analysis.influence
    assert np.abs(found.change[:, 3]).max() < 1e-12
    std = analysis.posterior.std(axis=0, ddof=1)
    np.testing.assert_allclose(found.change, found.in_std * std[:, None], rtol=1e-12)


def test_without_a_density_of_single_readings_nothing_is_told():
    noise = noise_of(np.full(7, 0.2), np.zeros(7), discrepancy=Kernel(TIMES, 1.5), huber=1.5)
    observations = Observations(TIMES, np.zeros(7), noise, np.ones(7))
    predicted = Predicted(np.zeros((4, 7)), discrepancy=np.full((4, 2), 0.3))
    assert observations.log_conditional(predicted) is None


def test_distance_from_the_prior_is_in_the_std_of_both():
    predictions = np.random.default_rng(2).normal(3.0, 0.3, (4000, 1)) * np.ones(2)
    found = prior_distance(np.array([3.0, 5.5]), predictions, np.array([0.4, 0.4]))
    assert found == pytest.approx([0.0, 5.0], abs=0.15)
    assert np.isnan(prior_distance(np.zeros(2), predictions[:1], np.ones(2))).all()


def test_how_many_draws_it_takes_to_believe_a_weight():
    assert believed_shape(48) == pytest.approx(0.405, abs=1e-3)
    assert believed_shape(10_000) == 0.7
