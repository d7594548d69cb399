"""Readings that are bounds, at most or at least what is stated, against quadrature of the posterior."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.special import ndtr
from toy_config import csv_text, write_toy
from toys import Vectorised, make_observations

import en4dvar
from en4dvar.assembly.build import build
from en4dvar.cli import main
from en4dvar.data.noise import BoundNoise, Linearisation, Predicted, noise_of, sides_of
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.results.store import load_stored
from en4dvar.schemes.settings import AssimilationSettings

SIDES = np.array([1.0, 0.0, -1.0, 1.0])
STD = np.array([0.5, 0.2, 0.3, 0.4])
STDS = ("a", 2.0), ("b", 1.0)  # of a line's prior


def test_the_cost_is_that_of_a_gaussian_beyond_a_bound_and_nothing_elsewhere():
    noise = noise_of(STD, sides=SIDES)
    y, m = np.array([1.0, 1.0, 1.0, 1.0]), np.array([[2.0, 2.0, 2.0, 0.0], [0.0, 0.0, 0.0, 2.0]])
    weights = np.array([1.0, 1.0, 1.0, 0.5])
    expected = [0.5 * (2**2 + 5**2), 0.5 * (5**2 + (1 / 0.3) ** 2 + 0.5 * 2.5**2)]
    np.testing.assert_allclose(noise.cost(y, weights, Predicted(m)), expected, rtol=1e-14)
    bounds = SIDES != 0  # a density of a reading, the probability of a statement
    likelihood = noise.log_likelihood(y, Predicted(m))
    assert np.all(likelihood[:, bounds] <= 0)
    np.testing.assert_allclose(
        -likelihood @ weights, noise.cost(y, weights, Predicted(m)) + noise.log_normalisation(weights)
    )


def test_the_score_is_the_derivative_of_the_cost():
    noise, rng = noise_of(STD, sides=SIDES), np.random.default_rng(1)
    y, weights, slopes = rng.normal(size=4), rng.uniform(0.5, 2, size=4), rng.normal(size=(3, 4))
    for m in rng.normal(size=(20, 4)):
        d, S = noise.whiten(y, weights, Linearisation(Predicted(m), slopes))
        steps = 1e-5 * slopes
        numeric = (noise.cost(y, weights, Predicted(m + steps)) - noise.cost(y, weights, Predicted(m - steps))) / 2e-5
        np.testing.assert_allclose(-S.T @ d, numeric, atol=1e-6)


def _problem(sides, values, std):
    model = Vectorised(names=("a",))  # y = a
    plain = make_observations(np.arange(1.0, 1.0 + len(values)), np.array(values), std=std)
    data = type(plain)(plain.times, plain.values, noise_of(plain.std, sides=np.array(sides)), plain.weights)
    return InverseProblem(model, model.observables[0], data, Prior((PriorTerm.normal(model.parameters[0], 0.0, 1.0),)))


def _moments(problem):
    """Mean and std of the posterior, by quadrature."""
    a, density = _density(problem)
    mean = float(np.sum(a * density) / np.sum(density))
    return mean, math.sqrt(np.sum((a - mean) ** 2 * density) / np.sum(density))


def _density(problem, mean=0.0, std=1.0):
    """exp(−J_o) times the prior's density, along a grid of a."""
    a = np.linspace(-6, 6, 20001)
    costs = problem.observations.cost(Predicted(np.tile(a[:, None], len(problem.observations))))
    return a, np.exp(-0.5 * ((a - mean) / std) ** 2 - costs) / math.sqrt(2 * math.pi) / std


@pytest.mark.parametrize(
    ("sides", "values"),
    [
        ([-1.0, 0.0], [0.7, 0.4]),
        ([1.0], [3.0]),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in [([1.0], [-0.5]), ([1.0, -1.0], [0.5, 0.2])]),
    ],
)
def test_the_posterior_is_that_of_quadrature(sides, values):
    problem = _problem(sides, values, 0.1)
    mean, std = _moments(problem)
    analysis = assimilate(problem, AssimilationSettings(members=400, refine="mcmc"), seed=3)
    assert analysis.converged
    assert float(analysis.posterior.mean()) == pytest.approx(mean, abs=0.1 * std)
    assert float(analysis.posterior.std()) == pytest.approx(std, rel=0.1)
    if values == [3.0]:  # says nothing that the prior does not
        assert not [c for c in analysis.cautions if c.severity == "serious"]


