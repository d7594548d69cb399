"""Joint estimates test themselves: each data set against all others, against estimates made again without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import Vectorised, make_observations

from en4dvar.data.series import Part, Places
from en4dvar.estimation.joint import estimate_jointly, sharing
from en4dvar.estimation.joint.agreement import DIFFER, trends
from en4dvar.estimation.joint.members import sampled
from en4dvar.plumbing.caution import codes
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings(what_if=False, emulator="off", refine="none")
ERROR = 0.1


def campaign(shifts, seed=0, std=ERROR, names=("a", "b")):
    """Lines y = a + b t, of which ``a`` is 0.5 and so much more, and ``b`` is each data set's own."""
    rng, model = np.random.default_rng(seed), Vectorised(names=names)
    prior = Prior(tuple(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters))
    problems = []
    for e, shift in enumerate(shifts):
        times = np.sort(rng.uniform(0.1, 2.5, 8 + e % 4))
        truth = np.array([0.5 + shift, *rng.standard_normal(len(names) - 1)])
        j = np.arange(len(names))
        values = np.cos(times[:, None] * j + j**2 / 3) @ truth + ERROR * rng.standard_normal(len(times))
        data = make_observations(times, values, std=std, name=f"set{e}")
        problems.append(InverseProblem(model, model.observables[0], data, prior))
    return problems


def joint(problems):
    return estimate_jointly(sharing(problems, ["a"]), SETTINGS, seed=1)


def test_the_distance_is_that_of_an_estimate_made_without_the_data_set():
    problems = campaign([0.0] * 6)
    whole = joint(problems).agreement
    for e in (0, 3, 5):
        rest = joint([p for i, p in enumerate(problems) if i != e])
        alone = joint([problems[e], replace(flat(problems[e]))])
        value, variance = (np.array([f(one.shared[:, 0]) for one in (alone, rest)]) for f in (np.mean, variance_of))
        precision = 1 / variance[0] - 1  # without the prior, N(0, 1)
        own = value[0] / variance[0] / precision
        expected = (own - value[1]) ** 2 / (1 / precision + variance[1])
        assert whole.squares[e] == pytest.approx(expected, rel=1e-6)


def variance_of(members):
    return np.var(members, ddof=1)


def flat(problem):
    """Readings at the same times that say nothing."""
    o = problem.observations
    return replace(
        problem, observations=replace(o, values=o.values + 1e5, noise=replace(o.noise, std=1e7 + o.std), name="flat")
    )


def test_an_odd_data_set_is_named_and_the_estimate_made_without_it():
    problems = campaign([0.0] * 7 + [0.6, 0.0])
    with_it, rest = joint(problems), joint([p for p in problems if p.observations.name != "set7"])
    assert with_it.odd == ("set7",)
    assert with_it.without is not None
    np.testing.assert_allclose(with_it.without.shared_mode, rest.shared_mode, rtol=0, atol=1e-10)
    (told,) = [c for c in with_it.cautions if c.code == "odd-data-set"]
    assert told.severity == "serious"
    assert "set7 (χ²" in told.words
    assert told.words.endswith("the shared values quoted first are those without it")
    assert not rest.odd
    assert "odd-data-set" not in codes(rest.cautions)


def test_members_are_drawn_once_of_what_is_quoted(monkeypatch):
    """With an odd data set, whose values have no interval, it took as long as without it, and often far longer."""
    drawn = []

    def spied(experiments, *how):
        drawn.append([each.problem.observations.name for each in experiments])
        return sampled(experiments, *how)

    monkeypatch.setattr("en4dvar.estimation.joint.estimate.sampled", spied)
    problems = campaign([0.0] * 7 + [0.6, 0.0])
    problems[0].model.compiled = True  # the model of all
    result = estimate_jointly(sharing(problems, ["a"]), replace(SETTINGS, refine="auto"), seed=1)
    assert result.odd == ("set7",)
    assert drawn == [[f"set{e}" for e in (0, 1, 2, 3, 4, 5, 6, 8)]]
    estimate_jointly(sharing(problems[:7], ["a"]), replace(SETTINGS, refine="auto"), seed=1)
    assert drawn[1:] == [[f"set{e}" for e in range(7)]]


