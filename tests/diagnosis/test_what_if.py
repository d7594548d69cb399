"""Where the posterior goes under an alternative: closed forms of linear models, and failures as values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from toys import Decay, Linear, Wave, make_problem, with_discrepancy, with_noise

from en4dvar.data.noise import Predicted
from en4dvar.diagnosis.response.budget import ASSUMED, budget
from en4dvar.diagnosis.response.what_if import MOST_RUNS, NOWHERE, _factors, changed_problem, prior_shift
from en4dvar.ensemble.forecast import Composite, cost
from en4dvar.estimation.assimilate import _fitted, assimilate
from en4dvar.estimation.stages import Stages
from en4dvar.estimation.summary import remarks
from en4dvar.executor import SerialExecutor
from en4dvar.model.forward import Alternative, Failure
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.report.responses import stored_shifts
from en4dvar.report.result import Result
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings(members=12)


class Offset(Linear):
    """Linear, with a term that no parameter can take up."""

    def __init__(self, size=0.0, **options):
        super().__init__(**options)
        self.size = size

    def curve(self, theta, t):
        return super().curve(theta, t) + self.size * t**2


class Fenced(Decay):
    """Larger by far, and lost nearly everywhere but at the mode."""

    def curve(self, theta, t):
        return 3.0 * super().curve(theta, t) if abs(theta[0] - 1.0) < 0.03 else np.nan


class Refuses(Linear):
    def trajectories(self, x, times):
        return [Failure("too stiff", 0.1)] * len(x)


def offering(problem, *alternatives):
    problem.model.alternatives = alternatives
    return problem


def design(model, times, names):
    """(K, n) of a linear model."""
    return np.array([[model.curve(row, t) for row in np.eye(names)] for t in times])


def posterior_mean(H, y, covariance, mean, variance):
    precision = H.T @ np.linalg.solve(covariance, H) + np.diag(1 / variance)
    right = H.T @ np.linalg.solve(covariance, y) + mean / variance
    return np.linalg.solve(precision, right)


def closed_form(problem, offset=0.0, factor=1.0, prior_shift=0.0):
    """The change of the posterior mean of the linear toy, from the normal equations alone."""
    o, prior = problem.observations, problem.prior
    H = design(Linear(prior.names), o.times, len(prior.names))
    correlation = getattr(o.noise, "correlation", None)
    C = np.eye(len(o)) if correlation is None else correlation.matrix
    R = np.outer(o.std, o.std) * C
    before = posterior_mean(H, o.values, R, prior.mean, prior.std**2)
    changed = factor * o.values - offset * o.times**2
    return posterior_mean(H, changed, factor**2 * R, prior.mean + prior_shift, prior.std**2) - before


def shift_of(problem, seed=1):
    (shift,) = assimilate(problem, SETTINGS, seed).what_if
    return shift


@pytest.mark.parametrize("correlated", [False, True])
def test_another_model_moves_a_linear_posterior_as_in_closed_form(correlated):
    problem = make_problem(Linear(("a", "b", "c")), [1.0, 0.5, -0.3])
    if correlated:
        times = problem.observations.times
        C = np.exp(-np.abs(np.subtract.outer(times, times)) / 0.4)
        problem = replace(problem, observations=with_noise(problem.observations, correlation=C))
    other = Offset(0.3, names=("a", "b", "c"))
    shift = shift_of(offering(problem, Alternative("offset", "there were drag", other)))
    expected = closed_form(problem, offset=0.3)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(shift.change, expected, rtol=0, atol=1e-10)
    assert shift.reason == ""
    assert shift.runs == 2


def test_another_scale_of_the_readings_in_closed_form():
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5])
    shift = shift_of(offering(problem, Alternative("scale", "all were larger", values=1.2)))
    np.testing.assert_allclose(shift.change, closed_form(problem, factor=1.2), rtol=0, atol=1e-10)


def test_the_centre_of_a_prior_in_closed_form_and_in_words():
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5], std=2.0)
    shift = shift_of(offering(problem, Alternative("a", "a were 50 % larger", parameters={"a": 1.5})))
    moved = np.array([0.5 * problem.prior.mean[0], 0.0])
    np.testing.assert_allclose(shift.change, closed_form(problem, prior_shift=moved), rtol=0, atol=1e-10)
    assert shift.words == "the prior said that a were 50 % larger"


def test_a_fixed_value_in_closed_form():
    whole = make_problem(Linear(("a", "b")), [1.0, 0.5])
    problem = replace(whole, prior=Prior(whole.prior.terms[:1]), fixed={"b": 0.5})
    shift = shift_of(offering(problem, Alternative("b", "b were 10 % larger", parameters={"b": 1.1})))
    H = design(Linear(("a", "b")), whole.observations.times, 2)
    precision = H[:, 0] @ H[:, 0] / 0.1**2 + 1 / problem.prior.std[0] ** 2
    np.testing.assert_allclose(shift.change, -H[:, 0] @ H[:, 1] * 0.05 / 0.1**2 / precision, rtol=0, atol=1e-10)
    assert shift.words == "b were 10 % larger"


def test_another_clock_comes_close_to_a_fit_that_is_done_again():
    problem = make_problem(Decay(), [1.0, 0.8], std=0.02, k=15)
    shift = shift_of(offering(problem, Alternative("clock", "time went slower", times=1.05)))
    o = problem.observations
    again = replace(problem, model=Decay(), observations=replace(o, times=1.05 * o.times))
    done = assimilate(again, SETTINGS, 1)
    before = assimilate(replace(problem, model=Decay()), SETTINGS, 1)
    change = done.centre - before.centre
    np.testing.assert_allclose(shift.change, change, rtol=0.05, atol=0.02 * np.abs(change).max())
    gained = done.iterations[-1].cost - before.iterations[-1].cost
    assert shift.cost_change == pytest.approx(gained, abs=0.05)


@pytest.mark.parametrize("alternative", [Alternative("far", "…", values=-3.0), Alternative("slow", "…", times=1.7)])
def test_what_is_beyond_linear_response_is_fitted_again(alternative):
    """Beside a minimiser of its own on J of the changed problem."""
    problem = make_problem(Decay(), [1.0, 0.8], std=0.02, k=15)
    problem = offering(problem, alternative)
    analysis = assimilate(problem, replace(SETTINGS, sampling="exact"), 1)
    (shift,) = analysis.what_if
    assert shift.runs > MOST_RUNS
    changed = changed_problem(problem, alternative)
    start = problem.prior.from_physical(analysis.centre)
    done = minimize(lambda x: cost(changed, x[None])[0], start, method="Nelder-Mead", options={"xatol": 1e-7})
    std = problem.prior.from_physical(analysis.posterior).std(axis=0, ddof=1)
    np.testing.assert_allclose(start + shift.in_std * std, done.x, rtol=0, atol=0.05 * std.max())
    assert np.abs(shift.in_std).max() > 3


@pytest.mark.parametrize("held", [False, True])
def test_readings_on_another_scale_and_clock_have_the_same_errors_and_discrepancy_there(held):
    """J of predictions on these scales is what it was: the covariance is that of the file's readings."""
    problem = with_discrepancy(make_problem(Wave(), [1.0, 3.0], k=12, time_std=0.02), grows_beyond=2.0)
    names = [p.name for p in problem.discrepancy]
    if held:
        terms = tuple(term for term in problem.prior.terms if term.parameter.name not in names)
        problem = replace(problem, prior=Prior(terms), fixed=dict(zip(names, (0.2, 0.6), strict=True)))
    size, clock = 1.3, 1.7
    alternative = Alternative("scales", "…", values=size, times=clock)
    changed = changed_problem(problem, alternative)
    random = np.random.default_rng(4)
    rates, of_process = random.normal(0, 3, 12), np.array([0.2, 0.6])
    at = Predicted(random.normal(0, 1, 12), rates, None, of_process)
    there = Predicted(size * at.values, size / clock * rates, None, of_process * [size, clock])
    before, after = problem.observations, changed.observations
    assert after.cost(there) == pytest.approx(float(before.cost(at)), rel=1e-9)
    scales = dict(zip(names, (size, clock), strict=True))
    if held:
        assert {name: changed.fixed[name] / problem.fixed[name] for name in names} == pytest.approx(scales)
    else:
        shift = dict(
            zip(problem.prior.names, prior_shift(problem, tuple(_factors(problem, alternative).items())), strict=True)
        )
        assert {name: np.exp(shift.pop(name)) for name in names} == pytest.approx(scales)
        assert not any(shift.values())


