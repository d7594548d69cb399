"""``reading_scale``: the factor by which all readings are too large, with closed forms; whatever reads it agrees."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from acting import Acting, acting_problem
from click.testing import CliRunner
from series_models import all_series, problem_of
from toy_config import csv_text, write_toy
from toys import OBSERVABLE, Linear, make_observations, make_problem

from en4dvar.cli import main
from en4dvar.ensemble.forecast import check_problem, forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Alternative
from en4dvar.model.state import READING_SCALE, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.report.result import load_result
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings(members=12)
SCALED = PriorTerm.normal(READING_SCALE, 1.0, 0.2)


def scaled(problem, term=SCALED):
    return replace(problem, prior=Prior((*problem.prior.terms, term)))


def test_beside_a_known_curve_it_is_the_weighted_mean_of_closed_form():
    model, times = Linear(("a",)), np.linspace(0.0, 1.0, 5)
    values = np.array([2.1, 2.2, 2.0, 2.3, 2.1])
    problem = InverseProblem(model, OBSERVABLE, make_observations(times, values), Prior((SCALED,)), {"a": 2.0})
    analysis = assimilate(problem, replace(SETTINGS, start="prior-mean", refine="none"), 1)
    precision = 1 / 0.2**2 + np.sum(2.0**2 / 0.1**2 * np.ones(5))
    mean = (1 / 0.2**2 + np.sum(2.0 * values) / 0.1**2) / precision
    assert analysis.centre[0] == pytest.approx(mean, abs=1e-9)
    assert analysis.posterior.std(ddof=1) == pytest.approx(precision**-0.5, abs=1e-9)
    np.testing.assert_allclose(
        analysis.posterior_trajectories, 2.0 * analysis.posterior * np.ones(5), rtol=0, atol=1e-12
    )


def test_it_multiplies_predictions_and_rates_of_every_kind_of_run():
    problem = scaled(make_problem(Linear(("a", "b")), [1.0, 0.5], time_std=0.01))
    x = np.array([[1.0, 0.5, 1.0], [1.0, 0.5, 1.1]])
    of = forecast(problem, x, extra_times=np.array([0.3])).predicted, forecast(problem, x, None, np.array([0.3])).path
    for values in (of[0].values, of[0].rates, of[1]):
        np.testing.assert_allclose(values[1], 1.1 * values[0], rtol=1e-14)
    plain = scaled(make_problem(Linear(("a", "b")), [1.0, 0.5]))
    np.testing.assert_allclose(forecast(plain, x).predictions, of[0].values, rtol=1e-14)


def test_a_parameter_of_that_name_of_the_model_goes_before_it():
    model = Linear(("a",))
    model.parameters = (Parameter("reading_scale", "1"),)
    problem = make_problem(model, [1.0])
    own = forecast(problem, np.array([[1.0], [2.0]])).predictions
    np.testing.assert_allclose(own, [np.ones(9), 2 * np.ones(9)], rtol=1e-14)


def test_ledger_and_what_if_know_it():
    """Readings of b x with b known are readings of x whose errors are b times smaller."""
    times = [0.2, 0.6, 0.7, 0.8, 1.4]
    plain = acting_problem(times)
    o = plain.observations
    doubled = replace(plain, observations=make_observations(o.times, 2 * o.values, 0.2), fixed={"reading_scale": 2.0})
    one, other = (assimilate(problem, SETTINGS, 1).ledger for problem in (plain, doubled))
    np.testing.assert_allclose(other.kernel, one.kernel, rtol=0, atol=1e-9)


def test_an_alternative_scale_is_not_told_where_the_scale_is_estimated():
    model = Acting()
    model.alternatives = (Alternative("length_scale", "all were larger", values=1.01), Alternative("same", "not"))
    told = [assimilate(p, SETTINGS, 1).what_if for p in (acting_problem([0.6, 0.7, 1.0, 1.2], model),)]
    told.append(assimilate(scaled(acting_problem([0.6, 0.7, 1.0, 1.2], model)), SETTINGS, 1).what_if)
    assert [{shift.name for shift in one} for one in told] == [{"length_scale", "same"}, {"same"}]


def test_one_factor_for_several_series_is_refused():
    with pytest.raises(ConfigError, match="several series"):
        check_problem(scaled(problem_of(all_series())))


def test_an_offset_is_told_in_the_unit_of_what_is_read(tmp_path: Path) -> None:
    entry = "  c: 0.02 N s/m\n"
    offset = "  reading_offset: {prior: normal, mean: 0 um, std: 5 um}\n"
    config = write_toy(tmp_path, ("{prior: normal, mean: maximum, std: 1 %}", "100 um"), (entry, entry + offset))
    lines = [line.split(",") for line in csv_text().splitlines()[2:]]
    (tmp_path / "toy.csv").write_text("t_ms,x_um\n" + "".join(f"{t},{3 + float(x):.6g}\n" for t, x in lines))
    outcome = CliRunner().invoke(main, ["run", str(config), "--out", str(tmp_path / "run"), "--no-report"])
    assert outcome.exit_code == 0, outcome.output
    row = {row.name: row for row in load_result(tmp_path / "run" / "posterior.nc").rows}["reading_offset"]
    assert row.unit == "um"
    assert abs(row.mean - 3) < 3 * row.std < 2
    shown = []
    for value in ("0 um", "7 um"):
        truth, out = ["--set", "parameters.k=2 N/m", "--set", f"parameters.reading_offset={value}"], tmp_path / "s.csv"
        words = ["simulate", str(config), *truth, "--out", str(out), "--force"]
        assert CliRunner().invoke(main, words).exit_code == 0
        shown.append(np.loadtxt(out.read_text().splitlines()[-31:], delimiter=",")[:, 1])
    np.testing.assert_allclose(shown[1], 7 + shown[0], rtol=1e-4, atol=1e-3)


def test_from_yaml_to_the_result_and_the_simulation(tmp_path: Path) -> None:
    entry = "  c: 0.02 N s/m\n"
    config = write_toy(
        tmp_path,
        ("{prior: normal, mean: maximum, std: 1 %}", "100 um"),
        (entry, f"{entry}  reading_scale: {{prior: lognormal, median: 1, log_std: 0.05}}\n"),
    )
    lines = [line.split(",") for line in csv_text().splitlines()[2:]]
    (tmp_path / "toy.csv").write_text("t_ms,x_um\n" + "".join(f"{t},{1.04 * float(x):.6g}\n" for t, x in lines))
    outcome = CliRunner().invoke(main, ["run", str(config), "--out", str(tmp_path / "run"), "--no-report"])
    assert outcome.exit_code == 0, outcome.output
    row = {row.name: row for row in load_result(tmp_path / "run" / "posterior.nc").rows}["reading_scale"]
    assert abs(row.mean - 1.04) < 3 * row.std < 0.04
    simulated = []
    for factor in ("1", "1.5"):
        out = tmp_path / f"{factor}.csv"
        truth = ["--set", "parameters.k=2 N/m", "--set", f"parameters.reading_scale={factor}"]
        assert CliRunner().invoke(main, ["simulate", str(config), *truth, "--out", str(out)]).exit_code == 0
        simulated.append(np.loadtxt(out.read_text().splitlines()[-31:], delimiter=",")[:, 1])
        assert f"reading_scale = {factor}\n" in out.read_text()  # without the unit 1
    np.testing.assert_allclose(simulated[1], 1.5 * simulated[0], rtol=1e-4, atol=1e-3)
