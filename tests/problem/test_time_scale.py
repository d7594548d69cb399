"""``time_scale``: by how much the model's time is longer than that of the data, with closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from acting import Acting, acting_problem
from click.testing import CliRunner
from toy_config import write_toy
from toys import Linear, make_observations, make_problem
from varying_models import Ramp

from en4dvar.cli import main
from en4dvar.ensemble.forecast import forecast
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import Alternative
from en4dvar.model.state import TIME_SCALE, Parameter
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.schemes.settings import AssimilationSettings

SETTINGS = AssimilationSettings(members=12)
SCALED = PriorTerm.normal(TIME_SCALE, 1.0, 0.2)


def scaled(problem):
    return replace(problem, prior=Prior((*problem.prior.terms, SCALED)))


def test_beside_a_known_rate_it_is_the_weighted_mean_of_closed_form():
    """y = 1 + r a t with r = 2 m/s known is linear in the scale a."""
    times, values = np.linspace(0.2, 1.0, 5), np.array([1.5, 1.8, 2.4, 2.7, 3.3])
    observations = make_observations(times, values, 0.1)
    problem = InverseProblem(Ramp(), Ramp.observables[0], observations, Prior((SCALED,)), {"r": 2.0})
    analysis = assimilate(problem, replace(SETTINGS, start="prior-mean", refine="none"), 1)
    precision = 1 / 0.2**2 + np.sum((2 * times / 0.1) ** 2)
    mean = (1 / 0.2**2 + np.sum(2 * times * (values - 1)) / 0.1**2) / precision
    assert analysis.centre[0] == pytest.approx(mean, abs=1e-9)
    assert analysis.posterior.std(ddof=1) == pytest.approx(precision**-0.5, abs=1e-9)


def test_predictions_and_rates_are_by_the_time_of_the_data():
    """Shift and scale: y(a t + t_s), whose rate is a ẏ."""
    problem = replace(scaled(make_problem(Linear(("a", "b")), [1.0, 0.5], time_std=0.01)), fixed={"t_s": 0.1})
    run = forecast(problem, np.array([[1.0, 0.5, 1.0], [1.0, 0.5, 1.3]]), extra_times=np.array([0.3])).predicted
    model, times = Linear(("a", "b")), problem.observations.times
    for i, a in enumerate((1.0, 1.3)):
        curve, rate = (
            np.array([f(np.array([1.0, 0.5]), a * t + 0.1) for t in times]) for f in (model.curve, model.rate)
        )
        np.testing.assert_allclose(run.values[i], curve, rtol=1e-12)
        np.testing.assert_allclose(run.rates[i], a * rate, rtol=1e-12)


def test_a_parameter_of_that_name_of_the_model_goes_before_it():
    model = Linear(("a",))
    model.parameters = (Parameter("time_scale", "1"),)
    own = forecast(make_problem(model, [1.0]), np.array([[1.0], [2.0]])).predictions
    np.testing.assert_allclose(own, [np.ones(9), 2 * np.ones(9)], rtol=1e-14)


def test_the_ledger_knows_it():
    """Readings of a clock that runs twice too fast, with its scale known, are those of the right clock."""
    plain = acting_problem([0.2, 0.6, 0.7, 0.8, 1.4])
    o = plain.observations
    halved = replace(plain, observations=make_observations(o.times / 2, o.values, 0.1), fixed={"time_scale": 2.0})
    first, other = (assimilate(problem, SETTINGS, 1).ledger for problem in (plain, halved))
    np.testing.assert_allclose(other.kernel, first.kernel, rtol=0, atol=1e-9)


def test_another_time_step_is_not_told_where_the_scale_is_estimated():
    model = Acting()
    model.alternatives = (Alternative("time_scale", "all were later", times=1.01), Alternative("same", "not"))
    problem = acting_problem([0.6, 0.7, 1.0, 1.2], model)
    told = [assimilate(p, SETTINGS, 1).what_if for p in (problem, scaled(problem))]
    assert [{shift.name for shift in shifts} for shifts in told] == [{"time_scale", "same"}, {"same"}]


def test_simulated_from_yaml_it_stretches_the_clock(tmp_path: Path) -> None:
    config, curves = write_toy(tmp_path), []
    for scale, times in (("1", "10 ms:100 ms:10 ms"), ("2", "5 ms:50 ms:5 ms")):
        out = tmp_path / f"{scale}.csv"
        truths = ("k=2 N/m", "A=100 um", f"time_scale={scale}")
        truth = [word for value in truths for word in ("--set", f"parameters.{value}")]
        outcome = CliRunner().invoke(main, ["simulate", str(config), *truth, "--times", times, "--out", str(out)])
        assert outcome.exit_code == 0, outcome.output
        curves.append(np.loadtxt(out.read_text().splitlines()[-10:], delimiter=",")[:, 1])
    np.testing.assert_allclose(curves[1], curves[0], rtol=1e-5, atol=1e-3)
