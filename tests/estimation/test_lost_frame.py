"""A frame that was lost, or counted twice: J of all times from some reading on moved, by a minimiser of scipy."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares
from toys import OBSERVABLE, Toy, make_observations, with_discrepancy

from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.honesty.advice import advised
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.lost_frame import _discrepant
from en4dvar.model.forward import Batch
from en4dvar.plumbing.caution import caution, untrusted
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.runs.finished import carried
from en4dvar.schemes.settings import AssimilationSettings

INTERVAL, STD, K, LOST = 0.25, 0.03, 18, 10
MEAN, SPREAD = np.array([1.1, 1.4]), np.array([0.3, 0.2])  # of the prior
SETTINGS = AssimilationSettings(members=12)


class Tone(Toy):
    """y = a cos(b t)."""

    def trajectories(self, x, times):
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        a, b = x[:, 2:3], x[:, 3:4]
        theta = np.broadcast_to(x[:, None, 2:], (*own.shape, 2))
        states = np.stack([a * np.cos(b * own), -a * b * np.sin(b * own)], axis=-1)
        return Batch(own, np.concatenate([states, theta], -1), self.layout)

    def initial_state(self, theta):
        return np.array([theta["a"], 0.0, theta["a"], theta["b"]])


def problem(moved: float = 0.0, cheap: bool = True, lost: int = LOST) -> InverseProblem:
    """Readings of a = 1, b = 1.5; those from ``lost`` on were made ``moved`` intervals later than their times say."""
    model, times = Tone(compiled=cheap), INTERVAL * np.arange(1, K + 1)
    made = times + moved * INTERVAL * (np.arange(K) >= lost)
    values = np.cos(1.5 * made) + STD * np.random.default_rng(4).standard_normal(K)
    terms = map(PriorTerm.normal, model.parameters, MEAN, SPREAD)
    return InverseProblem(model, OBSERVABLE, make_observations(times, values, STD), Prior(tuple(terms)))


@cache
def outcome(moved: float, lost: int = LOST) -> Analysis:
    return assimilate(problem(moved, lost=lost), SETTINGS, 1)


def unasked(moved: float) -> Analysis:
    """Where nobody asks for a lost frame."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("en4dvar.estimation.assimilate.lost_frame", lambda *asked: ())
        return assimilate(problem(moved), SETTINGS, 1)


def said(a: Analysis) -> list[str]:
    return [c.words for c in a.cautions if c.code == "lost-frame"]


def lowest(of: InverseProblem, by: float, k: int) -> float:
    """J at its minimum where the times from reading k on are ``by`` later, from where the truth is."""
    t, y = of.observations.times + by * (np.arange(K) >= k), of.observations.values

    def residuals(x):
        return np.concatenate([(y - x[0] * np.cos(x[1] * t)) / STD, (x - MEAN) / SPREAD])

    return min(least_squares(residuals, start).cost for start in ([1.0, 1.5], [0.9, 1.6], [0.9, 1.4]))


@pytest.mark.parametrize(
    ("moved", "tried", "which"), [(1.0, 1.0, "early, as if a frame was lost"), (-1.0, -0.9, "late, as if")]
)
def test_the_reading_and_the_ratio_are_those_of_another_minimiser(moved, tried, which):
    of = problem(moved)
    all_costs = np.array([lowest(of, tried * INTERVAL, k) for k in range(1, K)])
    costs = all_costs[np.abs(np.arange(K - 1) - np.argmin(all_costs)) <= 3]
    gains = (lowest(of, 0.0, K) - costs) / np.maximum(1, 2 * costs / K)
    ratio = np.logaddexp.reduce(gains) - np.log(K - 1)
    (words,) = said(outcome(moved))
    assert f"after the reading at {LOST * INTERVAL:g} s, or one beside it, all times seem one interval" in words
    assert f"(0.25 s) too {which}" in words
    (told,) = re.findall(r"e\^([\d.]+) times likelier", words)
    assert float(told) == pytest.approx(ratio, rel=0.01)


@pytest.mark.parametrize("moved", [1.0, -1.0])
@pytest.mark.parametrize("lost", [4, 7, 13])
def test_it_is_found_wherever_it_is(moved, lost):
    (words,) = said(outcome(moved, lost))
    told = float(re.findall(r"reading at ([\d.]+) s", words)[0])
    assert abs(told - lost * INTERVAL) <= 1.01 * INTERVAL
    assert ("early" in words) == (moved > 0)


def test_it_is_asked_of_the_data_sets_of_a_folder_too():
    (words,) = said(assimilate(problem(1.0), replace(SETTINGS, what_if=False), 1))
    assert [words] == said(outcome(1.0))


def test_no_interval_is_printed_beside_it():
    assert "lost-frame" in untrusted(outcome(1.0).cautions, "b")


def test_what_several_data_sets_are_estimated_from_says_it_too():
    cautions = outcome(1.0).cautions
    sets = [SimpleNamespace(name=f"b{i}", cautions=cautions * (i == 2)) for i in range(4)]
    (told,) = (c for c in carried(sets, 1 / 3) if c.code == "lost-frame")
    assert told.words.startswith("of single data sets, b2: after the reading at 2.5 s")
    assert "leave this recording out" in told.advice


def test_nothing_is_run_where_nothing_is_doubtful():
    a = outcome(0.0)
    assert not said(a)
    assert a.forward_runs == unasked(0.0).forward_runs


def test_it_takes_few_runs():
    """With a descent at every third reading it took 352, now 170."""
    assert 0 < outcome(1.0).forward_runs - unasked(1.0).forward_runs < 200


def test_a_discrepancy_that_is_no_warning_yet_is_reason_enough_to_ask():
    of = with_discrepancy(problem(), amplitude=(STD, 0.5), length=(1.0, 0.4))
    a = assimilate(of, replace(SETTINGS, what_if=False, refine="none"), 1)
    j, error = of.prior.names.index("discrepancy_amplitude"), np.median(a.own_std)
    asked = []
    for share in (0.2, 0.3):
        posterior = a.posterior.copy()
        posterior[:, j] = share * error
        asked.append(_discrepant(replace(a, posterior=posterior)))
    assert asked == [False, True]


@pytest.mark.parametrize("why", ["not cheap", "uneven", "another error"])
def test_a_misfit_alone_is_no_lost_frame(why):
    of = problem(0.0 if why == "another error" else 1.0, cheap=why != "not cheap")
    o = of.observations
    if why == "uneven":
        times = o.times + 0.1 * INTERVAL * np.sin(7 * np.arange(K))
        of = replace(of, observations=make_observations(times, o.values, STD))
    if why == "another error":
        of = replace(of, observations=make_observations(o.times, o.values + 0.2 * np.cos(4 * o.times), STD))
    a = assimilate(of, SETTINGS, 1)
    assert {c.code for c in a.cautions} & {"misfit", "residual-structure"}
    assert not said(a)


@pytest.mark.parametrize("code", ["misfit", "odd-residuals", "discrepancy-found"])
def test_no_larger_error_of_the_times_is_advised_beside_it(code):
    a, other = (
        replace(outcome(1.0), timing=0.1),
        caution(code, "the residuals are larger where the observable changes fast"),
    )
    (alone,), (_, beside) = (advised(a, some) for some in ([other], [caution("lost-frame", "a frame"), other]))
    assert "time_std" in alone.advice
    assert "time_std" not in beside.advice
