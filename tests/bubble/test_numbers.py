"""Numbers of the model as parameters: each does what the same number does as a setting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import WATER_25C, BubbleModel, NeoHookeanKelvinVoigt, get_law, histotripsy, silence, simulate
from en4dvar_bubble.numbers import ALL, NAMES, OF_MEDIUM
from en4dvar_bubble.paths import pack

BASE = {"G": 2e3, "mu": 0.05, "R0": 5e-6}
TIMES = np.linspace(0, 40e-6, 41)
FULL = WATER_25C.with_constants("test", D_p=1.0, D_T=1.75)
MODELS = {
    "heat": BubbleModel(law=NeoHookeanKelvinVoigt()),
    "polytropic": BubbleModel(law=NeoHookeanKelvinVoigt(), gas="polytropic"),
    "gilmore": BubbleModel(law=NeoHookeanKelvinVoigt(), radial="gilmore"),
    "vapour": BubbleModel(law=NeoHookeanKelvinVoigt(), medium=FULL, vapour="transport", medium_heat="conducting"),
}


@pytest.mark.parametrize("kind", MODELS)
def test_constants_reach_the_equations_as_if_they_were_set(kind):
    """What the solver is given, and the state at the start, of two members, the first with the model's own value."""
    model = MODELS[kind]
    theta = {name: np.full(2, value) for name, value in BASE.items()}
    for parameter in model.optional_parameters:
        constant = next((c for c, p in OF_MEDIUM.items() if p is parameter), None)
        if constant is None:
            continue
        usual = getattr(model.medium, constant)
        other = 1.07 * usual or 2000.0
        asked = model.with_parameters([parameter.name])
        x = asked.initial_states({**theta, parameter.name: np.array([usual, other])})
        packed = pack(asked, x, 0.0, TIMES[None].repeat(2, 0))[0]
        for i, value in enumerate((usual, other)):
            set_ = replace(model, medium=replace(model.medium, **{constant: value}))
            y = set_.initial_states(theta)
            np.testing.assert_array_equal(x[i, : y.shape[1]], y[i])
            expected = pack(set_, y, 0.0, TIMES[None].repeat(2, 0))[0]
            np.testing.assert_array_equal(packed.parameters[i], expected.parameters[i], err_msg=parameter.name)
            np.testing.assert_array_equal(packed.initial[i], expected.initial[i], err_msg=parameter.name)
            scaled = packed.samples[i] * packed.factor, expected.samples[i] * expected.factor
            np.testing.assert_allclose(*scaled, rtol=1e-15, err_msg=parameter.name)


@pytest.mark.parametrize("name", ["rho", "surface_tension", "kappa", "p_v", "T_inf"])
def test_paths_are_those_of_the_setting(name):
    constant = next(c for c, p in OF_MEDIUM.items() if p.name == name)
    value = 1.07 * getattr(WATER_25C, constant) or 2000.0
    found = simulate("neo-hookean-kelvin-voigt", {**BASE, name: value}, TIMES)
    expected = simulate("neo-hookean-kelvin-voigt", BASE, TIMES, medium=replace(WATER_25C, **{constant: value}))
    for field in ("R", "Rdot", "p_b", "max_temperature"):
        np.testing.assert_allclose(found[field], expected[field], rtol=1e-9, atol=1e-9)


def test_amplitude_of_the_driving():
    found = simulate("neo-hookean-kelvin-voigt", {**BASE, "p_A": [-20e6, -24e6]}, TIMES)
    for i, amplitude in enumerate((-20e6, -24e6)):
        expected = simulate("neo-hookean-kelvin-voigt", BASE, TIMES, driving=histotripsy(amplitude=amplitude))
        np.testing.assert_array_equal(found["R"][i], expected["R"][0])


def test_gas_content_is_that_of_another_equilibrium_radius_where_nothing_else_depends_on_it():
    """Without a spring R_eq is only the gas: (p∞ + 2S/R) R³ is proportional to its amount."""
    model = BubbleModel(law=get_law("newtonian"), gas="polytropic", start="laser").with_parameters(["gas_content"])
    R = np.array([30e-6, 33e-6])
    amount = (WATER_25C.p_inf + 2 * WATER_25C.S / R) * R**3
    theta = {"mu": np.full(2, 0.05), "R_max": np.full(2, 200e-6), "R_eq": R}
    x = model.initial_states({**theta, "gas_content": np.array([amount[1] / amount[0], 1.0])})
    np.testing.assert_allclose(x[0, model.layout["p_b"]], x[1, model.layout["p_b"]], rtol=1e-14)


