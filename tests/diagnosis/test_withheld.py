"""The readings after the window: what is expected of them, against closed forms, and how often it holds them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, norm
from toys import OBSERVABLE, Vectorised, make_observations, make_problem, with_discrepancy
from varying_models import Ramp

import en4dvar
from en4dvar.data.noise import Kernel, Predicted, noise_of
from en4dvar.diagnosis.analysis import BEYOND_5
from en4dvar.diagnosis.withheld import chance_of, predict_withheld
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.summary import remarks
from en4dvar.executor import SerialExecutor
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.report import write_pages
from en4dvar.report.responses import reading_words, time_label
from en4dvar.report.result import Result
from en4dvar.results.store import load_stored
from en4dvar.runs.rerun import rerun
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble.examples import write_example

LATER = np.linspace(2.2, 4.0, 7)
SETTINGS = AssimilationSettings(members=12, what_if=False)


def continued(problem, truth, seed, std=0.1):
    """The problem with readings after its window."""
    y, model = problem.observations, problem.model
    noise = std * np.random.default_rng([7, seed]).standard_normal(len(LATER))
    later = np.array([model.curve(np.asarray(truth), t) for t in LATER]) + noise
    whole = make_observations(np.append(y.times, LATER), np.append(y.values, later), std)
    return replace(problem, observations=replace(y, continued=whole))


@pytest.mark.parametrize("huber", [None, 5.0])
def test_the_rest_given_the_first_is_that_of_the_precision_matrix(huber):
    """N(m, R + A) in two blocks: the conditional by Λ = (R + A)⁻¹ instead of the covariance. No reading is so far off
    that a robust cost counts it less.
    """
    stream, times = np.random.default_rng(1), np.sort(np.random.default_rng(0).uniform(0, 3, 11))
    std, rates = stream.uniform(0.1, 0.3, 11), stream.standard_normal(11)
    noise = noise_of(std, np.full(11, 0.05), None, huber, Kernel(times, 1.5, 0.7))
    m = stream.standard_normal(11)
    predicted = Predicted(m, rates, np.array(1.3), np.array([0.4, 0.8]))
    first = m[:6] + 0.2 * stream.standard_normal(6)
    mean, expected_std = noise.continued(first, predicted)
    lag = np.sqrt(3) * np.abs(np.subtract.outer(times, times)) / 0.8
    grown = np.sqrt(1 + (rates / 0.7) ** 2)
    covariance = 0.16 * (1 + lag) * np.exp(-lag) * np.outer(grown, grown)
    covariance += np.diag(1.3**2 * (std**2 + (0.05 * rates) ** 2))
    precision = np.linalg.inv(covariance)
    of_rest = np.linalg.inv(precision[6:, 6:])
    assert mean == pytest.approx(m[6:] - of_rest @ precision[6:, :6] @ (first - m[:6]), abs=1e-7)
    assert expected_std == pytest.approx(np.sqrt(np.diag(of_rest)), rel=1e-7)


def test_independent_errors_tell_nothing_of_the_rest():
    noise = noise_of(np.full(5, 0.2), np.zeros(5))
    mean, std = noise.continued(np.array([3.0, 4.0]), Predicted(np.arange(5.0)))
    assert (mean.tolist(), std.tolist()) == ([2.0, 3.0, 4.0], [0.2] * 3)


def test_bands_are_those_of_a_linear_model():
    """The predictive distribution of a linear model is Gaussian: N(H m, H C Hᵀ + std²), by the normal equations."""
    model = Vectorised()
    problem = continued(make_problem(model, (1.0, 0.5)), (1.0, 0.5), 1)
    a = assimilate(problem, AssimilationSettings(members=400), 1)
    rows = np.array([[model.curve(e, t) for e in np.eye(2)] for t in np.append(problem.observations.times, LATER)])
    window, rest = rows[:9], rows[9:]
    precision = np.eye(2) + window.T @ window / 0.01
    mean = np.linalg.solve(precision, [0.8, 0.4] + window.T @ problem.observations.values / 0.01)
    std = np.sqrt(np.diag(rest @ np.linalg.inv(precision) @ rest.T) + 0.01)
    assert a.withheld.median == pytest.approx(rest @ mean, abs=0.01)
    assert a.withheld.high - a.withheld.low == pytest.approx(2 * 1.645 * std, rel=0.02)


@pytest.mark.parametrize(("count", "error"), [(20, 1e-12), (600, 5e-3)])  # many are taken for Gaussian
def test_readings_that_err_for_themselves_are_counted_by_a_binomial(count, error):
    """Of equal members every reading counts, and the chance is that of another implementation of the binomial."""
    low, high = np.full(count, -BEYOND_5), np.full(count, BEYOND_5)
    for inside in (count, round(0.88 * count), round(0.87 * count)):
        chance = chance_of(inside, low, high, np.zeros((30, count)), np.ones((30, count)))
        assert chance == pytest.approx(binom.cdf(inside, count, 2 * norm.cdf(BEYOND_5) - 1), abs=error)


def test_readings_that_err_together_count_as_one():
    """Members whose paths are parallel, far apart beside the errors: all readings of a path are inside, or none."""
    paths = np.repeat(np.linspace(-1.0, 1.0, 400)[:, None], 50, axis=1)
    chances = [chance_of(n, np.full(50, -0.9), np.full(50, 0.9), paths, np.full_like(paths, 1e-6)) for n in (0, 49, 50)]
    assert chances == pytest.approx([0.1, 0.1, 1.0])


@pytest.mark.parametrize("tilt", [0.0, 1.0, 3.0])
def test_the_chance_is_that_of_readings_drawn_from_the_members(tilt):
    """A part of the scatter is of the path, whose slope varies: as many draws as the chance says have no more readings
    inside. A binomial of as much variance said 0.008 where 0.013 of them have.
    """
    stream, t = np.random.default_rng(3), np.linspace(0, 1, 10)
    mean = tilt * (stream.standard_normal((20000, 1)) + stream.standard_normal((20000, 1)) * t)
    spread = np.sqrt(1 + tilt**2 * (1 + t**2))
    low, high = -BEYOND_5 * spread, BEYOND_5 * spread
    drawn = mean + stream.standard_normal(mean.shape)
    inside = np.sum((low <= drawn) & (drawn <= high), axis=1)
    for count in (3, 5, 8):
        share = np.mean(inside <= count)
        error = 4 * np.sqrt(share / len(inside)) + 1e-4
        assert chance_of(count, low, high, mean, np.ones_like(mean)) == pytest.approx(share, abs=error)


class Twice(Ramp):
    """Also told to change by "twice", which makes y so much larger two times."""

    def changed(self, name, x, change):
        return super().changed("y", x, 2 * change if name == "twice" else change)


def test_bands_allow_for_changes_that_the_model_does_not_foresee():
    """y' = r, and y is e^z times larger from the last maximum of the window on: quantiles of a lognormal."""
    model = Twice()
    model.unforeseen = {"y": 0.5}
    times, later = np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0])
    observed = make_observations(times, np.array([0.5, 1.0, 0.9]), 1e-6)
    whole = make_observations(np.append(times, later), np.array([0.5, 1.0, 0.9, 1.0, 1.0]), 1e-6)
    terms = [PriorTerm.normal(model.parameters[0], 0.0, 1.0)]
    problem = InverseProblem(model, model.observables[0], replace(observed, continued=whole), Prior(terms))
    found = predict_withheld(problem, np.full((401, 1), 0.2), SerialExecutor())
    at_top, since = 1 + 0.2 * 2.0, 0.2 * (later - 2.0)
    for level, values in ((-1.645, found.low), (0.0, found.median), (1.645, found.high)):
        assert values == pytest.approx(at_top * np.exp(0.5 * level) + since, rel=0.01)
    model.unforeseen = {"y": 0.3, "twice": 0.2}  # independent: 0.3 and 2 × 0.2 make 0.5
    found = predict_withheld(problem, np.full((401, 1), 0.2), SerialExecutor())
    assert found.high == pytest.approx(at_top * np.exp(0.5 * 1.645) + since, rel=0.03)
    model.unforeseen = {}
    found = predict_withheld(problem, np.full((401, 1), 0.2), SerialExecutor())
    assert found.high == pytest.approx(1 + 0.2 * later, rel=1e-4)


