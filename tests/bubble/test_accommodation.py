"""Vapour that crosses the wall at a finite rate (Hertz–Knudsen): limits, mass, restarts (oracle: test_full_oracle)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracle_full import p_sat
from reference_cases import LASER, NEO_HOOKEAN

from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar.runs.runner import run
from en4dvar_bubble import WATER_25C, Accuracy, BubbleModel, get_law, simulate
from en4dvar_bubble.medium import GAS_CONSTANT
from en4dvar_bubble.solver.collocation import ball
from en4dvar_bubble.solver.driver import GAS_CLUSTERING

TIGHT = Accuracy(nodes=16, medium_nodes=24, rtol=1e-10)
KINETIC = replace(WATER_25C, D_p=1.0, D_T=1.75)
TIMES = np.linspace(0, 50e-6, 501)  # collapse at 23 µs, maximum of the first rebound near 30 µs, second collapse
R_MAX = LASER["R_max"]


def path(alpha, heat="conducting", medium=WATER_25C, vapour="transport", times=TIMES):
    values = LASER if alpha is None else {**LASER, "accommodation": alpha}
    options = {"start": "laser", "vapour": vapour, "medium_heat": heat, "medium": medium, "accuracy": TIGHT}
    data = simulate(NEO_HOOKEAN, values, times, **options)
    assert not data.status.any()
    return data.R[0].values


@pytest.mark.parametrize(("heat", "medium"), [("cold", KINETIC), ("conducting", WATER_25C)])
def test_limits(heat, medium):
    """None crosses: the vapour of time zero stays, as if it were gas. All crosses: it is saturated at the wall."""
    equilibrium = path(None, heat, medium)
    assert np.abs(path(0.0, heat, medium) - path(None, heat, medium, "frozen")).max() < 1e-8 * R_MAX
    assert np.abs(path(1e9, heat, medium) - equilibrium).max() < 1e-8 * R_MAX
    error = [np.abs(path(alpha, heat, medium) - equilibrium).max() for alpha in (0.4, 1e3, 1e4)]
    assert error[0] > 5e-3 * R_MAX
    assert error[1] / error[2] == pytest.approx(10, rel=0.02)  # of first order in the resistance 1/α


def model_of(medium=WATER_25C, accuracy=TIGHT):
    law = get_law(NEO_HOOKEAN)
    options = {"start": "laser", "vapour": "transport", "medium_heat": "conducting", "medium": medium}
    return BubbleModel(law=law, accuracy=accuracy, **options).with_parameters(["accommodation"])


def integrated(times, alpha=0.1, model=None):
    model = model or model_of()
    x = model.initial_states({name: np.array([value]) for name, value in {**LASER, "accommodation": alpha}.items()})
    paths = model.integrate(x, np.atleast_2d(times))
    assert paths.whole
    return model, paths


@pytest.mark.parametrize(("nodes", "error"), [(16, 5e-4), (32, 1e-5)])
def test_mass(nodes, error):
    """What the bubble gains in vapour has crossed its wall, by the formula of Hertz and Knudsen; the gas stays."""
    times = np.linspace(0, 35e-6, 35_001)  # through the collapse and the first rebound
    _, paths = integrated(times, model=model_of(accuracy=replace(TIGHT, nodes=nodes)))
    R, p, T, C = (paths[name][0] for name in ("R", "p_b", "T", "C"))
    vapour = np.asarray(WATER_25C.mole_fraction(C))
    weights = ball(nodes, GAS_CLUSTERING["laser"]).weights
    volume = 4 / 3 * np.pi * R**3
    moles = [volume * p / GAS_CONSTANT * ((share / T) @ weights) for share in (vapour, 1 - vapour)]
    T_w, M_v = T[:, -1], WATER_25C.M_v
    flux = 0.1 * (p_sat(T_w) - vapour[:, -1] * p) * np.sqrt(M_v / (2 * np.pi * GAS_CONSTANT * T_w)) * 4 * np.pi * R**2
    crossed = np.concatenate([[0.0], np.cumsum((flux[1:] + flux[:-1]) / 2 * np.diff(times))]) / M_v
    assert moles[0].min() < 0.2 * moles[0][0]  # most of it condensed
    np.testing.assert_allclose(moles[0] - moles[0][0], crossed, rtol=0, atol=error * moles[0][0])
    np.testing.assert_allclose(moles[1], moles[1][0], rtol=1e-12)


def test_a_path_goes_on_from_any_of_its_states():
    times = np.array([0.0, 10e-6, 22.9e-6, 40e-6])
    model, paths = integrated(times)
    for i in (1, 2):
        again = model.step(paths.states[0, i], times[i], times[-1])
        np.testing.assert_allclose(again[0], paths["R"][0, -1], rtol=1e-6)


def test_gas_that_is_set_free_leaves_temperatures_and_adds_to_the_pressure():
    model, paths = integrated(np.array([0.0, 15e-6]))
    x = paths.states[:, 1]
    where = model.layout["C"].stop - 1
    after = model.changed("gas", x, np.array([np.log(2.0)]))
    p, vapour = ((y[0, model.layout["p_b"].start], float(model.medium.mole_fraction(y[0, where]))) for y in (x, after))
    assert p[0] * p[1] == pytest.approx(vapour[0] * vapour[1], rel=1e-12)  # the vapour's partial pressure
    assert vapour[0] * (1 - vapour[1]) == pytest.approx(2 * p[0] * (1 - p[1]), rel=1e-12)
    assert model.integrate(after, np.array([[40e-6]]), 15e-6).whole


def test_of_millimetres_in_water_complete_where_equilibrium_needs_a_smeared_grid():
    """Priors that water has, see test_violent."""
    rng, times = np.random.default_rng(0), np.linspace(1e-6, 480e-6, 240)
    mu, R_eq = 2e-3 * np.exp(1.5 * rng.standard_normal(48)), 60e-6 * np.exp(rng.standard_normal(48))
    values = {"mu": mu, "R_eq": np.minimum(R_eq, 6e-4), "R_max": 1.2e-3, "accommodation": 0.4}
    options = {"start": "laser", "vapour": "transport", "medium_heat": "conducting"}
    assert not simulate("newtonian", values, times, **options).status.any()


CONFIG = """
name: n
model: {name: bubble, law: newtonian, start: laser, vapour: transport, medium_heat: conducting}
data:
  path: d.csv
  columns: {time: {name: t, unit: us}, radius: {name: R, unit: um}}
  error: {radius_std: 1 um}
