"""ES-MDA. The square-root form is exactly one update for a linear model; the perturbed form is so in the mean always
and in the covariance up to the sampling error of its perturbations, which vanishes as 1/√N.
"""

from __future__ import annotations

import numpy as np
import pytest
from cut_anywhere import assert_cut_anywhere
from same_bits import assert_same_bits
from toys import Decay, Fragile, Vectorised, Wave, make_problem

from en4dvar.estimation.assimilate import assimilate, log_posterior
from en4dvar.sampling import mcmc
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.settings import AssimilationSettings

NAMES, TRUTH = ("a", "b", "c"), np.array([1.0, -0.5, 0.7])
COEFFICIENTS = [(1.0,), (4.0, 4.0, 4.0, 4.0), (9.333, 7.0, 4.0, 2.0), (1.0, 3.0)]


def run(problem, form, coefficients=(1.0, 1.0, 1.0, 1.0), *, seed=5, **changes):
    settings = AssimilationSettings(
        scheme="es-mda", mda_form=form, mda_coefficients=coefficients, **{"members": 20, **changes}
    )
    return assimilate(problem, settings, seed)


def kalman(analysis, problem):
    h = np.array([[problem.model.curve(row, t) for row in np.eye(3)] for t in problem.observations.times])
    mean, cov = analysis.prior.mean(axis=0), np.cov(analysis.prior.T)
    r = np.diag(problem.observations.std**2 / problem.observations.weights)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
    return mean + gain @ (problem.observations.values - h @ mean), (np.eye(3) - gain @ h) @ cov


def gap(actual, expected):
    return np.max(np.abs(actual - expected)) / max(1.0, np.max(np.abs(expected)))


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
@pytest.mark.parametrize("sampling", ["exact", "random"])
@pytest.mark.parametrize("weights", [1.0, 1 / 9])
def test_square_root_form_is_one_update_of_a_linear_model(coefficients, sampling, weights):
    problem = make_problem(Vectorised(NAMES), TRUTH, weights=weights)
    analysis = run(problem, "square-root", coefficients, sampling=sampling)
    mean, cov = kalman(analysis, problem)
    assert gap(analysis.posterior.mean(axis=0), mean) < 1e-12
    assert gap(analysis.centre, mean) < 1e-12
    assert gap(np.cov(analysis.posterior.T), cov) < 1e-12
    assert len(analysis.iterations) == len(coefficients) + 1
    assert analysis.stop_reason == f"{len(coefficients)} assimilation{'s' * (len(coefficients) > 1)}"


def test_perturbed_form_once_has_the_mean_of_the_kalman_update():
    problem = make_problem(Vectorised(NAMES), TRUTH)
    analysis = run(problem, "perturbed", (1.0,))
    assert gap(analysis.posterior.mean(axis=0), kalman(analysis, problem)[0]) < 1e-12


def test_perturbed_form_tends_to_one_update():
    """Errors of mean and covariance, in posterior standard deviations, fall as 1/√N."""
    problem = make_problem(Vectorised(NAMES), TRUTH)
    errors = []
    for n_members in (25, 400):
        each = []
        for seed in range(4):
            analysis = run(problem, "perturbed", members=n_members, seed=seed)
            mean, cov = kalman(analysis, problem)
            root = np.linalg.inv(np.linalg.cholesky(cov))
            whitened = root @ np.cov(analysis.posterior.T) @ root.T
            each.append(
                [np.linalg.norm(root @ (analysis.posterior.mean(axis=0) - mean)), np.linalg.norm(whitened - np.eye(3))]
            )
        errors.append(np.mean(each, axis=0))
    # a sample covariance of N members errs by √(n(n+1)/N) in this norm; the mean has less to lose
    assert np.all(errors[1] < 1.5 * np.sqrt(12 / 400))
    assert np.all(errors[0] > 2 * errors[1])  # expected 4


def test_seed_and_order():
    problem = make_problem(Decay(), [1.0, 0.8])
    one, again, other = (run(problem, "perturbed", seed=seed) for seed in (5, 5, 6))
    assert_same_bits(one, again)
    assert not np.array_equal(one.posterior, other.posterior)


def test_resumed_assimilation_has_the_same_bits():
    assert_cut_anywhere(make_problem(Wave(), [1.0, 0.8]), AssimilationSettings(scheme="es-mda", members=20), 5)


def quadrature(problem):
    """Mean and std of the posterior of two parameters, summed over a grid."""
    prior = problem.prior
    axes = [m + sd * np.linspace(-4, 4, 81) for m, sd in zip(prior.mean, prior.std, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    log = log_posterior(problem, grid)
    p = np.exp(log - log.max())
    mean = p @ grid / p.sum()
    return mean, np.sqrt(p @ (grid - mean) ** 2 / p.sum())


@pytest.mark.parametrize("form", ["perturbed", "square-root"])
def test_mild_nonlinearity(form):
    problem = make_problem(Decay(), [1.0, 0.8], scale=0.3)
    mean, std = quadrature(problem)
    analysis = run(problem, form, (8.0,) * 8, members=100)
    assert np.all(np.abs(analysis.posterior.mean(axis=0) - mean) < 0.3 * std)
    assert np.all(np.abs(analysis.posterior.std(axis=0) / std - 1) < 0.15)
    once = run(problem, form, (1.0,), members=100)  # one update is no match where the model bends
    worst = [np.max(np.abs(a.posterior.mean(axis=0) - mean) / std) for a in (analysis, once)]
    assert worst[0] < worst[1]


@pytest.mark.parametrize("form", ["perturbed", "square-root"])
def test_failed_members_follow_the_regression_on_the_survivors(form):
    """For a linear model the regression is exact, so that losing members changes nothing but rounding."""
    whole = run(make_problem(Vectorised(), [1.0, 0.5]), form, members=30)
    limit = np.sort(whole.prior[:, 0])[-4]
    problem = make_problem(Fragile(limit), [1.0, 0.5])
    analysis = run(problem, form, members=30)
    assert analysis.iterations[0].active == 27
    assert gap(analysis.posterior, whole.posterior) < 1e-11
    assert any("3 of 30 members" in warning for warning in analysis.warnings)


def test_timing_errors_enter_the_covariance():
    tight = make_problem(Decay(), [1.0, 0.8], time_std=0.0)
    loose = make_problem(Decay(), [1.0, 0.8], time_std=0.5)
    spreads = [run(p, "square-root", members=60).posterior.std(axis=0) for p in (tight, loose)]
    assert np.all(spreads[1] > 1.2 * spreads[0])


def test_coefficients_are_scaled():
    for coefficients in COEFFICIENTS:
        assert np.sum(1 / ESMDA(coefficients).inflations) == pytest.approx(1, rel=1e-15)
    for wrong in ((), (1.0, -1.0), (0.0,)):
        with pytest.raises(ValueError, match="positive"):
            ESMDA(wrong)


def test_a_chain_samples_behind_it(monkeypatch):
    """There is no minimum of J, to which draws of the chain could belong."""
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 50})
    settings = AssimilationSettings(scheme="es-mda", members=9, refine="mcmc")
    analysis = assimilate(make_problem(Decay(), [1.5, 1.2]), settings, 3)
    assert analysis.modes == ()
    assert np.isfinite(analysis.posterior).all()
