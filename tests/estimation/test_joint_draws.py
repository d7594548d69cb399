"""Draws of a joint estimate that tell too little of where to draw next."""

from __future__ import annotations

import numpy as np
import pytest
from toys import Vectorised, make_observations

from en4dvar.estimation.joint import estimate_jointly, members, sharing
from en4dvar.estimation.joint.descent import Experiment, JointDescent, JointObjective, Place
from en4dvar.estimation.joint.members import Proposal, _moments
from en4dvar.estimation.joint.problem import Single
from en4dvar.executor import SerialExecutor
from en4dvar.model.forward import Batch
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("quantities", [1, 3, 20, 30])
def test_draws_of_which_only_one_counts_still_say_where_to_draw(quantities):
    stream = np.random.default_rng(1)
    points, log_weights = stream.standard_normal((96, quantities)), np.full(96, -1e6)
    log_weights[7] = 0.0
    mean, covariance = _moments(points, log_weights)
    assert Proposal(mean, np.linalg.inv(covariance)).log_density(points).min() > -100 * quantities
    assert _moments(points[:1], log_weights[:1]) is None


@pytest.mark.filterwarnings("error")
def test_more_shared_quantities_than_draws_are_drawn_about_the_minimum(monkeypatch):
    monkeypatch.setattr(members, "ROUNDS", 2)
    names, times = tuple(f"p{i}" for i in range(101)), np.linspace(0.1, 2.0, 6)
    model = Vectorised(names=names, compiled=True)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    readings = np.random.default_rng(1).standard_normal((2, 6))
    data = [make_observations(times, y, std=0.3, name=f"{e}") for e, y in enumerate(readings)]
    joint = sharing([InverseProblem(model, model.observables[0], each, prior) for each in data], names[:100])
    singles = [Single(np.zeros(101), np.eye(101)) for _ in data]
    settings = AssimilationSettings(what_if=False, emulator="off", members=110)
    told = list[str]()
    found = estimate_jointly(joint, settings, 3, singles=singles, tell=told.append)
    assert told[0].startswith("cost: members of 2 data sets are drawn by about 14000 forward runs, beside some ")
    assert found.shared.std(axis=0).mean() == pytest.approx(1.0, abs=0.15)  # 12 readings leave most of 100 to the prior
    of_one = np.array([model.curve(row, times[:, None]) for row in np.eye(101)]).reshape(101, 6).T
    design = np.hstack([np.tile(of_one[:, :100], (2, 1)), np.kron(np.eye(2), of_one[:, 100:])])
    weighed = np.linalg.solve(0.3**2 * np.eye(12) + design @ design.T, readings.ravel())
    np.testing.assert_allclose(found.shared_mode, design[:, :100].T @ weighed, rtol=0, atol=1e-9)
    assert found.costs[-1] == pytest.approx(0.5 * readings.ravel() @ weighed, rel=1e-9)


class Flat(Vectorised):
    """Readings a, (u + 2)² − 9 and 10^5 w⁵ of four w: Gauss–Newton shortens each w by a fifth a step."""

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1])).astype(int)
        values = np.hstack([x[:, 2:3], (x[:, 3:4] + 2) ** 2 - 9, 1e5 * x[:, 4:] ** 5])
        states = np.zeros((*own.shape, x.shape[1]))
        states[..., 0], states[..., 2:] = np.take_along_axis(values, own, axis=1), x[:, None, 2:]
        return Batch(own, states, self.layout)


@pytest.mark.parametrize("seed", range(4))
def test_a_lower_minimum_of_an_experiment_that_is_slow_to_reach_is_met(seed):
    """u = −5 explains the readings as u = 1 does, which the prior prefers by 12 in J."""
    model = Flat(names=("a", "u", "w1", "w2", "w3", "w4"), compiled=True)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    data = [make_observations(np.arange(6), np.zeros(6), std=0.02, name=f"{e}") for e in range(2)]
    joint = sharing([InverseProblem(model, model.observables[0], each, prior) for each in data], ("a",))
    experiments = [Experiment(joint, e, 1e-3, SerialExecutor()) for e in range(2)]
    descent = JointDescent(Place(np.zeros(1), (np.array([-5.0, 0, 0, 0, 0]),) * 2))
    JointObjective(joint, experiments, AssimilationSettings().own.minimiser).linearise([descent])
    assert descent.at.cost == pytest.approx(25)  # J_b of −5 in both; their readings are met
    assert experiments[0].costs(np.array([[0.3, 1.5, 0, 0, 0, 0]])) == pytest.approx(0.5 * (0.3**2 + 3.25**2) / 0.02**2)
    lower = members.challenger(experiments, descent.at, seed)
    np.testing.assert_allclose([own[0] for own in lower.own], 1.0, atol=0.05)