@pytest.mark.parametrize(
    ("sides", "values"),
    [
        ([1.0], [-0.5]), ([-1.0, 0.0], [0.7, 0.4]), ([1.0, -1.0], [0.5, 0.2]), ([1.0], [0.0]),
        pytest.param([0.0, 1.0], [1.0, -1.0], marks=pytest.mark.slow),  # the misfit makes descents from all members
    ],
)  # fmt: skip
def test_without_sampling_a_linear_model_has_it_too(sides, values):
    """By draws of the linearised posterior, where a model is too dear for a chain."""
    problem = _problem(sides, values, 0.1)
    mean, std = _moments(problem)
    analysis = assimilate(problem, AssimilationSettings(members=2000, refine="none"), seed=3)
    assert float(analysis.posterior.mean()) == pytest.approx(mean, abs=0.08 * std)
    assert float(analysis.posterior.std()) == pytest.approx(std, rel=0.06)


@pytest.mark.parametrize(
    ("sides", "values"),
    [([1.0], [-0.5]), ([-1.0, 0.0], [0.7, 0.4]), ([1.0, -1.0], [0.5, 0.2]), ([1.0], [0.0]), ([0.0, 1.0], [1.0, -1.0])],
)
def test_the_evidence_of_a_linear_model_is_that_of_quadrature(sides, values):
    problem = _problem(sides, values, 0.1)
    analysis = assimilate(problem, AssimilationSettings(members=200, refine="none"), seed=3)
    a, density = _density(problem, float(analysis.prior.mean()), float(analysis.prior.std(ddof=1)))
    exact = math.log(np.sum(density) * (a[1] - a[0])) - problem.observations.log_normalisation()
    assert analysis.log_evidence == pytest.approx(exact, abs=0.1)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (5, 16))])
def test_ranges_about_a_line_leave_one_mode_and_no_doubt(seed):
    """J of a linear model is convex, but flat within the ranges: a rough end of a descent is anywhere in them."""
    rng, t = np.random.default_rng(seed), np.linspace(1, 5, 6)
    low = rng.normal(0, 1) + 0.5 * t - rng.uniform(0.2, 0.8, 6)
    readings, error = {"lo": (t, low), "hi": (t, low + 1)}, {"lo": {"at_least": True}, "hi": {"at_most": True}}
    result = en4dvar.estimate(
        lambda p, t: p["a"] + p["b"] * t, readings, {n: {"prior": "normal", "mean": 0, "std": s} for n, s in STDS},
        error={name: {"y_std": 0.2, **side} for name, side in error.items()},
        series={name: {"observable": "y"} for name in readings}, seed=seed, progress=False,
    )  # fmt: skip
    assert not result.warnings
    (a, b), m = np.meshgrid(np.linspace(-6, 6, 601), np.linspace(-3, 3, 601)), 0.0
    for at, bound in zip(t, low, strict=True):
        m = m + np.maximum(a + b * at - bound - 1, 0) ** 2 + np.maximum(bound - a - b * at, 0) ** 2
    density = np.exp(-0.5 * (m / 0.2**2 + (a / 2) ** 2 + b**2)) * 0.02 * 0.01 / (4 * np.pi)
    assert result.sample_stats.attrs["log_evidence"] == pytest.approx(math.log(density.sum()), abs=0.15)
    mean = float(np.sum(b * density) / density.sum())
    std = math.sqrt(np.sum((b - mean) ** 2 * density) / density.sum())
    assert float(result.posterior["b"].mean()) == pytest.approx(mean, abs=0.5 * std)
    assert float(result.posterior["b"].std()) == pytest.approx(std, rel=0.4)


def test_a_hard_bound_cuts_the_prior_off():
    analysis = assimilate(_problem([1.0], [0.0], 0.01), AssimilationSettings(members=400, refine="mcmc"), seed=3)
    assert float(analysis.posterior.mean()) == pytest.approx(-math.sqrt(2 / math.pi), abs=0.06)
    assert float(analysis.posterior.max()) < 0.1


def test_the_minimum_lies_where_the_bound_and_the_prior_balance():
    analysis = assimilate(_problem([1.0], [-0.5], 0.1), AssimilationSettings(members=30, refine="none"), seed=3)
    prior = analysis.prior  # of sampled mean and variance, on which the minimum depends
    mean, precision = float(prior.mean()), 1 / float(prior.var(ddof=1))
    expected = (precision * mean + 100 * -0.5) / (precision + 100)
    assert float(analysis.iterations[-1].centre[0]) == pytest.approx(expected, abs=1e-4)