def test_a_path_goes_on_from_the_radius_and_velocity_it_has_reached():
    """At the ambient temperature, at which bubbles start, the gas is fixed by its amount."""
    options = {"gas": "isothermal", "driving": silence(), "start": "acoustic"}
    law, times = "neo-hookean-kelvin-voigt", np.linspace(0, 20e-6, 21)
    whole = simulate(law, {**BASE, "R_start": 9e-6}, times, **options)
    assert float(whole["R"].min()) < 5e-6 < float(whole["R"].max())
    again = {"R_start": float(whole["R"][0, 8]), "Rdot_start": float(whole["Rdot"][0, 8])}
    rest = simulate(law, {**BASE, **again}, times[: 21 - 8], **options)
    np.testing.assert_allclose(rest["R"][0], whole["R"][0, 8:], rtol=1e-5)


def test_elastic_stress_at_a_start_away_from_rest():
    model = BubbleModel(law=NeoHookeanKelvinVoigt()).with_parameters(["R_start"])
    x = model.initial_states({**{k: np.full(1, v) for k, v in BASE.items()}, "R_start": np.full(1, 10e-6)})
    stretch = 2.0
    stress = -BASE["G"] * (5 - 4 / stretch - stretch**-4) / 2
    np.testing.assert_allclose(x[0, model.layout["S"]], stress, rtol=1e-6)


def test_the_usual_model_has_no_more_parameters():
    model = BubbleModel()
    assert model.with_parameters(["G", "nothing"]).parameters == model.parameters
    assert {p.name for p in model.optional_parameters} <= {p.name for p in ALL}
    assert "A" not in {p.name for p in MODELS["polytropic"].optional_parameters}


def test_alternatives_leave_out_what_is_a_parameter():
    usual = {a.name for a in BubbleModel().alternatives}
    named = {a.name for a in BubbleModel().with_parameters(["p_A", "surface_tension", "p_inf", "p_v"]).alternatives}
    assert usual - named == {"pulse_amplitude", "surface_tension", "ambient_pressure", "vapour"}


CONFIG = """
name: n
model: {{name: bubble, law: neo-hookean-kelvin-voigt{options}}}
data:
  path: d.csv
  columns: {{time: {{name: t, unit: us}}, radius: {{name: R, unit: um}}}}
  error: {{radius_std: 1 um}}
parameters:
  G: {{prior: lognormal, median: 2 kPa, log_std: 0.5}}
  mu: {{prior: lognormal, median: 0.05 Pa s, log_std: 0.5}}
{radii}
"""
LASER = "  R_eq: 30 um\n  R_max: 200 um"


def _config(tmp_path, radii, options=""):
    path = tmp_path / "n.yaml"
    path.write_text(CONFIG.format(radii=radii, options=options))
    return path


def test_from_yaml(tmp_path):
    asked = "  R0: 5 um\n  p_A: {prior: normal, mean: -24 MPa, std: 10 %}\n  surface_tension: 0.06 N/m"
    config = load_config(_config(tmp_path, asked))
    assert [p.name for p in config.model.parameters] == ["G", "mu", "R0", "surface_tension", "p_A"]
    assert "p_A" in config.resolved


def test_a_number_that_the_equations_lack_is_unknown(tmp_path):
    asked = LASER + "\n  p_A: {prior: normal, mean: -24 MPa, std: 10 %}"
    with pytest.raises(
        ConfigError, match=r"n\.yaml:13:.*unknown parameter 'p_A'; the model has it only with a driving"
    ):
        load_config(_config(tmp_path, asked, ", start: laser"))


@pytest.mark.parametrize(
    ("asked", "needed"),
    [
        ("wall_distance: {from_file: h_um, unit: um}", r"wall: \{distance: …\}"),
        ("accommodation: 0.4", "vapour: transport"),
        ("pulse_width: 1 us", "a driving that has it"),
        ("R_start: 20 um", "start: acoustic"),
    ],
)
def test_of_a_number_that_the_equations_lack_the_setting_is_named(tmp_path, asked, needed):
    with pytest.raises(ConfigError, match=f"unknown parameter '[a-zA-Z_]+'; the model has it only with {needed}"):
        load_config(_config(tmp_path, f"{LASER}\n  {asked}", ", start: laser"))


def test_every_number_is_in_the_equations_or_has_a_setting_that_brings_it():
    model = BubbleModel(law=get_law("newtonian"))
    inside = {p.name for p in model.optional_parameters}
    assert inside.isdisjoint(model.absent_parameters)
    assert inside | set(model.absent_parameters) == NAMES
