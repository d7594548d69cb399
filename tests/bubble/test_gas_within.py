"""Gas that changes within the window: at the maxima of the readings, one change each, estimated with the rest."""

from __future__ import annotations

import math

import numpy as np
import pytest

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.diagnosis.withheld import predict_withheld
from en4dvar.estimation.assimilate import assimilate
from en4dvar.executor import SerialExecutor
from en4dvar.model.state import Field
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.varying import PiecewiseModel, StateChanges
from en4dvar.schemes.settings import AssimilationSettings
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt

TRUTH, MORE_GAS = {"G": 4e3, "mu": 0.06, "R_eq": 35e-6, "R_max": 250e-6}, 0.8  # of ln of the amount
ERROR = 0.5e-6
TIMES = np.arange(0.7e-6, 75e-6, 1.0e-6)
YAML = """\
name: bubble
data:
  path: bubble.csv
  columns: {{time: {{name: t_us, unit: us}}, radius: {{name: R_um, unit: um}}}}
  window: {{to: {to}}}
  error: {{radius_std: 0.5 um}}
model: {{name: bubble, start: laser, gas: polytropic, law: neo-hookean-kelvin-voigt, gas_change: 0.7}}
parameters:
  G: {{prior: lognormal, median: 4 kPa, log_std: 0.5}}
  mu: {{prior: lognormal, median: 0.06 Pa s, log_std: 0.5}}
  R_eq: {{prior: lognormal, median: 35 um, log_std: 0.2}}
  R_max: {{prior: normal, mean: 250 um, std: 5 um}}
model_error: {error}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With readings of a bubble whose gas is more by e^0.8 from the top of its first rebound on."""
    model = BubbleModel(law=NeoHookeanKelvinVoigt(), start="laser", gas="polytropic")
    theta = {name: np.array([value]) for name, value in TRUTH.items()}
    (path,) = model.trajectories(model.initial_states(theta), TIMES)
    collapse = int(np.argmin(path["R"][:35]))
    top = collapse + int(np.argmax(path["R"][collapse : collapse + 12]))
    changed = PiecewiseModel(model, [StateChanges.of(model, Field("gas"), [float(TIMES[top])], 0.7, relative=True)])
    theta |= {"gas_change_1": np.array([MORE_GAS])}
    (path,) = changed.trajectories(changed.initial_states(theta), TIMES)
    radii = path["R"] + ERROR * np.random.default_rng(3).standard_normal(len(TIMES))
    folder = tmp_path_factory.mktemp("gas")
    rows = [f"{1e6 * t:.9g},{1e6 * R:.9g}" for t, R in zip(TIMES, radii, strict=True)]
    (folder / "bubble.csv").write_text("\n".join(["t_us,R_um", *rows]) + "\n")
    return folder


def problem_of(folder, error="{}", to="minimum 3"):
    path = folder / "bubble.yaml"
    path.write_text(YAML.format(error=error, to=to))
    return build(load_config(path))[0]


def fitted(problem):
    """How far ln mu is from its truth, in standard deviations, and its standard deviation."""
    analysis = assimilate(problem, AssimilationSettings(what_if=False), 1)
    ln_mu = np.log(analysis.posterior[:, problem.prior.names.index("mu")])
    return analysis, (ln_mu.mean() - math.log(TRUTH["mu"])) / ln_mu.std(ddof=1)


@pytest.mark.slow
def test_the_change_and_the_viscosity_are_found(folder):
    problem = problem_of(folder, "{gas: {at: maxima, std: 70 %}}")
    analysis, off = fitted(problem)
    change = analysis.posterior[:, problem.prior.names.index("gas_change_1")]
    assert abs(off) < 2.5
    assert abs(change.mean() - MORE_GAS) < 2.5 * change.std(ddof=1)
    assert change.std(ddof=1) < 0.1
    assert analysis.log_evidence_change is None  # nobody asks whether what is unforeseen changes
    constant, blind = fitted(problem_of(folder))
    assert abs(blind) > 10
    assert analysis.log_evidence > constant.log_evidence + 50


def test_knots_are_the_highest_readings_between_minima(folder):
    problem = problem_of(folder, "{gas: {at: maxima, std: 70 %}}")
    (gas,) = problem.varying
    y, t = problem.observations.values, problem.observations.times
    lowest = [i for i in range(3, len(y) - 3) if y[i] == min(y[i - 3 : i + 4])]
    tops = [begin + int(np.argmax(y[begin:end])) for begin, end in zip(lowest, [*lowest[1:], len(y)], strict=True)]
    assert gas.knots == tuple(t[tops])
    assert len(gas.knots) == 2
    assert problem.prior.std[-1] == pytest.approx(0.7)


@pytest.mark.parametrize("to", ["minimum 2", "minimum 3"])
def test_what_follows_the_window_may_change_beyond_what_was_estimated(folder, to):
    """Members whose gas changed by nothing at the first maximum expect of later readings what those expect for whom
    that is not estimated: a change at the last maximum, which is the first one or not.
    """
    (gas,) = problem_of(folder, "{gas: {at: maxima, std: 70 %}}", "minimum 2").varying
    plain, estimated = (
        problem_of(folder, to=to),
        problem_of(folder, f"{{gas: {{at: [{gas.knots[0]} s], std: 70 %}}}}", to),
    )
    at = plain.prior.from_physical(np.array([list(TRUTH.values())]))
    found = [
        predict_withheld(problem, np.repeat(np.hstack([at, zero]), 48, axis=0), SerialExecutor())
        for problem, zero in ((estimated, np.zeros((1, 1))), (plain, np.empty((1, 0))))
    ]
    for which in ("low", "median", "high"):
        one, other = (getattr(withheld, which) for withheld in found)
        np.testing.assert_allclose(one, other, rtol=1e-5)
    assert np.max(found[0].high - found[0].low) > 5 * ERROR


@pytest.mark.parametrize(
    ("error", "to", "words"),
    [
        ("{gas: {at: maxima, std: 0.7}}", "minimum 3", r"model_error\.gas\.std: .*give the std in %"),
        (
            "{gas: {at: maxima, std: 70 %}}",
            "minimum 1",
            r"model_error\.gas\.at: there is no maximum between two minima",
        ),
        ("{gases: {at: maxima, std: 70 %}}", "minimum 3", r"unknown field 'gases' of the state; did you mean 'gas'"),
        ("{viscosity: {at: maxima, std: 70 %}}", "minimum 3", "unknown field 'viscosity' of the state"),
    ],
)
def test_what_is_refused(folder, error, to, words):
    with pytest.raises(ConfigError, match=words):
        problem_of(folder, error, to)