@pytest.mark.slow
def test_nine_in_ten_readings_lie_in_their_bands():
    """40 truths of the prior, with seven readings each: 280, of which 90 % ± 1.8 % are expected."""
    inside = []
    for seed in range(40):
        truth = np.array([0.8, 0.4]) + np.random.default_rng([3, seed]).standard_normal(2)
        prior = make_problem(Vectorised(), (1.0, 0.5)).prior.terms
        problem = continued(make_problem(Vectorised(), truth, seed=seed, prior=prior), truth, seed)
        inside.append(assimilate(problem, SETTINGS, seed).withheld.inside)
    assert 0.84 < np.mean(inside) < 0.96


def test_without_readings_after_the_window_there_is_nothing():
    problem = make_problem(Vectorised(), (1.0, 0.5))
    assert predict_withheld(problem, np.zeros((4, 2)), SerialExecutor()) is None
    assert assimilate(problem, SETTINGS, 1).withheld is None


def test_written_read_back_and_shown(tmp_path):
    """Also beside a discrepancy, whose members have an amplitude and a length each."""
    plain = make_problem(Vectorised(), (1.0, 0.5))
    problem = with_discrepancy(plain)
    y = problem.observations
    times, std = np.append(y.times, LATER), np.full(len(y) + 7, 0.1)
    noise = noise_of(std, np.zeros(len(times)), discrepancy=Kernel(times))
    whole = replace(continued(plain, (1.0, 0.5), 2).observations.continued, noise=noise)
    problem = replace(problem, observations=replace(y, continued=replace(whole, zero=30.0), zero=30.0))
    a = assimilate(problem, SETTINGS, 1)
    Result.from_analysis(a, {}).save(tmp_path / "posterior.nc")
    stored = load_stored(tmp_path / "posterior.nc")
    held, again = stored.groups["/withheld"], stored.observations({"y": OBSERVABLE}).continued
    np.testing.assert_array_equal(held["y_median"].values, a.withheld.median)
    for key in ("times", "values", "zero"):
        np.testing.assert_array_equal(getattr(again, key), getattr(problem.observations.continued, key))
    np.testing.assert_array_equal(again.noise.std, whole.noise.std)
    assert again.noise.kernel.smoothness == whole.noise.kernel.smoothness
    write_pages(tmp_path)
    with (tmp_path / "withheld.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time"]) for row in rows] == pytest.approx(LATER + 30.0)
    assert "the farthest, at 31.1 s on the clock of the data" in reading_words(stored)[-1]
    assert time_label(stored) == "time since 30 s of the data (s)"
    assert np.mean([int(row["inside"]) for row in rows]) == a.withheld.inside
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"{a.withheld.inside * 7:.0f} of 7 readings after the window" in page


