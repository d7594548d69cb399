"""Draws of a joint estimate that tell too little of where to draw next."""

from __future__ import annotations

import numpy as np
import pytest
from toys import Vectorised, make_observations

from en4dvar.estimation.joint import estimate_jointly, members, sharing
from en4dvar.estimation.joint.members import Proposal, _moments
from en4dvar.estimation.joint.problem import Single
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
    shared = estimate_jointly(joint, settings, 3, singles=singles).shared
    assert shared.std(axis=0).mean() == pytest.approx(1.0, abs=0.15)  # 12 readings leave most of 100 to the prior
