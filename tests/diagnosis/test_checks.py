"""Single checks at their thresholds, and where lost members are said to lie."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from diagnosis.provoked import TWO, bounded, linear, run, waved
from toys import Fragile, Linear, Vectorised, make_problem

import en4dvar
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import off
from en4dvar.diagnosis.honesty import ControlEnsembles, examine
from en4dvar.diagnosis.honesty.checks import at_bound, loss, missed, rank, validity, where_lost
from en4dvar.diagnosis.honesty.coarse import coarse
from en4dvar.diagnosis.honesty.examine import collapse, doubts
from en4dvar.model.forward import ValidityLimit
from en4dvar.model.state import Parameter
from en4dvar.plumbing.caution import Caution, caution
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.report.result import Result
from en4dvar.results.store import StoredResult

G, R0 = Parameter("G", "Pa", bounds=(0.0, np.inf), display_unit="kPa"), Parameter("R0", "m", display_unit="um")
PRIOR = Prior((PriorTerm.lognormal(G, 1000.0, 0.5), PriorTerm.normal(R0, 1e-6, 1e-7)))


ENDED = run(linear(k=12))


def gaussian(shrunk: float = 1.0) -> tuple[Analysis, ControlEnsembles]:
    """The exact end of a linear problem with J = ½|x|², its ensemble made narrower."""
    prior = Prior(tuple(PriorTerm.normal(Parameter(name, "m"), 0.0, 1.0) for name in TWO))
    members = prior.sample(48, 3, "exact")
    posterior = shrunk * members
    last = replace(ENDED.iterations[-1], step_norm=0.0, chi2_per_observation=10.0 / 12, dfs=2.0)
    problem = replace(ENDED.problem, prior=prior)
    analysis = replace(ENDED, problem=problem, iterations=(last,), dfs_per_parameter=np.ones(2), shape={})
    return analysis, ControlEnsembles(members, posterior, np.zeros(2), 0.5 * np.sum(posterior**2, axis=1), 0.0)


def collapsed(shrunk: float = 1.0, alive: int = 48) -> list[Caution]:
    analysis, control = gaussian(shrunk)
    return list(collapse(analysis.problem.prior, control, np.arange(48) >= 48 - alive))


def test_a_gaussian_end_is_silent():
    assert examine(*gaussian()) == ()


class Writing(Vectorised):
    """Writes into what it is asked about."""

    def doubts(self, observable, times, values, predicted, members):
        for handed in (times, values, predicted, *members.values()):
            handed[:] = 0.0
        return ()


def test_a_model_that_is_asked_for_doubts_changes_no_reading():
    problem = make_problem(Writing(TWO), (1.0, 0.5))
    before = problem.observations.values.copy(), problem.observations.times.copy()
    assert doubts(problem, np.ones((4, 2)), np.ones((4, len(problem.observations)))) == []
    np.testing.assert_array_equal((problem.observations.values, problem.observations.times), before)


def test_what_the_file_makes_doubtful_is_a_warning():
    analysis, control = gaussian()
    doubt = caution("implausible-data", "the times are 1 us apart, but dt of the file is 2")
    observations = replace(analysis.problem.observations, doubts=(doubt,))
    analysis = replace(analysis, problem=replace(analysis.problem, observations=observations))
    assert examine(analysis, control) == (doubt,)


@pytest.mark.parametrize(("shrunk", "told"), [(1.5, False), (0.4, False), (0.3, True), (1e-3, True), (0.0, True)])
def test_collapse_is_a_spread_below_a_third_of_what_the_cost_allows(shrunk, told):
    found = collapsed(shrunk)
    assert [c.code for c in found] == ["ensemble-collapse"] * told
    if shrunk == 0.3:
        assert "its spread is about 0.3 of what the data and the prior allow" in found[0].words


def test_members_that_failed_do_not_count_as_spread():
    assert collapsed(alive=1) == []  # nothing to tell it from
    analysis, control = gaussian()
    found = examine(replace(analysis, posterior_failures=("gone",) * 47 + ("",)), control)
    assert "rank-deficient" in {c.code for c in found}
    assert [c.code for c in rank(PRIOR, control.prior, control.posterior[-1:])] == ["rank-deficient"]


def test_where_lost_names_the_parameters_that_tell_and_their_edges():
    x = PRIOR.sample(200, 5, "random")
    lost = (x[:, 0] > np.log(1800.0)) | (x[:, 1] < 0.85e-6)
    words = where_lost(PRIOR, x, x[:, 0] > np.log(1800.0))
    edge = float(re.fullmatch(r"lost members have G above ([\d.]+) kPa \(none of the \d+ others\)", words)[1])
    assert 1.8 <= edge < 2.1
    both = where_lost(PRIOR, x, lost)
    assert "G above" in both
    assert "R0 below" in both
    assert re.search(r"\(as \d+ of the \d+ others\)", both)


def test_where_lost_is_silent_on_what_does_not_tell():
    x = PRIOR.sample(200, 5, "random")
    some = np.random.default_rng(1).random(200) < 0.1
    assert where_lost(PRIOR, x, some) == "they are spread over the whole ensemble"


@pytest.mark.parametrize("count", [2, 4, 46, *(pytest.param(count, marks=pytest.mark.slow) for count in (3, 9, 44))])
def test_any_number_of_lost_members_is_told_from_the_others(count):
    """They are those with the largest of one parameter; as many at random are named for one in a hundred cases."""
    x = PRIOR.sample(48, 5, "random")
    lost = np.argsort(np.argsort(x[:, 0])) >= 48 - count
    words = rf"lost members have G above .* \(none of the {48 - count} others\)"
    assert re.fullmatch(words, where_lost(PRIOR, x, lost))
    random = np.random.default_rng(count)
    named = ["lost members have" in where_lost(PRIOR, x, random.permutation(lost)) for _ in range(400)]
    assert np.mean(named) <= 0.01 + 3 * np.sqrt(0.01 / 400)


def test_all_members_lost_are_spread():
    x = PRIOR.sample(12, 5, "random")
    assert where_lost(PRIOR, x, np.ones(12, dtype=bool)) == "they are spread over the whole ensemble"


def test_one_or_two_lost_members_are_described():
    x = np.array([[np.log(1000.0), 1e-6]] * 6)
    x[2] = [np.log(1000.0) + 1.5, 0.99e-6]
    lost = np.arange(6) == 2
    assert where_lost(PRIOR, x, lost) == "lost at G = 4.48 kPa (+3.0 prior std)"
    assert where_lost(PRIOR, x, np.arange(6) == 1) == "lost near the centre of the prior"


@pytest.mark.parametrize(("lost", "severity"), [(1, "caution"), (4, "caution"), (5, "serious")])
def test_a_tenth_of_the_members_lost_is_serious(lost, severity):
    (found,) = loss("prior forecast", ["gone"] * lost + [""] * (40 - lost), PRIOR)
    assert found.severity == severity
    assert found.words.startswith(f"{lost} of 40 members failed in the prior forecast: gone ({lost}×)")


@pytest.mark.parametrize("stage", ["prior forecast", "iterations"])
def test_members_lost_before_the_posterior_was_sampled_are_a_note(stage):
    (told,) = loss(stage, ["gone"] * 12 + [""] * 28, PRIOR, sampled=True)
    assert (told.severity, told.kind) == ("note", "note")
    assert "no action is needed where these values are impossible" in told.advice


def along_a_curve(p, t):
    y = p["a"] * np.exp(-p["k"] * t)
    return np.where(p["k"] * p["a"] > 1.0, np.nan, y)


def up_to_an_edge(p, t):
    y = p["a"] * np.exp(-p["k"] * t)
    return np.where(p["k"] > 0.8, np.nan, y)


def of_a_decay(function, cheap=False):
    t = np.linspace(0.5, 10, 12)
    y = np.exp(-0.6 * t) + 0.3 * np.random.default_rng(7).standard_normal(12)
    prior = {name: {"prior": "lognormal", "median": m, "log_std": 0.7} for name, m in (("a", 1), ("k", 0.5))}
    return en4dvar.estimate(function, (t, y), prior, error=0.3, cheap=cheap)


@pytest.mark.parametrize("function", [along_a_curve, up_to_an_edge])
def test_a_cut_of_the_prior_is_advised_only_where_it_takes_no_values_that_the_model_allows(function):
    (told,) = [c for c in of_a_decay(function).cautions if c.code == "members-lost" and "prior" in c.words]
    assert told.severity == "serious"
    assert "lost members have k above" in told.words
    cut = re.search(
        r"cut the prior at k = ([\d.]+), beyond which hardly any member runs \(parameters.k.upper\)", told.advice
    )
    if function is along_a_curve:
        assert "cut" not in told.advice
        assert "narrow" not in told.advice
    else:
        assert 0.75 < float(cut[1]) < 0.9
    assert "assimilation.refine: mcmc" in told.advice


def test_a_posterior_that_was_sampled_is_told_where_the_model_fails_for_a_part_of_the_prior():
    """Against 400 000 draws of the prior, weighted."""
    result = of_a_decay(along_a_curve, cheap=True)
    rng = np.random.default_rng(0)
    a, k = np.exp(0.7 * rng.standard_normal((2, 400_000, 1))) * np.array([1.0, 0.5])[:, None, None]
    t = np.linspace(0.5, 10, 12)
    y = np.exp(-0.6 * t) + 0.3 * np.random.default_rng(7).standard_normal(12)
    predicted = along_a_curve({"a": a, "k": k}, t)
    likelihood = np.nan_to_num(np.exp(-0.5 * np.sum(((y - predicted) / 0.3) ** 2, axis=1)))
    for row, values in zip(result.rows, (a[:, 0], k[:, 0]), strict=True):
        mean = np.average(values, weights=likelihood)
        std = np.sqrt(np.average((values - mean) ** 2, weights=likelihood))
        assert row.untrusted == ()
        assert row.mean == pytest.approx(mean, abs=0.15 * std)
        assert row.std == pytest.approx(std, rel=0.15)
    assert [c.severity for c in result.cautions if c.code == "members-lost"] == ["note"]


def test_lost_members_of_a_run_are_placed_in_prior_space():
    analysis = run(make_problem(Fragile(0.2, names=TWO), (-1.0, 0.5)), members=40, min_active_fraction=0.2)
    (found,) = [c for c in analysis.cautions if c.code == "members-lost"]
    edge = float(re.search(r"lost members have a above (-?[\d.]+) m \(none of", found.words)[1])
    lost = np.array([bool(reason) for reason in analysis.prior_failures])
    assert edge == pytest.approx(analysis.prior[lost, 0].min(), rel=0.01)
    assert edge > analysis.prior[~lost, 0].max()


def test_a_normal_prior_cut_by_a_bound_counts_the_members_beyond_it():
    problem = bounded(-0.3, lambda a: PriorTerm.normal(a, 0.4, 0.3), (0.0, np.inf))
    x = problem.prior.sample(48, 1, "exact")
    after = x - [0.4, 0.0]
    failures = ["" if v >= 0 else "a outside [0, inf] m" for v in after[:, 0]]
    (found,) = at_bound(problem.prior, x, after, failures)
    assert "pile up at its lower bound (0 m)" in found.words
    assert list(at_bound(problem.prior, x, x, [""] * 48)) == []


def test_an_interior_posterior_does_not_pile_up():
    inside = run(bounded(0.5, lambda a: PriorTerm.logit(a, (0.0, 1.0), 0.5, 1.0), (0.0, 1.0)))
    assert "at-bound" not in {c.code for c in inside.cautions}
    free = run(linear())
    assert free.cautions == ()


@pytest.mark.parametrize(("beyond", "told"), [(0, False), (4, False), (5, True)])
def test_a_tenth_of_the_members_may_leave_the_validity(beyond, told):
    limit = ValidityLimit("speed", 3.0, "m/s", "speed of the wall")
    reached = np.where(np.arange(40) < beyond, 3.5, 2.0)[:, None]
    since = np.where(reached > 3.0, 1.0, np.inf)
    times, leverage = np.linspace(0.0, 2.0, 9), np.full(9, 0.3)
    found = list(validity((limit,), reached, since, times, leverage))
    assert [c.code for c in found] == ["model-validity"] * told
    if told:
        assert "speed of the wall reaches 3.5 m/s (median 2), the limit is 3 m/s" in found[0].words
        assert "5 of 9 readings lie beyond, with 1.5 of 2.7 DFS" in found[0].words
        assert found[0].severity == "serious"
    assert list(validity((), np.empty((40, 0)), np.empty((40, 0)), times, leverage)) == []


@pytest.mark.parametrize("since", [1.9, 2.1])
def test_validity_is_serious_only_where_readings_beyond_it_inform(since):
    """A reading of a bubble at rest after its collapse; and none after it."""
    limit, times = ValidityLimit("speed", 3.0, "m/s"), np.linspace(0.0, 2.0, 9)
    leverage = np.append(np.full(8, 0.3), 0.02)
    (found,) = validity((limit,), np.full((40, 1), 3.5), np.full((40, 1), since), times, leverage)
    assert found.severity == "note"
    assert f"{since < 2:d} of 9 readings lie beyond, with {0.02 if since < 2 else 0:.2g} of 2.4 DFS" in found.words
    assert found.advice.startswith("no action is needed for the parameters")


def test_iterations_that_end_next_to_their_criterion_are_a_note_without_alarm():
    analysis, control = gaussian()

    def ended(step_norm: float) -> tuple[Caution, ...]:
        last = replace(analysis.iterations[-1], step_norm=step_norm)
        reason = "no decrease possible along the step"
        return examine(replace(analysis, converged=False, stop_reason=reason, iterations=(last,)), control)

    (near,), (far,), (unknown,) = ended(0.15), ended(0.6), ended(np.nan)
    assert ended(0.08) == ()  # another step would move nothing that a user sees
    assert (near.code, near.severity) == ("not-converged", "note")
    assert near.advice == f"no action is needed if this step is small enough for you; else {far.advice}"
    assert far.advice.startswith("set assimilation.refine: mcmc")  # another seed may end in the same place
    assert (far.severity, unknown.severity) == ("serious", "serious")
    assert far.advice == unknown.advice
    assert "max_iterations" not in far.advice  # there were as many as help


def test_where_members_are_drawn_from_the_posterior_itself_the_search_matters_no_more():
    analysis, control = gaussian()
    last = replace(analysis.iterations[-1], step_norm=2.0)
    drawn = {"importance_effective_sample_size": 1500.0}
    ended = replace(analysis, converged=False, iterations=(last,), refinement=drawn)
    (told,) = examine(ended, control)
    assert (told.code, told.severity, told.advice) == ("not-converged", "note", "no action is needed")


@pytest.mark.parametrize(("height", "severity"), [(3.0, "caution"), (60.0, "serious")])
def test_a_discrepancy_as_large_as_the_signal_leaves_nothing_to_quote(height, severity):
    """A wave of 3 errors, less than half of what the readings vary by, or of 60, almost all of it."""
    analysis = run(waved(height))
    (told,) = (c for c in analysis.cautions if c.code == "discrepancy-found")
    assert told.severity == severity
    assert all(
        ("discrepancy-found" in row.untrusted) == (severity == "serious")
        for row in StoredResult.from_analysis(analysis, {}).rows
    )
    assert ("check units" in told.advice) == (severity == "serious")


@pytest.mark.parametrize(("share", "severity"), [(0.09, "note"), (0.11, "caution")])
def test_a_discrepancy_on_which_no_estimate_depends_is_a_note(share, severity):
    """Of rows that say where the variance of a parameter comes from, those of the errors themselves do not count."""
    analysis = run(waved(3.0))
    shares = np.tile([1 - share, share, 0.0], (len(analysis.parameters), 1))
    shares[2:] = 0.0, 1.0, 0.0  # amplitude and length
    (told,) = missed(replace(analysis, discrepancy=replace(analysis.discrepancy, shares=shares)))
    assert told.severity == severity
    assert ("at most 9 % of the variance" in told.words) == (severity == "note")


def test_the_interval_of_a_warning_is_that_of_the_table():
    """It said 0.0784 to 0.174 where the table has 0.0764 to 0.177."""
    analysis = run(waved(3.0))
    (row,) = (row for row in Result.from_analysis(analysis, {}).rows if row.name == "discrepancy_amplitude")
    (told,) = missed(analysis)
    assert f"by {row.q05:.3g} m to {row.q95:.3g} m (standard deviation" in told.words


def test_a_discrepancy_is_measured_by_the_errors_of_the_readings_not_by_what_it_makes_of_them():
    analysis = run(waved(3.0))
    np.testing.assert_allclose(analysis.own_std, 0.05, rtol=1e-12)
    assert np.all(analysis.error_std > 0.1)
    (told,) = missed(analysis)
    assert "beside errors of 0.05 m: " in told.words
    low = np.quantile(analysis.posterior[:, 2], 0.05)
    for times, count in ((3.9, 1), (4.1, 0)):
        assert len([*missed(replace(analysis, own_std=np.full(40, times * low)))]) == count


def test_members_that_are_all_the_same_are_far_from_any_spread():
    """The inverse of the ratio, which results hold where it is larger, was a division by zero."""
    shift, ratio = off(np.full((5, 2), 3.0), np.array([1.0, 3.0]), np.array([0.5, 1.0]))
    assert shift == 4
    assert 0 < ratio < 1e-300
    assert np.isfinite(1 / ratio)


def test_turns_of_an_answer_that_is_made_of_straight_lines_are_not_called_an_error():
    """Nobody sees in predictions whether a load changed its rate or outputs are rare; more outputs tell."""

    class Loaded(Linear):
        interpolated = ("y",)

        def curve(self, theta, t):
            return theta[0] * np.interp(t, [0.0, 0.8, 1.1, 9.0], [0.0, 1.0, 0.5, 9.0])

    (told,) = coarse(run(make_problem(Loaded(("a", "b")), (1.0, 0.5), k=40, std=0.05)))
    assert told.words.startswith("the model's outputs of y seem to be about")
    assert told.advice.endswith("; if it does, its answer is made of straight lines, and nothing is wrong")
