"""Whitening with state-dependent variance: gradient and Fisher information against the cost itself."""

from dataclasses import replace

import numpy as np
import pytest
from toys import Decay, Linear, Wave, make_observations, make_problem

from en4dvar.data.noise import Linearisation, Predicted
from en4dvar.ensemble.forecast import check_problem
from en4dvar.ensemble.linalg import anomaly_basis, centre
from en4dvar.estimation.assimilate import cost, forecast, log_posterior
from en4dvar.model.forward import Observable, StateField
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes.base import Evaluation, Runs, Weights, gauss_newton
from en4dvar.schemes.en4dvar import En4DVar


@pytest.mark.parametrize("model", [Decay(), Wave()])
@pytest.mark.parametrize("time_std", [0.0, 0.05, np.linspace(0, 0.2, 9)])
@pytest.mark.parametrize("weights", [1.0, np.linspace(0, 2, 9)])
def test_gradient_of_the_scheme_is_the_gradient_of_j(model, time_std, weights):
    problem = make_problem(model, [1.5, 1.2], time_std=time_std, weights=weights)
    members = problem.prior.sample(10, 3, "random")
    mean, anomalies = centre(members)
    basis = anomaly_basis(anomalies)
    w = basis @ np.array([0.05, -0.11])

    def j(weights):
        run = forecast(problem, mean + weights @ anomalies)
        return 4.5 * np.sum(weights**2, axis=1) + problem.observations.cost(run.predicted)

    # a centred bundle: the mean of two one-sided gradients has an O(ε²) error
    gradients = []
    for epsilon in (1e-5, -1e-5):
        scheme = En4DVar("bundle", epsilon)
        state = Weights(w, np.eye(10))
        run = forecast(problem, mean + np.vstack([scheme.members(state), w]) @ anomalies)
        stacked = run.predicted.stacked
        reference, y = scheme.linearise(state, Runs(stacked[:-1], stacked[-1], run.active[:-1], basis))
        at = Linearisation.of_stacked(run.predicted[0], reference, y)
        gradients.append(gauss_newton(w, Evaluation(*problem.observations.whiten(at), basis)).gradient)
    gradient = np.mean(gradients, axis=0)
    h = 2e-5
    numeric = np.array([np.diff(j(np.stack([w - h * e, w + h * e])))[0] for e in np.eye(10)]) / (2 * h)
    assert np.linalg.norm(numeric) > 1
    assert np.linalg.norm(gradient - numeric) < 1e-6 * np.linalg.norm(numeric)


def test_augmented_arrays_carry_the_fisher_information():
    """SᵀS is the expectation of the Hessian of J_o over data drawn at the centre (Monte Carlo over y)."""
    observations = make_observations([1.0, 2.0, 3.0], np.zeros(3), std=0.3, time_std=0.2)
    slope, rate_slope, rate = np.array([0.7, -0.4, 1.0]), np.array([1.5, 0.8, -1.2]), np.array([1.0, 2.0, -1.5])
    s = observations.noise.error_std(Predicted(np.zeros(3), rate))
    draws = s * np.random.default_rng(0).standard_normal((40000, 3))

    def j(a):
        return observations.cost(Predicted(a * slope - draws, rate + a * rate_slope))

    h = 1e-3
    hessian = np.mean(j(h) - 2 * j(0.0) + j(-h)) / h**2
    _, sensitivity = observations.whiten(Linearisation(Predicted(np.zeros(3), rate), slope[None], rate_slope[None]))
    assert hessian == pytest.approx((sensitivity.T @ sensitivity).item(), rel=0.02)


def test_log_likelihood_is_a_density_of_the_observation():
    observations = make_observations([1.0, 2.0, 3.0], np.zeros(3), std=[0.1, 0.2, 0.3], time_std=[0.0, 0.1, 0.2])
    grid = np.linspace(-6, 6, 4001)
    predictions = np.tile(grid[:, None], 3)
    density = np.exp(observations.log_likelihood(Predicted(predictions, np.full_like(predictions, 2.0))))
    assert density.sum(axis=0) * (grid[1] - grid[0]) == pytest.approx(np.ones(3), abs=1e-12)
    assert (density * grid[:, None] ** 2).sum(axis=0) * (grid[1] - grid[0]) == pytest.approx([0.01, 0.08, 0.25])


def test_cost_is_minus_log_posterior_up_to_a_constant():
    problem = make_problem(Decay(), [1.5, 1.2], time_std=0.05)
    x = problem.prior.sample(7, 1)
    run = forecast(problem, x)
    full = problem.prior.log_density(x) + problem.observations.log_likelihood(run.predicted).sum(axis=1)
    assert np.ptp(full + cost(problem, x)) < 1e-11
    assert np.array_equal(log_posterior(problem, x), -cost(problem, x))
    constant = problem.prior.log_density(problem.prior.mean) - 9 * np.log(0.1 * np.sqrt(2 * np.pi))
    assert (full + cost(problem, x))[0] == pytest.approx(constant)


def test_cost_of_an_impossible_member_is_infinite_alone():
    problem = make_problem(Decay(), [1.5, 1.2])
    x = np.array([[1.0, 1.0], [np.nan, 1.0], [1e200, 1.0]])
    assert np.isposinf(cost(problem, x)).tolist() == [False, True, True]


def test_extra_times_come_from_the_same_run():
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5])
    times = problem.observations.times
    extra = np.linspace(times[0], times[-1], 17)
    x = problem.prior.sample(4, 0)
    run = forecast(problem, x, extra_times=extra)
    assert np.array_equal(run.predictions, forecast(problem, x).predictions)
    expected = [[problem.model.curve(row, t) for t in extra] for row in x]
    assert np.max(np.abs(run.path - expected)) < 1e-12


def test_incomplete_problems_are_refused():
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5])
    for changes, message in (
        ({"model": Linear(("a", "b", "c"))}, "c: neither fixed nor estimated"),
        ({"fixed": {"b": 1.0}}, "b: both fixed and estimated"),
        ({"fixed": {"zeta": 1.0}}, "zeta: not a parameter of the model"),
        (
            {
                "observable": Observable("y", "m", lambda path: path["y"]),
                "observations": make_observations([1, 2, 3], [1, 2, 3], time_std=0.1),
            },
            "needs the rate of y",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            check_problem(replace(problem, **changes))


def test_rate_that_the_field_lacks_is_refused():
    observable = Observable("y", "m", StateField("y"))
    problem = replace(make_problem(Linear(("a", "b")), [1.0, 0.5], time_std=0.1), observable=observable)
    with pytest.raises(ConfigError, match="a timing error needs the rate of y, which the model does not provide"):
        check_problem(problem)

    class Own(StateField):
        def rate(self, trajectory):
            return 0 * trajectory["y"]

    check_problem(replace(problem, observable=Observable("y", "m", Own("y"))))
