"""A joint estimate says where its data and the prior of what is shared, or of a data set's own, conflict."""

from __future__ import annotations

import numpy as np
from toys import Vectorised, make_observations

from en4dvar.estimation.joint import JointProblem, estimate_jointly
from en4dvar.plumbing.caution import codes, untrusted
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings(what_if=False, emulator="off", refine="none")
MEAN, STD, ERROR, SETS = 0.4, 0.5, 0.1, 3
TIMES = np.linspace(0.1, 2.5, 9)
DESIGN = np.cos(TIMES[:, None] * np.arange(2) + np.arange(2) ** 2 / 3)


def campaign(shared, own, rng, group=""):
    """Three data sets of one linear model, whose truths lie so many prior standard deviations from the prior mean."""
    model = Vectorised(names=("a", "b"))
    prior = Prior(tuple(PriorTerm.normal(p, MEAN, STD) for p in model.parameters))
    problems = []
    for e in range(SETS):
        values = DESIGN @ (MEAN + STD * np.array([shared, own[e]])) + ERROR * rng.standard_normal(len(TIMES))
        data = make_observations(TIMES, values, std=ERROR, name=f"set{e}")
        problems.append(InverseProblem(model, model.observables[0], data, prior))
    return JointProblem(tuple(problems), ({"a": group},) * SETS)


def exact(joint):
    """Of a and the b of each data set, in prior standard deviations from the prior mean, by all data at once."""
    H = np.zeros((SETS * len(TIMES), 1 + SETS))
    for e in range(SETS):
        H[e * len(TIMES) : (e + 1) * len(TIMES), [0, 1 + e]] = STD / ERROR * DESIGN
    y = np.concatenate([problem.observations.values - DESIGN.sum(axis=1) * MEAN for problem in joint.experiments])
    return np.linalg.solve(np.eye(1 + SETS) + H.T @ H, H.T @ y / ERROR)


def told(joint):
    return [c for c in estimate_jointly(joint, SETTINGS, seed=1).cautions if c.code == "prior-conflict"]


def test_a_conflict_of_what_is_shared_is_told_and_no_interval_trusted():
    joint = campaign(8.0, (0.5, -0.5, 0.2), np.random.default_rng(0), group="gel")
    (conflict,) = told(joint)
    z = exact(joint)[0]
    assert conflict.words == (
        f"prior and data conflict: the minimum lies far from the prior mean (a (gel) at {MEAN + STD * z:.3g} m where "
        f"the prior says -0.1 to 0.9 m: {z:+.1f} prior standard deviations)"
    )
    assert "make the prior of a at least 4 times as wide (parameters.a)" in conflict.advice
    assert conflict.severity == "serious"
    assert untrusted((conflict,), "a") == untrusted((conflict,), "b") == ("prior-conflict",)


def test_a_conflict_of_what_a_data_set_has_of_its_own_names_the_data_set():
    joint = campaign(0.3, (0.5, -8.0, 0.2), np.random.default_rng(0))
    (conflict,) = told(joint)
    assert f"(b of set1 at {MEAN + STD * exact(joint)[2]:.3g} m where" in conflict.words
    assert "make the prior of b at least 4 times as wide (parameters.b)" in conflict.advice


def test_an_estimate_made_without_an_odd_data_set_is_examined_too():
    joint = campaign(8.0, (0.5, -0.5, 0.2), np.random.default_rng(0))
    odd = campaign(0.0, (0.5, -0.5, 0.2), np.random.default_rng(0)).experiments[0]
    estimate = estimate_jointly(JointProblem((odd, *joint.experiments[1:]), joint.groups), SETTINGS, seed=1)
    assert estimate.odd == ("set0",)
    assert "prior-conflict" in codes(estimate.rest.cautions)


def test_campaigns_drawn_from_the_prior_are_not_doubted():
    """By their quantiles a conflict is told once in 2000 campaigns at most."""
    rng = np.random.default_rng(0)
    assert not [c for _ in range(12) for c in told(campaign(rng.standard_normal(), rng.standard_normal(SETS), rng))]