def test_it_is_fitted_again_from_the_mode_where_a_search_from_the_prior_ends_elsewhere():
    prior = tuple(PriorTerm.normal(p, mean, 1.0) for p, mean in zip(Wave().parameters, (1.0, 0.5), strict=True))
    problem = make_problem(Wave(), [1.0, 3.0], std=0.02, k=25, prior=prior)
    settings = AssimilationSettings(members=12, start="prior-mean", starts=1, refine="none")
    missed = assimilate(problem, replace(settings, what_if=False), 1).iterations[-1].cost
    at = problem.prior.from_physical(np.array([1.0, 3.0]))
    found = _fitted(Stages(problem, settings, 1, SerialExecutor(), None, None), at, 50.0, problem)
    assert found.cost < cost(problem, at[None])[0] < missed - 50
    np.testing.assert_allclose(problem.prior.to_physical(found.centre), [1.0, 3.0], rtol=0.02)


@pytest.mark.parametrize("off", [0.06, 0.1, 0.3])
def test_a_large_discrepancy_is_no_excuse_for_what_is_missed_at_the_mode(off):
    """A descent of all parameters from there ends with an amplitude above 0.5; the readings' errors are 0.01."""
    prior = tuple(PriorTerm.normal(p, mean, 1.0) for p, mean in zip(Wave().parameters, (1.0, 2.0), strict=True))
    problem = make_problem(Wave(), [1.0, 3.0], std=0.01, k=60, prior=prior)
    problem = with_discrepancy(problem, amplitude=(0.02, 2.0), length=(0.2, 0.7))
    true, beside = (problem.prior.from_physical(np.array([1.0, b, 0.001, 0.2])) for b in (3.0, 3.0 + off))
    settings = AssimilationSettings(members=12, start="prior-mean", starts=1, refine="none")
    found = _fitted(Stages(problem, settings, 1, SerialExecutor(), None, None), beside, 1e9, problem)
    assert found.cost < cost(problem, true[None])[0] < cost(problem, beside[None])[0] - 1000
    np.testing.assert_allclose(problem.prior.to_physical(found.centre)[:2], [1.0, 3.0], rtol=0.01)