def test_one_reading_after_the_window_is_told_in_the_singular(tmp_path, monkeypatch):
    """It read "100 % of 1 readings lie in their 90 % bands"."""
    monkeypatch.setitem(globals(), "LATER", LATER[:1])
    a = assimilate(continued(make_problem(Vectorised(), (1.0, 0.5)), (1.0, 0.5), 2), SETTINGS, 1)
    for off, where in ((0.0, "in"), (9.0, "outside of")):
        one = replace(a, withheld=replace(a.withheld, values=a.withheld.median + off))
        assert f"after the window: the only reading lies {where} its 90 % band" in remarks(one)
        Result.from_analysis(one, {}).save(tmp_path / "posterior.nc")
        page = write_pages(tmp_path).read_text(encoding="utf-8")
        assert f"The only reading after the window lies {where} the 90 % band of the prediction" in page
        assert "(root mean square)." not in page


def test_a_window_of_a_file_leaves_readings_and_a_rerun_predicts_them_again(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = write_example("quickstart", tmp_path, True)
    changes = {"data.window": {"from": "start", "to": "20 us"}, "execution.workers": 1, "output.directory": "run"}
    result = en4dvar.run(file, overrides=changes)
    stats = result.sample_stats.attrs
    assert stats["withheld_readings"] > 3
    assert 0 <= stats["withheld_inside"] <= 1
    assert rerun("run").same
