"""A scheme may run other members than those of its ensemble; the posterior forecast is of the ensemble all the same."""

from dataclasses import dataclass

import numpy as np
import pytest
from toys import Fragile, Linear, make_problem

from en4dvar.estimation.assimilate import assimilate
from en4dvar.schemes import ON_A_WINDOW
from en4dvar.schemes.base import Scheme, Step, gauss_newton
from en4dvar.schemes.settings import AssimilationSettings


@dataclass(frozen=True)
class Wide(Scheme):
    """One Gauss–Newton step from members ``size`` times as far from the iterate as those of the prior."""

    size: float = 1.0

    def members(self, weights, basis=None):
        return weights.w + self.size * np.eye(len(weights.w))

    def linearise(self, weights, runs):
        reference, anomalies = super().linearise(weights, runs)
        return reference, anomalies / self.size

    def advance(self, weights, evaluation, iteration, draw):
        step = gauss_newton(weights.w, evaluation)
        return Step(step.weights, step.norm)


def estimated(monkeypatch, model, size):
    monkeypatch.setitem(ON_A_WINDOW, "wide", Wide)
    problem = make_problem(model, [1.0, 0.5])
    settings = AssimilationSettings("wide", members=20, size=size, refine="none", what_if=False)
    return problem, assimilate(problem, settings, 1)


@pytest.mark.parametrize("size", [1.0, 0.3])
def test_what_the_posterior_predicts_is_as_wide_as_the_posterior(monkeypatch, size):
    problem, analysis = estimated(monkeypatch, Linear(), size)
    times = problem.observations.times
    jacobian = np.array([[problem.model.curve(row, t) for row in np.eye(2)] for t in times])
    covariance = np.linalg.inv(np.eye(2) + jacobian.T @ jacobian / 0.1**2)
    np.testing.assert_allclose(np.cov(analysis.posterior.T), covariance, rtol=1e-9)
    exact = np.sqrt(np.einsum("ki,ij,kj->k", jacobian, covariance, jacobian))
    np.testing.assert_allclose(analysis.posterior_predictions.std(axis=0, ddof=1), exact, rtol=1e-9)


def test_a_failed_member_takes_what_the_regression_on_those_that_were_run_gives(monkeypatch):
    """Which is exact where the model is linear."""
    _, whole = estimated(monkeypatch, Linear(), 0.3)
    _, partial = estimated(monkeypatch, Fragile(1.2), 0.3)
    assert any(partial.prior_failures)
    np.testing.assert_allclose(partial.posterior, whole.posterior, rtol=1e-9)