def test_a_scale_of_the_errors_is_refused_beside_bounds():
    problem = _problem([1.0, 0.0], [1.0, 1.0], 0.1)
    with pytest.raises(ConfigError, match=r"bounds .at_most, at_least. tell no scale of errors; leave sigma out"):
        assimilate(replace(problem, fixed={"sigma": 1.0}), AssimilationSettings(), seed=1)


@pytest.mark.parametrize("scheme", ["es-mda", "etkf"])
def test_a_scheme_of_constant_covariance_refuses_bounds_by_name(scheme):
    with pytest.raises(ConfigError, match=r"bounds|series"):
        assimilate(_problem([1.0], [1.0], 0.1), AssimilationSettings(scheme=scheme), seed=1)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"time_std": np.ones(4)}, "no timing error"),
        ({"sides": 0.5 * SIDES}, "not both"),
        ({"huber": 1.3}, "no correlation, robust cost or discrepancy"),
    ],
)
def test_what_bounds_cannot_stand_beside(more, words):
    with pytest.raises(ValueError, match=words):
        noise_of(**{"std": STD, "sides": SIDES} | more).check(np.ones(4))


def test_nothing_is_drawn_of_bounds():
    noise = BoundNoise(STD[:1], np.zeros(1), np.ones(1))
    with pytest.raises(ConfigError, match="cannot be drawn"):
        noise.drawn(Predicted(np.zeros(1)), np.random.default_rng(1))


@pytest.mark.parametrize("of", ["one series", "two series"])
def test_python_takes_them_and_a_file_keeps_them(of, tmp_path):
    """y = b, read once as 1 ± 0.5 and bounded from above at 0.8 by two readings."""

    def model(p, t):
        return p["b"] + 0 * t

    options = {"priors": {"b": {"prior": "normal", "mean": 0, "std": 3}}, "progress": False, "directory": tmp_path}
    if of == "one series":
        error = {"y_std": np.array([0.5, 0.01, 0.01]), "at_most": np.array([0, 1, 1])}
        data = {"time": [1.0, 2.0, 3.0], "y": [1.0, 0.8, 0.8]}
        result = en4dvar.estimate(model, data, error=error, **options)
    else:
        data = {"read": {"time": [1.0], "y": [1.0]}, "bound": {"time": [2.0, 3.0], "y": [0.8, 0.8]}}
        error = {"read": 0.5, "bound": {"y_std": 0.01, "at_most": True}}
        series = {name: {"observable": "y"} for name in data}
        result = en4dvar.estimate(model, data, error=error, series=series, **options)
    b = result.posterior["b"]
    z = (0.8 - 1) / 0.5  # of a Gaussian cut off at 0.8, but for a prior of 3
    mean = 1 - 0.5 * math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi) / ndtr(z)
    assert float(b.mean()) == pytest.approx(mean, abs=0.12)
    assert float(b.max()) < 0.85
    (path,) = tmp_path.rglob("posterior.nc")
    np.testing.assert_array_equal(sides_of(load_stored(path).observations().noise), [0, 1, 1])


def test_yaml_takes_a_column_of_marks(tmp_path):
    text = csv_text()
    _, header, *rows = text.splitlines()
    marked = "\n".join([f"{header},bound", *(f"{row},{int(i > 20)}" for i, row in enumerate(rows))]) + "\n"
    path = write_toy(tmp_path, ("position_std: 2 um", "position_std: 2 um, at_least: {column: bound}"), data=marked)
    noise = build(en4dvar.load_config(path))[0].observations.noise
    np.testing.assert_array_equal(sides_of(noise), -1.0 * (np.arange(len(rows)) > 20))
    wrong = marked.replace(",0\n", ",2\n", 1)
    path = write_toy(tmp_path, ("position_std: 2 um", "position_std: 2 um, at_least: {column: bound}"), data=wrong)
    with pytest.raises(DataError, match="mark of reading 1 in column 'bound' is 2, neither 0 nor 1"):
        build(en4dvar.load_config(path))


LOW, HIGH, AT = np.array([0, 0.5, 1, 1, 1.5, 2]), np.array([1, 1.5, np.nan, 2, 2.5, 3]), np.linspace(1, 5, 6)
LINE = {"a": {"prior": "normal", "mean": 0, "std": 2}, "b": {"prior": "normal", "mean": 0, "std": 1}}
RANGES = """
name: ranges
seed: 1
data:
  path: ranges.csv
  columns: {time: {name: t, unit: s}}
  series:
    lower: {observable: position, columns: {position: {name: low, unit: m}}, error: {position_std: 1 m, at_least: true}}
    upper: {observable: position, columns: {position: {name: high, unit: m}}, error: {position_std: 1 m, at_most: true}}
model: {name: "toy_models:Oscillator", mass: 2 g}
parameters: {k: 5 N/m, c: 0.02 N s/m, A: {prior: normal, mean: 1 m, std: 1 m}}
"""