parameters:
  mu: {prior: lognormal, median: 2 mPa s, log_std: 1.5}
  R_eq: 60 um
  R_max: 1200 um
  accommodation: VALUE
"""


@pytest.mark.parametrize("value", ["0.4", "{prior: logit, lower: 0, upper: 1, median: 0.4, logit_std: 1}"])
def test_from_yaml_fixed_or_estimated(tmp_path, value):
    file = tmp_path / "n.yaml"
    file.write_text(CONFIG.replace("VALUE", value))
    model = load_config(file).model
    assert "accommodation" in [p.name for p in model.parameters]
    assert model.system.kinetic
    assert not replace(model, vapour="frozen").system.kinetic


WATER = """\
name: water
seed: 1
data:
  path: radii.csv
  columns: {time: {name: t, unit: us}, radius: {name: R, unit: um}}
  error: {radius_std: 2 % of maximum}
model:
  name: "MODEL"
  law: newtonian
  start: laser
  vapour: transport
  medium_heat: conducting
  radial: gilmore
parameters:
  mu: {prior: lognormal, median: 2 mPa s, log_std: 0.5}
  R_eq: {prior: lognormal, median: 60 um, log_std: 0.3}
  R_max: {prior: normal, mean: 1200 um, std: 1 %}
  accommodation: {prior: lognormal, median: 0.2, log_std: 0.5}
assimilation: {members: 24, max_iterations: 1, emulator: "off", refine: none, what_if: false}
output: {report: false}
"""


class Unsure(BubbleModel):
    """A bubble whose radii of the start are wrong by 1e-6, otherwise each time."""

    def prepared(self, x, times, t0=0.0):
        return super().prepared(x * (1 + 1e-6 * np.random.default_rng().standard_normal((len(x), 1))), times, t0)


@pytest.mark.parametrize("radial", ["keller-miksis", "gilmore"])
def test_members_do_not_influence_each_other(radial):
    """The collapse of a bubble in water makes 1e-6 of R_max of the last digit of Y_w at time zero."""
    law, random = get_law("newtonian"), np.random.default_rng(1)
    options = {"start": "laser", "vapour": "transport", "medium_heat": "conducting", "radial": radial}
    model = BubbleModel(law=law, **options).with_parameters(["accommodation"])
    spread = {"mu": (2e-3, 0.5), "R_eq": (60e-6, 0.3), "R_max": (1.2e-3, 0.01), "accommodation": (0.2, 0.5)}
    x = model.initial_states({k: a * np.exp(b * random.standard_normal(16)) for k, (a, b) in spread.items()})
    times = np.broadcast_to(np.linspace(0, 300e-6, 61), (16, 61))
    together = model.integrate(x, times)
    for i in range(16):
        alone = model.integrate(x[i : i + 1], times[:1])
        for name in ("R", "p_b", "C", "T_m"):
            np.testing.assert_array_equal(alone[name][0], together[name][i], name)


@pytest.mark.parametrize("sure", [pytest.param(True, marks=pytest.mark.slow), False])
def test_run_accepts_what_is_not_random(tmp_path, sure):
    times = np.linspace(0, 300, 31)
    radii = simulate(
        "newtonian", {"mu": 2e-3, "R_eq": 60e-6, "R_max": 1.2e-3}, times * 1e-6, start="laser", gas="polytropic"
    ).R.values[0]
    rows = [f"{t:.6g},{R * 1e6:.6g}" for t, R in zip(times, radii, strict=True)]
    (tmp_path / "radii.csv").write_text("\n".join(["t,R", *rows, ""]))
    (tmp_path / "water.yaml").write_text(WATER.replace("MODEL", "bubble" if sure else "test_accommodation:Unsure"))
    config = load_config(tmp_path / "water.yaml", {"output.directory": str(tmp_path / "run")})
    if sure:
        assert np.isfinite(run(config).posterior["mu"]).all()
    else:
        with pytest.raises(ConfigError, match="the model gives other numbers when a member is run again"):
            run(config)
