"""Advice that is followed to the letter helps: the warning is gone, or says something else; none returns unchanged."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from diagnosis.provoked import (
    PROVOKED,
    TWO,
    Signless,
    bent,
    chain_not_converged,
    linear,
    near_zero,
    ramp,
    replace_std,
    run,
    turned,
    waved,
    waving,
)
from diagnosis.provoked_by_several import OF_SEVERAL
from estimation.test_agreement import joint
from estimation.test_lost_frame import problem as filmed
from toys import Vectorised, Wave, make_observations, make_problem, with_discrepancy, with_noise

import en4dvar
from en4dvar.data.extrema import maxima
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.honesty.advice import ADVICE, Case, advised
from en4dvar.estimation import conclusions
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Alternative, ValidityLimit
from en4dvar.model.state import Field, Parameter
from en4dvar.plumbing.caution import CATALOGUE, Caution, caution
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying import StateChanges
from en4dvar.problem import InverseProblem
from en4dvar.sampling import mcmc
from en4dvar.schemes.settings import AssimilationSettings

NOTHING = "no action is needed"
SMOOTHNESS = {"matern-3/2": 1.5, "matern-5/2": 2.5}
OF_EVERYBODY = ("members", "sampling", "min_active_fraction", "refine", "draws", "emulator")


def settings_of(a: Analysis, **changes: object) -> AssimilationSettings:
    held = {name: getattr(a.settings, name) for name in OF_EVERYBODY}
    if (scheme := changes.pop("scheme", a.settings.scheme)) == a.settings.scheme:
        held |= {f.name: getattr(a.settings.own, f.name) for f in fields(a.settings.own)}
    return AssimilationSettings(str(scheme), **{**held, **changes})  # type: ignore[arg-type]


def number(text: str) -> object:
    return int(text) if text.isdigit() else text


def read(problem: InverseProblem, **changes: object) -> InverseProblem:
    return replace(problem, observations=replace(problem.observations, **changes))


def stated(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    std = np.full(len(p.observations), float(said[1]))
    return read(p, noise=replace(p.observations.noise, std=std))


def deduced(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    size = float(np.median(p.observations.std))
    return with_discrepancy(p, amplitude=(size, 1.5), length=(0.2, 0.7))


def other_kernel(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    noise = p.observations.noise
    return read(p, noise=replace(noise, kernel=replace(noise.kernel, smoothness=SMOOTHNESS[said[1]])))


def growing(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    noise = p.observations.noise
    return read(p, noise=replace(noise, kernel=replace(noise.kernel, grows_beyond=1.0)))


def timed(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    return read(p, noise=replace(p.observations.noise, time_std=np.full(len(p.observations), float(said[1]))))


def shorter(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    y = p.observations
    kept = y.times < float(said[1]) + 1e-3  # the number is rounded
    return replace(p, observations=make_observations(y.times[kept], y.values[kept], y.std[kept]))


def wider(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    wide = said[1].split(" and ")
    terms = (replace(t, std=int(said[2]) * t.std) if t.parameter.name in wide else t for t in p.prior.terms)
    return replace(p, prior=Prior(tuple(terms)))


def fixed(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    terms = tuple(t for t in p.prior.terms if t.parameter.name != said[1])
    return replace(p, prior=Prior(terms), fixed={**p.fixed, said[1]: 0.5})


def robust(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    return replace(p, observations=with_noise(p.observations, huber=1.345))


def equal(p: InverseProblem, said: re.Match[str]) -> InverseProblem:
    return read(p, weights=np.ones(len(p.observations)))


Follow = Callable[[InverseProblem, "re.Match[str]"], InverseProblem]
SAID: dict[str, Follow] = {
    r"state an error of about ([\d.e+-]+) m ": stated,
    r"check the unit of data\.error: .* scatter by ([\d.e+-]+) m": stated,
    r"data\.error\.discrepancy: estimated": deduced,
    r"data\.error\.discrepancy\.kernel: (matern-\d/2)": other_kernel,
    r"data\.error\.discrepancy\.grows_beyond": growing,
    r"the times err by about ([\d.e+-]+) s \(data\.error\.time_std": timed,
    r"data\.error\.robust: huber": robust,
    r"data\.window: \{to: ([\d.]+) s\}": shorter,
    r"the prior of ([\w ]+) about (\d+) times as wide": wider,
    r"fix it \(parameters\.(\w+): a value\)": fixed,
    r"assimilation\.weights: sum": equal,
}
"""What an advice says, and what somebody does who follows it."""


def follow(a: Analysis, c: Caution, other: InverseProblem | None) -> Analysis:
    """The same again with what the advice names changed; ``other``: what it leaves to judgement (bounds, a model)."""
    asked = {key: number(value) for key, value in re.findall(r"assimilation\.(\w+): ([\w-]+)", c.advice)}
    asked.pop("weights", None)
    problem = a.problem
    for pattern, act in SAID.items():
        if said := re.search(pattern, c.advice):
            problem = act(problem, said)
            break
    else:
        if not asked:
            assert other is not None, f"nothing to follow in: {c.advice}"
            problem = other
    return assimilate(problem, settings_of(a, **asked), 1)


def told(a: Any, code: str) -> Caution | None:
    return next((c for c in a.cautions if c.code == code), None)


def positive() -> InverseProblem:
    return make_problem(Signless(("a",)), (1.0,), prior=(PriorTerm.lognormal(Parameter("a", "m"), 1.0, 0.5),))


def in_bounds() -> InverseProblem:
    model = Vectorised(TWO)
    terms = (
        PriorTerm.logit(model.parameters[0], (-2.0, 4.0), 0.5, 1.5),
        PriorTerm.normal(model.parameters[1], 0.5, 1.0),
    )
    return make_problem(model, (1.6, 0.5), prior=terms)


def narrow() -> InverseProblem:
    model = Vectorised(TWO)
    terms = (PriorTerm.normal(p, v, 0.1) for p, v in zip(model.parameters, (-1.0, 0.5), strict=True))
    return make_problem(model, (-1.0, 0.5), prior=tuple(terms))


LEFT_TO_JUDGEMENT: dict[str, Callable[[], InverseProblem]] = {
    "implausible-data": linear,  # the units were wrong
    "future-missed": lambda: turned(20),
    "missed-knots": lambda: ramp((2.0,)),
    "coarse-outputs": lambda: make_problem(Vectorised(TWO), (1.0, 1.5), k=40, std=0.04),  # a model with more of them
    "lost-frame": filmed,  # the times were corrected
    "model-validity": linear,  # a model without that limit
    "members-lost": narrow,
    "readings-missing": linear,  # a model that gives them
    "residual-structure": lambda: make_problem(Vectorised(TWO), (1.0, 0.5), k=40, std=0.05),  # a model with the wave
    "at-bound": in_bounds,
    "other-assumption": lambda: waving(0.6),
    "upper-limit": lambda: near_zero(1.0),  # a larger value, or better readings
    "several-modes": positive,
    "discrepancy-found": lambda: with_discrepancy(  # a model that has the wave
        make_problem(Vectorised(TWO), (1.0, 0.5), k=40, std=0.05), amplitude=(0.025, 1.5), length=(0.2, 0.7)
    ),
}


LONG = ("non-gaussian", "several-modes", "members-lost")  # a chain is run, or it takes two seconds


@pytest.mark.parametrize("code", [pytest.param(c, marks=[pytest.mark.slow] * (c in LONG)) for c in PROVOKED])
def test_advice_that_is_followed_helps(code):
    a = PROVOKED[code]()
    for _ in range(6):
        c = told(a, code)
        if c is None or NOTHING in c.advice:
            return
        other = LEFT_TO_JUDGEMENT[code]() if code in LEFT_TO_JUDGEMENT else None
        a = follow(a, c, other)
        after = told(a, code)
        assert after is None or after.advice != c.advice, f"comes back unchanged: {c.advice}"
    pytest.fail(f"{code} is still there after six advices, the last of them: {c.advice}")


@pytest.mark.parametrize("code", OF_SEVERAL)
def test_advice_about_several_data_sets_that_is_followed_helps(code):
    provoking, following = OF_SEVERAL[code]
    problems = provoking()
    c = told(joint(problems), code)
    assert c is not None
    assert told(joint(following(problems, c)), code) is None


def test_the_advice_about_a_chain_is_another_one_the_second_time(monkeypatch):
    monkeypatch.setattr(mcmc.sample, "__kwdefaults__", {**mcmc.sample.__kwdefaults__, "max_steps": 60})
    a = chain_not_converged()
    c = told(a, "chain-not-converged")
    after = told(follow(a, c, None), "chain-not-converged")
    assert after is None or after.advice != c.advice


def test_an_error_in_the_wrong_unit_is_told_as_such():
    """Of 1.4 mm for a radius of 150 µm: no discrepancy is offered, and no probability of runs that is no finding."""
    problem = replace_std(bent(), 500.0)
    a = run(problem)
    advices = {c.code: c.advice for c in a.cautions}
    assert advices["overstated-error"].startswith("check the unit of data.error: 5e+02 m is stated")
    assert not any("discrepancy" in advice for advice in advices.values())
    again = follow(a, told(a, "overstated-error"), None)
    assert "unit" not in " ".join(c.advice for c in again.cautions)
    in_mm = run(replace(problem, observations=replace(problem.observations, error_unit="mm")))
    assert "check the unit of data.error: 5e+05 mm is stated" in told(in_mm, "overstated-error").advice


@pytest.mark.parametrize("std", [0.02, 0.1, 0.15])
@pytest.mark.parametrize("scale", [(0.02, 1.0), (0.02, 0.02), (0.1, 0.02)], ids=str)
def test_a_prior_that_is_widened_as_advised_contradicts_the_data_no_more(std, scale):
    """Also where they know little: the wider the prior, the farther off they lead."""
    model = Vectorised(TWO)
    terms = [PriorTerm.normal(p, mean, s) for p, mean, s in zip(model.parameters, (-1.0, 2.0), scale, strict=True)]
    a = run(make_problem(model, (1.0, 0.5), k=9, std=std, prior=tuple(terms)))
    c = told(a, "prior-conflict")
    assert c is not None
    assert told(follow(a, c, None), "prior-conflict") is None, c.advice


def test_an_assumption_for_which_the_readings_speak_is_told_with_the_option_that_makes_it():
    c = told(run(waving()), "other-assumption")
    assert re.match(r"the readings speak for another assumption: J would be lower by \d+ if there were a wave", c.words)
    assert c.advice == "run with --set model.height='0.6 m', and compare both (en4dvar compare)"
    assert told(run(waving(0.6)), "other-assumption") is None


class Late(Vectorised):
    """Grows out of its validity after about half of its readings."""

    validity = (ValidityLimit("y", 1.2, "m", "largest excursion", "a test"),)


def test_a_window_that_ends_before_the_model_leaves_its_validity_is_named():
    problem = make_problem(Late(TWO), (1.0, -0.6), std=0.01, k=18)
    a = run(problem)
    c = told(a, "model-validity")
    to = float(re.search(r"data\.window: \{to: ([\d.]+) s\}", c.advice)[1])
    assert problem.observations.times[0] < to < problem.observations.times[-1]
    assert told(follow(a, c, None), "model-validity") is None


def test_members_that_failed_leave_the_window_in_which_the_model_is_valid():
    """Of a failed member it is not known when it leaves; the advice said that no reading comes before."""
    problem = make_problem(Late(TWO), (1.0, -0.6), std=0.01, k=18)
    a, c = run(problem), told(run(problem), "model-validity")
    failures, beyond = ("lost", *a.posterior_failures[1:]), np.vstack([np.full((1, 1), np.nan), a.beyond[1:]])
    case = Case(replace(a, posterior_failures=failures, beyond=beyond), c, frozenset({c.code}))
    assert ADVICE["model-validity"](case) == c.advice


def test_the_error_that_is_advised_is_as_sharp_as_the_readings_tell_it():
    """Of 5000 readings it advised to state 0.1 m where 0.1 m was stated."""
    a = run(replace_std(make_problem(Vectorised(TWO), (1.0, 0.5), k=5000, std=0.104), 0.1))
    c = told(a, "misfit")
    assert told(follow(a, c, None), "misfit") is None


def test_a_window_is_ended_on_the_clock_of_the_data():
    problem = make_problem(Late(TWO), (1.0, -0.6), std=0.01, k=18)
    ends = [
        float(re.search(r"to: ([\d.]+) s\}", told(run(read(problem, zero=zero)), "model-validity").advice)[1])
        for zero in (0.0, 100.0)
    ]
    assert ends[1] == pytest.approx(ends[0] + 100.0, abs=1e-3)


def test_what_is_set_already_is_not_advised():
    """The size of errors that is estimated beside a discrepancy."""
    scaled = run(with_discrepancy(bent(), sigma=0.5, amplitude=(0.05, 1.0), length=(0.3, 0.7)))
    assert "parameters.sigma" not in " ".join(c.advice for c in scaled.cautions)


class Assuming(Vectorised):
    """Can say what would be if its first parameter were larger."""

    alternatives = (Alternative("a", "a were 10 % larger", parameters={"a": 1.1}),)


def test_a_table_that_is_not_there_is_asked_for_and_one_that_cannot_be_is_not_named():
    problem = waved(3.0)
    assert "what-if" not in told(run(problem), "discrepancy-found").advice
    assuming = replace(problem, model=Assuming(TWO))
    asked = told(run(assuming, what_if=False), "discrepancy-found").advice
    assert "ask for the what-if table (--set assimilation.what_if=true) and compare other models" in asked
    there = run(assuming, what_if=True)
    assert there.what_if
    assert "look at the what-if table and compare other models" in told(there, "discrepancy-found").advice


@pytest.mark.slow
def test_what_the_model_says_may_change_is_let_change_where_a_long_window_shows_a_discrepancy():
    """A window with one maximum behind the first minimum, or several; or in which it changes already."""
    problem = waved(3.0)
    problem.model.unforeseen = {"y": 0.01}
    asked = "let y change on the way (--set model_error.y='{at: maxima, std: 1 %}') and compare other models"
    y, t = problem.observations.values, problem.observations.times
    for frequency, count in ((6, 1), (12, 4)):
        bouncing = read(problem, values=y + 0.15 * (np.sin(frequency * t) - np.sin(5 * t)))
        assert len(maxima(bouncing.observations.values)) == count
        assert (asked in told(run(bouncing), "discrepancy-found").advice) == (count > 1)
    changes = StateChanges.of(problem.model, Field("y"), [float(t[20])], 0.01, relative=True)
    assert "model_error" not in told(run(bouncing.varied([changes])), "discrepancy-found").advice


def late(kind: str, seed: int) -> InverseProblem:
    """Readings of a wave by a clock that errs by 0.02 s: from reading to reading, or slowly; or beside another wave."""
    random, k = np.random.default_rng(seed), 50
    p = make_problem(Wave(), (1.0, 2.0), k=k, std=0.02, time_std=0.001, scale=0.3)
    t, phase = p.observations.times, random.uniform(0, 6)
    by = {"each": 0.02 * random.standard_normal(k), "slowly": 0.028 * np.sin(3 * t + phase)}.get(kind, np.zeros(k))
    values = np.array([p.model.curve(np.array([1.0, 2.0]), time) for time in t + by])
    values += 0.02 * random.standard_normal(k) + 0.08 * (kind == "another") * np.sin(5 * t + phase)
    wide = {"amplitude": (0.02, 1.5), "length": (0.2, 0.7)}
    return with_discrepancy(read(p, values=values), **wide, smoothness=1.5, sigma=0.4, grows_beyond=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(2), range(2, 12)])
def test_errors_of_the_times_are_told_from_what_the_model_misses(seeds):
    """Both are largest where the observable changes fast; a model that errs does so alike at neighbours."""
    told_by = [run(late("each", seed)) for seed in seeds]
    sizes = [a.timing for a in told_by if a.timing]
    assert len(sizes) >= len(seeds) // 2
    assert np.all(np.abs(np.log(np.array(sizes) / 0.02)) < 0.5)
    for a in told_by:
        of_residuals = [c for c in a.cautions if c.code in ("misfit", "odd-residuals", "discrepancy-found")]
        assert all("data.error.time_std; 0.001 s is stated" in c.advice for c in of_residuals if a.timing)
        assert all("data.error.time_std" in c.advice for c in of_residuals)
        for c in of_residuals[: 1 if a.timing else 0]:
            again = told(follow(a, c, None), c.code)
            assert again is None or again.advice != c.advice


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["slowly", "another"])
@pytest.mark.parametrize("seeds", [range(2), range(2, 8)])
def test_no_errors_of_the_times_are_seen_in_what_the_model_misses(kind, seeds):
    assert [run(late(kind, seed)).timing for seed in seeds] == [0.0] * len(seeds)


@pytest.mark.parametrize(("stated", "first"), [(0.0, "how uncertain the times are with"), (1e-3, "a larger")])
def test_readings_that_were_smoothed_are_thought_of(stated, first):
    """A mean over five frames errs like one reading whose instant has the std of five instants about their middle."""
    a = run(make_problem(Wave(), (1.0, 2.0), k=50, std=0.02, time_std=stated))
    fast = caution("odd-residuals", "the residuals are larger where the observable changes fast")
    (it,) = advised(replace(a, timing=0.0), [fast])
    assert it.advice.startswith(
        f"state {first} data.error.time_std (140 % of step where a reading is the mean of five)"
    )
    np.testing.assert_allclose(np.std(np.arange(5)), 1.4, rtol=0.02)


def test_a_wrong_reading_is_no_error_of_the_times():
    """It may lie where the observable changes fast; the readings that it leaves say nothing of the times."""
    p = make_problem(Wave(), (1.0, 2.0), k=50, std=0.02, time_std=0.001, scale=0.3)
    right = np.array([p.model.curve(np.array([1.0, 2.0]), time) for time in p.observations.times])
    fastest = int(np.argmax(np.abs(np.gradient(right))))
    for seed in range(4):
        values = right + 0.02 * np.random.default_rng(seed).standard_normal(50)
        values[fastest] += 0.02 * 12
        analysis = run(read(p, values=values))
        assert told(analysis, "odd-residuals") is not None
        assert analysis.timing == 0.0


def test_wrong_readings_beside_a_discrepancy_may_count_less():
    """Its advice was to delete one line after another; a robust cost stands beside a discrepancy, not a correlation."""
    p = make_problem(Wave(), (1.0, 2.0), k=50, std=0.02, scale=0.3)
    values = np.array([p.model.curve(np.array([1.0, 2.0]), time) for time in p.observations.times])
    values += 0.02 * np.random.default_rng(0).standard_normal(50)
    values[[12, 30]] += [0.5, -0.4]
    p = read(p, values=values)
    correlated = replace(p, observations=with_noise(p.observations, correlation=np.eye(50)))
    for problem, less in ((with_discrepancy(p, amplitude=(0.02, 1.5), length=(0.2, 0.7)), True), (correlated, False)):
        advice = [c.advice for c in run(problem).cautions if c.words.startswith("the reading at")]
        assert ["data.error.robust: huber such readings count less" in it for it in advice] == [less]


@pytest.mark.slow
def test_errors_of_the_times_that_are_stated_too_large_are_named():
    """Of a clock that keeps time; an exposure is asked for where nothing is said of times."""
    p = make_problem(Wave(), (1.0, 2.0), k=80, std=0.002, time_std=0.1)
    p = with_discrepancy(p, amplitude=(0.02, 1.5), length=(0.2, 0.7), sigma=0.4)
    c = told(run(p), "prior-conflict")
    assert "data.error.time_std='3 ns'" in c.advice
    assert "--exposure" not in c.advice
    assert told(run(read(p, noise=replace(p.observations.noise, time_std=np.zeros(80)))), "prior-conflict") is None
    plain = replace_std(with_discrepancy(make_problem(Wave(), (1.0, 2.0), k=80, std=0.002), sigma=0.4), 0.05)
    assert "give its --exposure" in told(run(plain), "prior-conflict").advice


@pytest.mark.slow
@pytest.mark.parametrize("stated", [0.1, 0.3])
def test_no_warning_asks_for_larger_errors_of_the_times_beside_one_that_asks_for_smaller_ones(stated):
    """A wave that the model misses, read by a clock that keeps time better than is stated."""
    p = make_problem(Wave(), (1.0, 2.0), k=80, std=0.002, time_std=stated)
    values = p.observations.values + 0.02 * np.sin(5 * p.observations.times)
    wide = {"amplitude": (0.02, 1.5), "length": (0.2, 0.7), "smoothness": 1.5}
    a = run(with_discrepancy(read(p, values=values), **wide, sigma=0.4))
    assert "put its jitter there" in told(a, "prior-conflict").advice
    assert told(a, "discrepancy-found").advice.endswith("a model with the missing physics removes this warning")
    assert not any("larger data.error.time_std" in c.advice for c in a.cautions)


@pytest.mark.slow
def test_errors_of_the_times_that_explain_the_residuals_are_not_said_to_be_stated_too_large(monkeypatch):
    monkeypatch.setattr(conclusions, "timing_of", lambda *_: 0.5)
    p = make_problem(Wave(), (1.0, 2.0), k=80, std=0.002, time_std=0.1)
    a = run(with_discrepancy(p, amplitude=(0.02, 1.5), length=(0.2, 0.7), sigma=0.4))
    assert "put its jitter there" not in told(a, "prior-conflict").advice


def test_a_future_that_is_missed_is_taken_in_up_to_the_next_trough():
    problem = turned(10)
    assert "data.window.to:" not in told(run(problem), "future-missed").advice
    problem = read(problem, next_end="trough 3")
    assert "one minimum at a time (data.window.to: trough 3)" in told(run(problem), "future-missed").advice
    problem.model.unforeseen = {"y": 0.01}
    asked = "(data.window.to: trough 3), with what may change on the way (model_error: {y: {at: maxima, std: 1 %}})"
    assert asked in told(run(problem), "future-missed").advice


def test_every_code_of_the_catalogue_is_followed_somewhere():
    assert set(CATALOGUE) == {*PROVOKED, *OF_SEVERAL, "chain-not-converged"}


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_of_series_in_different_units_a_factor_of_their_errors_is_advised(factor):
    """An error of the median of both, 10 m of 0.02 m and 20 W, was said to be stated."""
    times, rng = np.linspace(0.5, 8, 16), np.random.default_rng(1)
    head, power = (1.1 * np.exp(-0.3 * times) + factor * 0.02 * rng.standard_normal(16) for _ in range(2))
    found = en4dvar.estimate(
        lambda p, t: {"head": p["h"] * np.exp(-p["k"] * t), "power": 1000 * p["h"] * np.exp(-p["k"] * t)},
        {"head": (times, head), "power": (times, 1000 * power)},
        {"h": {"prior": "normal", "mean": "1 m", "std": "0.2 m"}, "k": "0.3 1/s"},
        error={"head": "0.02 m", "power": "20 W"}, units={"h": "m", "k": "1/s", "head": "m", "power": "W", "time": "s"},
        progress=False,
    )  # fmt: skip
    (told,) = (c for c in found.cautions if c.code in ("misfit", "overstated-error"))
    advised = re.search(r"state errors about ([\d.]+) times as large", told.advice)
    assert float(advised[1]) == pytest.approx(factor, rel=0.3)
    assert "is stated" not in told.advice
    assert f"warning: {told.words}; {told.advice} [{told.code}]" in str(found).splitlines()