def line(p, t):
    return p["a"] + p["b"] * t


@pytest.mark.slow
def test_a_range_is_two_series_of_one_observable(tmp_path):
    """As docs/several_series.md writes it, against quadrature of a line through six of them, one open above."""
    a, b = np.meshgrid(np.linspace(-5, 5, 1001), np.linspace(-2, 2, 1001), indexing="ij")
    paths = a[..., None] + b[..., None] * AT
    beyond = np.maximum(LOW - paths, 0) ** 2 + np.nan_to_num(np.maximum(paths - HIGH, 0)) ** 2
    density = np.exp(-0.5 * (beyond.sum(axis=-1) / 0.2**2 + (a / 2) ** 2 + b**2))
    density /= density.sum()
    error = {"lower": {"y_std": 0.2, "at_least": True}, "upper": {"y_std": 0.2, "at_most": True}}
    result = en4dvar.estimate(
        line, {"lower": (AT, LOW), "upper": (AT, HIGH)}, LINE, error=error, progress=False, cheap=True,
        series={name: {"observable": "y"} for name in error}, assimilation={"members": 400},
    )  # fmt: skip
    for name, value in (("a", a), ("b", b)):
        mean = np.sum(density * value)
        std = math.sqrt(np.sum(density * (value - mean) ** 2))
        drawn = result.posterior[name].values
        assert drawn.mean() == pytest.approx(mean, abs=0.1 * std)
        assert drawn.std() == pytest.approx(std, rel=0.1)
    rows = "\n".join(f"{t},{low},{high if high == high else ''}" for t, low, high in zip(AT, LOW, HIGH, strict=True))
    (tmp_path / "ranges.csv").write_text(f"t,low,high\n{rows}\n")
    (tmp_path / "ranges.yaml").write_text(RANGES)
    (problem,) = build(en4dvar.load_config(tmp_path / "ranges.yaml"))
    np.testing.assert_array_equal(sides_of(problem.observations.noise), [-1] * 6 + [1] * 5)
    done = CliRunner().invoke(main, ["run", str(tmp_path / "ranges.yaml"), "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    assert "bounds tell no size of errors" in (tmp_path / "run" / "report.html").read_text()


def test_bounds_of_one_time_in_one_series_are_told_to_be_two(tmp_path):
    """And never to be told apart by a column that says something else."""
    words = "bounds of one time are series of their own: one of those that say at_least, one of at_most$"
    times, values, up = np.repeat(AT, 2), np.ravel([LOW, LOW + 1], order="F"), np.tile([0, 1], 6)
    error = {"y_std": 0.2, "at_most": up, "at_least": 1 - up}
    with pytest.raises(DataError, match=f"reading 2 of data: times must increase, but 1 follows 1; {words}"):
        en4dvar.estimate(line, (times, values), LINE, error=error)
    rows = "".join(f"{t},{y},{mark},{1 - mark}\n" for t, y, mark in zip(times, values, up, strict=True))
    (tmp_path / "long.csv").write_text(f"time,y,up,low\n{rows}")
    path, error = tmp_path / "long.yaml", "error: {position_std: 1 m, at_most: {column: up}, at_least: {column: low}}"
    columns = "columns: {time: {name: time, unit: s}, position: {name: y, unit: m}}"
    data = f"name: long\ndata:\n  path: long.csv\n  {columns}\n  {error}\n"
    path.write_text(f"{data}model: {RANGES.partition('model: ')[2]}")
    with pytest.raises(DataError, match=words):
        build(en4dvar.load_config(path))
    rows = rows.replace(",0,1", ",0.1,one").replace(",1,0", ",0.2,two")  # where a column does say it
    (tmp_path / "long.csv").write_text(f"time,y,s,film\n{rows}")
    path.write_text(path.read_text().replace(error, "error: {position_std: {column: s}}"))
    with pytest.raises(DataError, match=r"column 'film' says which of several series a row belongs to"):
        build(en4dvar.load_config(path))


def test_bounds_have_no_mean(tmp_path):
    path = write_toy(
        tmp_path,
        ("position_std: 2 um", "position_std: 2 um, at_most: true"),
        ("  error:", "  repeated: average\n  error:"),
    )
    with pytest.raises(ConfigError, match=r"data.repeated: not together with at_most or at_least: bounds have no mean"):
        en4dvar.load_config(path)