def test_the_others_of_an_odd_data_set_are_judged_without_it():
    """Four lines of one value fit well; with a fifth, 20 of its errors off, none does."""
    problems = campaign([0.0] * 4 + [2.0])
    with_it, rest = joint(problems), joint(problems[:4])
    assert 0.2 < rest.chi2.max() < 2
    np.testing.assert_allclose(with_it.chi2[:4], rest.chi2, rtol=1e-6)
    assert codes(with_it.cautions) == ("odd-data-set", *codes(rest.cautions))
    conflict = joint(campaign([8.0] * 4 + [0.0]))
    told = [c for c in conflict.cautions if c.code == "prior-conflict"]
    assert [c.words[:14] for c in told] == ["without set4: "]


@pytest.mark.slow
def test_clean_campaigns_name_none_and_their_squares_follow_chi_squared():
    found = [joint(campaign([0.0] * 5, seed)) for seed in range(12)]
    agreed = [one.agreement for one in found]
    squares = np.concatenate([a.squares for a in agreed])
    assert sum(bool(one.odd) for one in found) <= 1  # of one in a hundred
    assert squares.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / len(squares)))
    assert sum(a.chance < DIFFER for a in agreed) <= 1


def test_data_sets_that_all_differ_are_not_odd_but_differ():
    rng = np.random.default_rng(5)
    found = joint(campaign(0.5 * rng.standard_normal(10)))
    assert not found.odd
    assert "data-sets-differ" in codes(found.cautions)
    assert found.agreement.scatter > 2


def test_a_misfit_under_the_shared_value_is_told():
    found = joint(campaign([0.0] * 4, std=ERROR / 3))
    (told,) = [c for c in found.cautions if c.code == "misfit"]
    assert "χ² per reading" in told.words


def test_nothing_is_compared_where_nothing_is_told():
    """A data set whose readings say nothing of what is shared, and one that has it alone."""
    problems = campaign([0.0] * 3)
    found = joint([*problems, flat(problems[0])])
    assert np.isnan(found.agreement.squares[3])
    assert np.isnan(found.agreement.chances[3])
    assert np.isfinite(found.agreement.squares[:3]).all()


def test_a_trend_with_the_order_is_told():
    problems = campaign(np.linspace(0, 1, 8))
    (told,) = [c for c in joint(problems).cautions if c.code == "trend"]
    assert "rises with the order of the data sets" in told.words


@pytest.mark.slow
def test_data_sets_that_say_less_and_less_are_no_trend():
    """Alone, they end nearer and nearer to their prior, which is 5 of its standard deviations away."""
    found = []
    for seed in range(5):
        problems = campaign([4.5] * 9, seed)
        for e, problem in enumerate(problems):
            o = problem.observations
            rng, more = np.random.default_rng([seed, e]), ERROR * 1.5**e
            values = o.values + np.sqrt(more**2 - ERROR**2) * rng.standard_normal(len(o.values))
            noise = replace(o.noise, std=o.std * more / ERROR)
            problems[e] = replace(problem, observations=replace(o, values=values, noise=noise))
        found += [c for c in joint(problems).cautions if c.code == "trend"]
    assert len(found) <= 1  # of one in a hundred


def test_trends_by_chance_are_rare():
    rng, problems = np.random.default_rng(3), campaign([0.0] * 8)
    told = [list(trends(problems, rng.standard_normal((8, 2)), ["a", "b"])) for _ in range(100)]
    assert sum(map(bool, told)) <= 4  # of one in a hundred


def test_a_trend_is_one_with_readings_that_count():
    """Of weight 0 one is the larger, the larger the value; and a field that is read at one instant has no steps."""
    values, problems = np.array([[3.0], [1], [7], [5], [2], [8], [4], [6]]), campaign([0.0] * 8)
    for e, (value,) in enumerate(values):
        o = problems[e].observations
        far = replace(o, values=np.append(1e3 * value, o.values[1:]), weights=np.append(0.0, o.weights[1:]))
        problems[e] = replace(problems[e], observations=far)
    assert not list(trends(problems, values, ["a"]))
    at_once = Part("a", problems[0].observable, 0, 2, Places.at_indices([0, 1]))
    o = replace(make_observations([1.0, 2.0], [0.0, 1.0]), times=np.ones(2), parts=(at_once,))
    assert not list(trends([*problems[:-1], replace(problems[-1], observations=o)], values, ["a"]))