class Torn(Linear):
    """A smooth part that vanishes at a = 0, and a rough one that vanishes at a = 1."""

    def curve(self, theta, t):
        return float(theta[0] * np.cos(2 * t) + 0.15 * (theta[0] - 1) * np.sin(40 * t))


def test_where_held_errors_lead_to_one_place_a_descent_that_holds_nothing_starts_at_the_mode():
    """A discrepancy of the size that is held cannot excuse the smooth part, a larger one does."""
    problem = make_problem(
        Torn(("a",)), [1.0], std=0.1, k=60, prior=(PriorTerm.normal(Torn(("a",)).parameters[0], 0.5, 1.0),)
    )
    o = problem.observations
    problem = replace(problem, observations=replace(o, values=o.values - np.cos(2 * o.times)))
    problem = with_discrepancy(problem, amplitude=(0.02, 2.0), length=(0.6, 0.4))
    at = problem.prior.from_physical(np.array([1.0, 0.02, 0.6]))
    settings = AssimilationSettings(members=12, start="prior-mean", starts=1, refine="none")
    found = _fitted(Stages(problem, settings, 1, SerialExecutor(), None, None), at, 0.0, problem)
    done = minimize(lambda x: cost(problem, x[None])[0], problem.prior.from_physical(np.array([1.0, 1.0, 0.6])))
    assert found.cost == pytest.approx(done.fun, abs=0.01)
    np.testing.assert_allclose(found.centre[0], done.x[0], rtol=0, atol=0.02)


def test_parameters_of_errors_alone_are_fitted_again_without_being_held():
    problem = with_discrepancy(make_problem(Linear(("a",)), [1.0]))
    a, *errors = problem.prior.terms
    problem = replace(problem, prior=Prior(tuple(errors)), fixed={a.parameter.name: 1.0})
    settings = AssimilationSettings(members=12, refine="none")
    found = _fitted(Stages(problem, settings, 1, SerialExecutor(), None, None), problem.prior.mean, 1e9, problem)
    assert np.isfinite(found.cost)
    assert found.cost < cost(problem, problem.prior.mean[None])[0]


def test_relative_changes_are_of_what_cannot_be_negative():
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5])
    a = replace(problem.prior.parameters[0], bounds=(0.0, np.inf))
    terms = (PriorTerm.lognormal(a, 1.0, 0.5), problem.prior.terms[1])
    shift = shift_of(offering(replace(problem, prior=Prior(terms)), Alternative("scale", "…", values=1.01)))
    assert shift.relative[0] == pytest.approx(0.01, rel=0.2)
    assert np.isnan(shift.relative[1])


