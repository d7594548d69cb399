"""A failed member is a value with a reason; a linear problem does not notice it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from toys import Fragile, Linear, make_problem

from en4dvar.data.noise import noise_of
from en4dvar.estimation.assimilate import assimilate, cost, forecast
from en4dvar.model.forward import Alternative, ForwardModel, Observable
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import TooFewMembersError
from en4dvar.priors.prior import PriorTerm
from en4dvar.schemes.settings import AssimilationSettings

NAMES = ("a", "b", "c")
TRUTH = (-1.0, 0.5, 0.7)  # the prior mean of a is -0.8, and the data pull it down, away from the limit
LIMIT = -0.8 + 1e-6


def settings(linearisation, **changes):
    options = {"members": 20, "start": "prior-mean", "max_iterations": 1, "min_active_fraction": 0.2}
    return AssimilationSettings(**{**options, "linearisation": linearisation, **changes})


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("value", "too stiff"),
        ("raise", "FloatingPointError: overflow"),
        ("initial_state", "ArithmeticError: no equilibrium"),
        ("short", "the model returned 0 trajectories for 1 members"),
    ],
)
def test_linear_posterior_does_not_notice_failed_members(linearisation, how, reason):
    whole = assimilate(make_problem(Linear(NAMES), TRUTH), settings(linearisation), 3)
    problem = make_problem(Fragile(LIMIT, how, names=NAMES), TRUTH)
    holed = assimilate(problem, settings(linearisation), 3)
    lost = whole.prior[:, 0] > LIMIT
    assert 5 < lost.sum() < 15
    # in the bundle variant one of the three runs of the tangent fails: the whole bundle is run instead
    assert holed.iterations[0].active == 20 - lost.sum()
    assert np.max(np.abs(holed.posterior - whole.posterior)) < 1e-10
    assert holed.iterations[-1].dfs == pytest.approx(whole.iterations[-1].dfs, abs=1e-10)
    assert [bool(f) for f in holed.prior_failures] == lost.tolist()
    assert set(holed.prior_failures) == {"", reason}
    assert np.array_equal(np.isnan(holed.prior_predictions).all(axis=1), lost)
    assert np.array_equal(np.isfinite(holed.prior_trajectories).all(axis=1), ~lost)
    assert any(f"{lost.sum()} of 20 members failed in the prior forecast: {reason}" in w for w in holed.warnings)


def test_members_that_fail_are_no_part_of_the_posterior():
    whole = assimilate(make_problem(Linear(NAMES), TRUTH), settings("bundle"), 3)
    limit = float(np.quantile(whole.posterior[:, 0], 0.8))
    found = assimilate(make_problem(Fragile(limit, names=NAMES), TRUTH), settings("bundle"), 3)
    lost = whole.posterior[:, 0] > limit
    assert [bool(reason) for reason in found.posterior_failures] == lost.tolist()
    assert np.isnan(found.posterior[lost]).all()
    np.testing.assert_allclose(found.survivors, whole.posterior[~lost], rtol=0, atol=1e-9)
    assert found.dfs_per_parameter == pytest.approx(1 - found.survivors.var(axis=0) / found.prior.var(axis=0), rel=1e-6)


def test_what_is_assumed_widens_the_members_that_are_alive():
    problem = make_problem(Fragile(-1.0, names=NAMES), TRUTH)
    problem.model.alternatives = (Alternative("scale", "the scale were off", values=1.2),)
    plain, added = (assimilate(problem, settings("bundle", what_if=what), 3) for what in (True, "added"))
    lost = np.array([bool(reason) for reason in added.posterior_failures])
    assert lost.any()
    np.testing.assert_array_equal(np.isnan(added.posterior).all(axis=1), lost)
    (shift,) = added.what_if
    wanted = np.cov(plain.survivors.T) + np.exp(-max(0.0, shift.cost_change)) * np.outer(shift.change, shift.change)
    np.testing.assert_allclose(np.cov(added.survivors.T), wanted, rtol=1e-9)


@pytest.mark.parametrize("linearisation", ["transform", "bundle"])
def test_too_few_survivors_is_an_error_with_reasons(linearisation):
    problem = make_problem(Fragile(-1.5, names=NAMES), TRUTH)
    with pytest.raises(
        TooFewMembersError, match=r"toy: \d+ of 20 members failed in the prior forecast.*too stiff \(\d+×\)"
    ):
        assimilate(problem, settings(linearisation, min_active_fraction=0.5), 4)


def test_fewer_survivors_than_parameters_is_an_error():
    problem = make_problem(Fragile(-0.8 - 1.9, names=NAMES), TRUTH)
    with pytest.raises(TooFewMembersError, match="at least 4 must survive"):
        assimilate(problem, settings("bundle", min_active_fraction=0.0), 4)


def test_prior_mean_that_fails_falls_back_to_the_best_member():
    problem = make_problem(Fragile(-0.9, names=NAMES), TRUTH)
    analysis = assimilate(problem, settings("bundle", max_iterations=20), 4)
    assert "the prior mean cannot be run (too stiff); started from the best prior member" in analysis.warnings
    assert analysis.converged


def test_trial_that_fails_is_never_accepted():
    """The minimum lies in the forbidden region: the search stops at its edge, and says so."""
    problem = make_problem(Fragile(0.9, names=NAMES), (1.0, 0.5, 0.7), std=0.01)
    for control in ("line-search", "levenberg-marquardt", "full"):
        analysis = assimilate(problem, settings("bundle", step_control=control, max_iterations=20), 4)
        assert analysis.centre[0] <= 0.9
        assert not analysis.converged
        assert analysis.stop_reason == "no decrease possible along the step"
        costs = [record.cost for record in analysis.iterations]
        assert np.all(np.diff(costs) <= 0)


def test_parameter_outside_its_bounds_fails_and_is_not_clipped():
    model = Linear(NAMES)
    bounded = Parameter("a", "m", bounds=(0.0, np.inf))
    terms = (PriorTerm.normal(bounded, 0.5, 1.0), *(PriorTerm.normal(p, 0.0, 1.0) for p in model.parameters[1:]))
    problem = make_problem(model, (1.0, 0.5, 0.7), prior=terms)
    x = np.array([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    assert forecast(problem, x).failures == ("", "a outside [0, inf] m")
    assert np.isinf(cost(problem, x)).tolist() == [False, True]


@pytest.mark.parametrize(
    ("operator", "reason"),
    [
        (lambda path: path["y"][:-1], "y (<lambda>): shape (8,) instead of shape (9,): one real number for each time"),
        (lambda path: None, "y (<lambda>): None instead of shape (9,): one real number for each time"),
        (lambda path: path["y"] * 1j, "y (<lambda>): complex numbers; give real ones"),
        (lambda path: "high", "y (<lambda>): could not convert string to float: 'high'"),
        (lambda path: np.log(-1 - path["y"] ** 2), "RuntimeWarning: invalid value encountered in log"),
        (lambda path: path["y"] * np.nan, "non-finite prediction"),
        (lambda path: path["z"], "y (<lambda>): 'z' is not in the layout; known: y, v, theta"),
    ],
)
def test_observation_operator_that_fails_is_a_failure(operator, reason):
    problem = replace(make_problem(Linear(("a", "b")), [1.0, 1.0]), observable=Observable("y", "m", operator))
    assert set(forecast(problem, problem.prior.sample(4, 0)).failures) == {reason}


@pytest.mark.parametrize(
    ("rate", "words"), [(lambda path: None, "None instead of shape (9,)"), (lambda path: path["y"] * 1j, "complex")]
)
def test_a_rate_that_is_no_row_of_numbers_is_told_as_that_of_its_observable(rate, words):
    class Read:
        def __call__(self, path):
            return path["y"]

        def rate(self, path):
            return rate(path)

    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    timed = replace(problem.observations, noise=noise_of(np.ones(9), np.ones(9)))
    problem = replace(problem, observable=Observable("y", "m", Read()), observations=timed)
    (reason,) = set(forecast(problem, problem.prior.sample(4, 0)).failures)
    assert reason.startswith("the rate of y (")
    assert "Read.rate): " in reason
    assert words in reason


@pytest.mark.parametrize("method", ["initial_state", "step"])
def test_complex_states_are_told_and_not_cut_to_their_real_parts(method, monkeypatch):
    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    monkeypatch.setattr(Linear, "trajectories", ForwardModel.trajectories)
    monkeypatch.setattr(Linear, "step", lambda self, x, t0, t1: x, raising=False)
    monkeypatch.setattr(Linear, method, lambda self, *asked: np.full(4, 1j))
    (reason,) = set(forecast(problem, problem.prior.sample(4, 0)).failures)
    assert f"{method}: complex numbers; give real ones" in reason


def test_a_mistake_in_the_code_is_told_with_its_line_and_a_failure_of_the_numbers_without():
    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    problem = replace(problem, observable=Observable("y", "m", lambda path: path.z))
    (reason,) = set(forecast(problem, problem.prior.sample(4, 0)).failures)
    assert re.fullmatch(r"AttributeError: 'Trajectory' object has no attribute 'z' \(test_failures\.py:\d+\)", reason)


def test_an_initial_state_of_a_wrong_shape_is_told_with_both_shapes(monkeypatch):
    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    monkeypatch.setattr(Linear, "initial_state", lambda self, theta: np.zeros(7))
    (reason,) = set(forecast(problem, problem.prior.sample(4, 0)).failures)
    assert re.fullmatch(r".*misshapen initial state: \(\d+, 7\), not \(\d+, 4\)", reason)


def test_non_finite_prediction_is_a_failure():
    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    with np.errstate(over="ignore"):
        run = forecast(problem, np.array([[1.0, 1.0], [1.7e308, -1.7e308]]))
    assert run.failures[0] == ""
    assert run.failures[1]
    assert run.active.tolist() == [True, False]
