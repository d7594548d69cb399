"""A model whose predictions jump by its solver's error: the descent ends where that of the exact model does."""

from __future__ import annotations

import numpy as np
import pytest
from cut_anywhere import assert_cut_anywhere
from toys import Decay, Toy, make_problem

from en4dvar.descent.weight_space import WeightSpace
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.priors.prior import PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.base import Runs, Weights
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.schemes.settings import AssimilationSettings

STD, JUMP, CELL = 0.05, 1e-4, 1e-3  # of the readings; of the predictions, 1e-4 of their size; in a parameter
TRUTHS = np.random.default_rng(4).normal([1.2, 1.0], 0.2, (14, 2))


class Jumpy(Decay):
    """Between jumps the error is constant, as that of adaptive time steps."""

    def curve(self, theta, t):
        cell = np.floor(np.asarray(theta) / CELL)
        return super().curve(theta, t) + JUMP * float(np.sin(1e3 * cell @ [1.0, 7.0] + 50 * t))


class Kink(Toy):
    """y = a + |b − 1| t: readings that are lower than any b explains put the minimum of J at a kink."""

    def curve(self, theta, t):
        a, b = theta
        return float(a + abs(b - 1.0) * t)

    def rate(self, theta, t):
        return float(abs(theta[1] - 1.0))


def experiment(model: Toy, i: int) -> InverseProblem:
    terms = tuple(PriorTerm.lognormal(p, m, 0.3) for p, m in zip(model.parameters, (1.2, 1.0), strict=True))
    problem = make_problem(Decay(), TRUTHS[i], prior=terms, seed=i, std=STD)
    return InverseProblem(model, problem.observable, problem.observations, problem.prior)


@pytest.mark.slow
def test_solver_noise_is_no_lack_of_convergence_and_no_wrong_spread():
    settings = AssimilationSettings(members=12)
    told, shifts, ratios = [], [], []
    for i in range(len(TRUTHS)):
        noisy, exact = (assimilate(experiment(model, i), settings, i) for model in (Jumpy(), Decay()))
        told += [c for c in noisy.cautions if c.code == "not-converged"]
        x, y = (np.log(a.posterior) for a in (noisy, exact))
        shifts.append(np.max(np.abs(np.log(noisy.centre / exact.centre)) / y.std(axis=0)))
        ratios.append(np.max(np.abs(np.log(x.std(axis=0) / y.std(axis=0)))))
    assert told == []
    assert max(shifts) < 0.2
    assert np.quantile(ratios, 0.8) < 0.1


def test_a_wide_bundle_is_resumed():
    assert_cut_anywhere(experiment(Jumpy(), 0), AssimilationSettings(members=12), 0, cuts=8)


def test_a_kink_is_still_told():
    model = Kink()
    prior = (PriorTerm.normal(model.parameters[0], 1.0, 0.01), PriorTerm.normal(model.parameters[1], 1.1, 0.2))
    problem = make_problem(model, (1.0, 1.0), prior=prior)
    problem.observations.values[:] -= 0.1 * problem.observations.times
    analysis = assimilate(problem, AssimilationSettings(members=12), 1)
    assert analysis.centre[1] == pytest.approx(1.0, abs=0.02)
    assert [c.severity for c in analysis.cautions if c.code == "not-converged"] == ["serious"]


@pytest.mark.parametrize("members", [12, 4])
def test_a_wide_bundle_is_two_sided_where_that_takes_fewer_runs(members):
    """Central differences know no second derivative; with too few members it is one-sided and knows it."""
    problem = experiment(Decay(), 0)
    space = WeightSpace(problem, AssimilationSettings(members=members), 1, SerialExecutor())
    scheme, weights = En4DVar(), Weights(np.zeros(members), np.eye(members))

    def tangent(wider: float):
        at = Weights(weights.w, weights.T, wider=wider)
        rows = scheme.members(at, space.basis)
        run = space.forecast(space.control(np.vstack([rows, at.w])))
        predictions, central = run.predictions[:-1], run.predictions[-1]
        return len(rows), scheme.linearise(at, Runs(predictions, central, np.ones(len(rows), bool), space.basis))[1]

    runs, narrow = tangent(1e-3)
    wide_runs, wide = tangent(25.0)
    assert (runs, wide_runs) == (2, 4 if members == 12 else 2)
    error = np.abs(wide - narrow).max() / np.abs(narrow).max()
    assert error < 2e-4 if members == 12 else 1e-3 < error < 0.05