def test_what_cannot_be_run_or_told_has_a_reason_and_stands_before_what_is_small():
    problem = make_problem(Decay(), [1.0, 0.8], std=0.01, k=15)
    problem = offering(
        problem,
        Alternative("small", "little changed", values=1.001),
        Alternative("stiff", "it were stiff", Refuses()),
        Alternative("far", "a were tripled", Fenced()),
        Alternative("odd", "it had other parameters", Linear(("c",))),
    )
    analysis = assimilate(problem, SETTINGS, 1)
    reasons = {shift.name: shift.reason for shift in analysis.what_if}
    assert reasons["stiff"] == "cannot be run: too stiff"
    assert reasons["far"] == NOWHERE
    assert reasons["odd"].startswith("cannot be run")
    assert reasons["small"] == ""
    assert analysis.what_if[-1].name == "small"
    assert all(np.isnan(shift.change).all() for shift in analysis.what_if[:-1])
    assert all(shift.runs <= MOST_RUNS for shift in analysis.what_if if shift.name != "far")
    assert any("only a fit with it shows the change" in line for line in remarks(analysis))


def test_the_posterior_is_the_same_and_its_runs_are_counted():
    plain = make_problem(Linear(("a", "b")), [1.0, 0.5])
    first = assimilate(plain, SETTINGS, 3)
    other = offering(make_problem(Linear(("a", "b")), [1.0, 0.5]), Alternative("offset", "…", Offset(0.5)))
    second = assimilate(other, SETTINGS, 3)
    assert np.array_equal(first.posterior, second.posterior)
    assert second.forward_runs == first.forward_runs + second.what_if[0].runs
    assert first.what_if == ()
    assert assimilate(other, replace(SETTINGS, what_if=False), 3).what_if == ()
    (line,) = remarks(second)
    assert line.startswith("what if …: ")
    assert "std)" in line
    far = offering(plain, Alternative("offset", "…", Offset(5.0)))
    (words, *_) = remarks(assimilate(far, SETTINGS, 3))
    assert f"the readings exclude it: χ² is {chi2_with(far):.0f} for 9 readings" in words


def chi2_with(problem):
    """χ² of the readings at the mode of the only alternative of a linear problem."""
    (alternative,) = problem.model.alternatives
    changed = changed_problem(problem, alternative)
    mode = problem.prior.from_physical(assimilate(replace(problem, model=Linear(("a", "b"))), SETTINGS, 3).centre)
    shift = shift_of(problem, 3)
    predicted = Composite(changed, SerialExecutor())((mode + shift.change)[None]).predicted[0]
    return 2 * float(changed.observations.cost(predicted))


def test_what_the_prior_speaks_against_is_not_excluded_by_the_readings():
    """A scale that is 30 % off, with a and b known to 0.05: χ² is 8 of 9 readings, and 107 was told."""
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5], scale=0.05, std=0.02)
    offering(problem, Alternative("scale", "the scale were off", values=1.3))
    a = assimilate(problem, SETTINGS, 3)
    assert chi2_with(problem) < 9 < 100 < 2 * a.what_if[0].cost_change
    assert a.fit[0] * 9 + 2 * a.what_if[0].misfit_change == pytest.approx(chi2_with(problem), rel=1e-6)
    assert "exclude" not in " ".join(remarks(a))
    rows = [row[0] for row in stored_shifts(Result.from_analysis(a, {}))]
    assert [(row.excluded, row.exceeds) for row in rows] == [("", True)]


def test_the_shifts_are_added_to_the_covariance_and_the_mean_stays():
    """Two assumptions of a linear problem, known in closed form; the data speak against the second."""
    problem = make_problem(Linear(("a", "b")), [1.0, 0.5])
    offering(problem, Alternative("scale", "…", values=1.2), Alternative("offset", "…", Offset(0.3, names=("a", "b"))))
    plain, added = (assimilate(problem, replace(SETTINGS, what_if=what), 1) for what in (True, "added"))
    by_name = {shift.name: shift for shift in added.what_if}
    parts = np.array([by_name[name].change for name in ("scale", "offset")])
    likely = np.exp([-max(0.0, by_name[name].cost_change) for name in ("scale", "offset")])
    assert min(likely) < 0.9
    wanted = np.cov(plain.posterior.T) + np.einsum("k,ki,kj->ij", likely, parts, parts)
    np.testing.assert_allclose(np.cov(added.posterior.T), wanted, rtol=1e-9)
    np.testing.assert_allclose(added.posterior.mean(axis=0), plain.posterior.mean(axis=0), rtol=0, atol=1e-12)
    plain_parts, added_parts = budget(plain, "a"), budget(added, "a")
    assert sum(added_parts.values()) == pytest.approx(1.0)
    share = 1 - np.var(plain.posterior[:, 0]) / np.var(added.posterior[:, 0])
    assert added_parts[ASSUMED] == pytest.approx(share)
    assert added_parts["b"] == pytest.approx((1 - share) * plain_parts["b"])
