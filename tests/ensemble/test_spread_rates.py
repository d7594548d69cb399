"""The rate that R takes from a path, beside integrals over the instants that a reading may have been taken at."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from toys import Toy, make_observations, make_problem, with_noise

from en4dvar.data.noise import Kernel
from en4dvar.ensemble.forecast import forecast
from en4dvar.model.state import DISCREPANCY
from en4dvar.priors.prior import Prior, PriorTerm

TIMES, TRUTH = np.array([0.5, 0.9, 1.0, 1.02, 1.5]), np.array([1.0, 0.0])
SPEED = 10.0


class Parabola(Toy):
    dense = True

    def curve(self, theta, t):
        return float(theta[0] * t**2 + theta[1])

    def rate(self, theta, t):
        return float(2 * theta[0] * t)


class Turn(Toy):
    """y falls, turns at t = a + b within ``lasting``, and rises."""

    dense, lasting = True, 2e-3

    def curve(self, theta, t):
        return float(SPEED * np.hypot(self.lasting, t - theta.sum()))

    def rate(self, theta, t):
        return float(SPEED**2 * (t - theta.sum()) / self.curve(theta, t))


def problem_of(model, time_std):
    made = make_problem(model, TRUTH)
    values = [model.curve(TRUTH, t) for t in TIMES]
    return replace(made, observations=make_observations(TIMES, values, std=0.01, time_std=time_std))


def rates_at(problem, theta):
    return forecast(problem, np.atleast_2d(theta)).predicted.rates


def test_of_a_parabola_it_is_exact():
    time_std = np.array([0.0, 0.01, 0.1, 0.3, 0.5])
    (rates,) = rates_at(problem_of(Parabola(), time_std), TRUTH)
    np.testing.assert_allclose(rates, np.hypot(2 * TIMES, np.sqrt(2) * time_std), rtol=1e-12)


@pytest.mark.parametrize("time_std", [0.001, 0.003])
def test_about_a_turn_it_is_the_standard_deviation_of_the_path(time_std):
    model = Turn()
    (rates,) = rates_at(problem_of(model, time_std), TRUTH)

    def moment(t, power):
        def weighed(z):
            return model.curve(TRUTH, t + time_std * z) ** power * np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)

        return quad(weighed, -9, 9, points=[(1 - t) / time_std] if abs(1 - t) < 9 * time_std else None, limit=200)[0]

    wanted = [np.sqrt(moment(t, 2) - moment(t, 1) ** 2) / time_std for t in TIMES]
    np.testing.assert_allclose(rates, wanted, rtol=0.12)


def test_a_reading_at_a_turn_makes_no_pit_in_the_cost():
    """The rate at the instant makes ln(s) fall and rise again within a tenth of the error of the instants."""
    sharp, pitted = Turn(), Turn()
    sharp.lasting = pitted.lasting = 1e-4
    pitted.dense = False
    shifts = np.stack([1.0 + np.linspace(-3e-4, 3e-4, 61), np.zeros(61)], axis=1)
    costs = []
    for model in (sharp, pitted):
        problem = problem_of(model, 0.003)
        costs.append(problem.observations.cost(forecast(problem, shifts).predicted))
    assert np.ptp(costs[1]) > 0.7
    assert np.ptp(costs[0]) < 0.1


def test_a_discrepancy_that_grows_with_the_rate_is_a_model_that_is_late():
    """By its size over that rate, to which the error of the instants adds."""
    size, beyond = 0.03, 10.0
    made = problem_of(Parabola(), 0.004)
    terms = [PriorTerm.lognormal(p, median, 1.0) for p, median in zip(DISCREPANCY, (size, 0.1), strict=True)]
    observations = with_noise(made.observations, discrepancy=Kernel(TIMES, 1.5, beyond))
    problem = replace(made, observations=observations, prior=Prior((*made.prior.terms, *terms)))
    (rates,) = rates_at(problem, [*TRUTH, np.log(size), np.log(0.1)])
    np.testing.assert_allclose(rates, np.hypot(2 * TIMES, np.sqrt(2) * np.hypot(0.004, size / beyond)), rtol=1e-12)


def test_a_model_is_not_asked_for_what_was_before_it_began():
    class Begun(Parabola):
        def trajectories(self, x, times):
            assert np.min(times) >= 0
            return super().trajectories(x, times)

    made = problem_of(Begun(), 0.3)
    times = TIMES - TIMES[0]
    observed = make_observations(times, times**2, std=0.01, time_std=0.3)
    run = forecast(replace(made, observations=observed), TRUTH[None])
    assert run.failures == ("",)
    assert 0 < run.predicted.rates[0, 0] < np.sqrt(2) * 0.3  # of δ² where δ > 0, and of zero before
