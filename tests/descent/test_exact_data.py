"""Readings far more exact than the prior: the minimum and its spread are those of the closed form all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from toys import Decay, Linear, Wave, make_problem

import en4dvar
from en4dvar.ensemble.linalg import Hessian
from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes.settings import AssimilationSettings

TRUTH = np.array([1.1, 0.6])
STDS = (1e-4, 1e-6, 1e-8, 1e-10)


def _tangent(model, at, times):
    """∂y/∂θ (K, n), by complex steps of the curve's own formula."""
    if isinstance(model, Linear):
        return np.array([[model.curve(row, t) for row in np.eye(len(at))] for t in times])
    a, b = at
    return np.stack([np.exp(-b * times), -a * times * np.exp(-b * times) + 0.3 * times], axis=1)


@pytest.mark.parametrize("std", STDS)
@pytest.mark.parametrize("model", [Linear(("a", "b")), Decay(("a", "b"))], ids=["linear", "curved"])
@pytest.mark.parametrize("linearisation", ["bundle", "transform"])
def test_the_minimum_is_that_of_least_squares(model, std, linearisation):
    """From the truth a single Gauss–Newton step in closed form, exact to second order in std, the prior beside."""
    problem = make_problem(model, TRUTH, std=std)
    analysis = assimilate(problem, AssimilationSettings(members=20, linearisation=linearisation, refine="none"), seed=2)
    times, y = problem.observations.times, problem.observations.values
    slopes = _tangent(model, TRUTH, times)
    residual = y - np.array([model.curve(TRUTH, t) for t in times])
    covariance = std**2 * np.linalg.inv(slopes.T @ slopes)
    expected = TRUTH + np.linalg.solve(slopes.T @ slopes, slopes.T @ residual)
    own = np.sqrt(np.diag(covariance))
    assert analysis.converged
    assert np.all(np.abs(analysis.posterior.mean(axis=0) - expected) < 2e-3 * own)
    np.testing.assert_allclose(analysis.posterior.std(axis=0, ddof=1), own, rtol=3e-3)
    assert not [c for c in analysis.cautions if c.severity == "serious"]


def test_the_minimum_is_found_where_the_model_misses_exact_readings():
    """A large misfit weighs what is wrong in the tangent: the members lie within the posterior, not beside it."""
    model, truth, std = Wave(), np.array([1.5, 1.2]), 1e-4
    problem = make_problem(model, truth, std=std)
    times = problem.observations.times
    y = problem.observations.values + 0.3 * np.cos(7 * times)
    problem = replace(problem, observations=replace(problem.observations, values=y))

    def residuals(x):
        curve = np.array([model.curve(x, t) for t in times])
        return np.concatenate([(curve - y) / std, problem.prior.white(x[None])[0]])

    best = least_squares(residuals, truth, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    own = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    settings = AssimilationSettings(members=20, refine="none", what_if=False, cost_tolerance=1e-14)
    analysis = assimilate(problem, settings, seed=2)
    assert analysis.converged
    assert np.all(np.abs(analysis.centre - best.x) < 0.02 * own)


def test_a_parameter_that_no_reading_sees_keeps_its_prior():
    """One reading a direction: c is not seen at all, a and b to 1e-9 of their prior."""
    problem = make_problem(Linear(("a", "b", "c")), [*TRUTH, 0.4], std=1e-9)
    data = problem.observations
    two = replace(data, times=data.times[:2], values=data.values[:2], weights=data.weights[:2], noise=replace(
        data.noise, std=data.std[:2], time_std=data.noise.time_std[:2]))  # fmt: skip
    problem = replace(problem, observations=two)
    analysis = assimilate(problem, AssimilationSettings(members=20, refine="none"), seed=2)
    prior = np.cov(analysis.prior.T)
    slopes = np.array([[problem.model.curve(row, t) for row in np.eye(3)] for t in two.times])
    hidden = np.linalg.svd(slopes)[2][-1]  # the direction that is not seen
    variance = 1 / (hidden @ np.linalg.solve(prior, hidden))
    np.testing.assert_allclose(np.cov(analysis.posterior.T), variance * np.outer(hidden, hidden), atol=1e-6 * variance)
    assert np.max(np.abs(analysis.posterior @ slopes.T - two.values)) < 1e-7


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_the_inverse_hessian_is_exact_whatever_the_readings_inform(rows):
    """A⁻¹ of an informed and an uninformed direction, in exact fractions."""
    from fractions import Fraction

    basis = np.zeros((4, 2))
    basis[0, 0] = basis[1, 1] = 1.0
    s = np.zeros((rows, 2))
    s[0] = [2.0**40, 2.0**40]  # informs the sum only
    hessian = Hessian.of(s, basis)
    g = np.array([3.0 * 2**60, 3.0 * 2**60, 0.0, 0.0])
    own, information = Fraction(3), Fraction(2) ** 81
    expected = float(Fraction(3) * 2**60 / (own + information))
    # of the sum g is 2⁶² times what the prior has, so that an error of one part in 10¹⁶ of g would be 10² of the answer
    np.testing.assert_allclose(hessian.solve(g)[:2].sum(), 2 * expected, rtol=1e-6)


def test_residuals_of_rounding_are_no_finding():
    """Readings without any error, fitted to rounding: nothing is said of how the remainders lie."""
    model = Decay(("a", "b"))
    problem = make_problem(model, TRUTH, std=1e-8, k=31)
    data = problem.observations
    exact = np.array([model.curve(TRUTH, t) for t in data.times])
    analysis = assimilate(
        replace(problem, observations=replace(data, values=exact)), AssimilationSettings(members=20), seed=2
    )
    assert [caution.code for caution in analysis.cautions] == ["overstated-error"]


@pytest.mark.parametrize("scheme", ["etkf", "enkf", "enkf-n", "es-mda"])
def test_filters_of_nearly_exact_readings_end_at_the_closed_form(scheme):
    """Readings 1e5 times as exact as the prior, which they correct: the mean was up to 150 standard deviations off."""
    times = np.linspace(0, 4, 30)
    waves = np.array([np.ones(30), times, np.cos(3 * times), times**2])
    y = 1.5 * waves.sum(axis=0) + 1e-5 * np.random.default_rng(1).standard_normal(30)
    result = en4dvar.estimate(
        lambda p, t: sum(p[name] * wave for name, wave in zip("abcd", waves, strict=True)), (times, y),
        {name: {"prior": "normal", "mean": 1, "std": 1} for name in "abcd"}, error=1e-5,
        assimilation={"scheme": scheme, "members": 60},
    )  # fmt: skip
    precision = waves @ waves.T * 1e10 + np.eye(4)
    off = [result.posterior[name].mean().item() for name in "abcd"] - np.linalg.solve(precision, waves @ y * 1e10 + 1)
    assert np.all(np.abs(off) < 1e-3 * np.sqrt(np.diag(np.linalg.inv(precision))))
    assert "misfit" not in {caution.code for caution in result.cautions}
