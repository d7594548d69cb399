"""Delay, rate and shape of the driving as parameters: each does what the same number does as a key of the pulse."""

from __future__ import annotations

import numpy as np
import pytest
from test_numbers import BASE, CONFIG

from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import Accuracy, BubbleModel, NeoHookeanKelvinVoigt, simulate
from en4dvar_bubble.driving import gaussian, histotripsy, silence, sine_burst, step, tabulated

TIMES = np.linspace(0, 30e-6, 31)
LAW = "neo-hookean-kelvin-voigt"
OPTIONS = {"gas": "polytropic", "accuracy": Accuracy(rtol=1e-9)}
RECORD = np.linspace(0, 6e-6, 61)
PRESSURE = -1e6 * np.sin(2 * np.pi * RECORD / 6e-6) ** 2 * (1 + 0.3 * np.cos(RECORD / 1e-6))


def record(delay=4e-6, stretch=1.0):
    """A record of 6 µs."""
    return tabulated(stretch * RECORD, PRESSURE, delay)


HANN = {"amplitude": -2e6, "frequency": 1e6, "cycles": 4.0, "delay": 3e-6, "phase": 0.5, "envelope": "hann"}
PULSES = {
    "histotripsy": (histotripsy, {"frequency": 1e6, "exponent": 3.7, "delay": 5e-6}),
    "hann": (
        lambda **keys: sine_burst(**{**HANN, **keys}),
        {key: HANN[key] for key in ("frequency", "cycles", "delay", "phase")},
    ),
    "tukey": (lambda **keys: sine_burst(**{**HANN, "envelope": "tukey", **keys}), {"cycles": 4.0, "phase": 0.5}),
    "burst": (
        lambda **keys: sine_burst(**{**HANN, "envelope": "none", "phase": 0.0, **keys}),
        {"frequency": 1e6, "delay": 3e-6},
    ),
    "gaussian": (
        lambda **keys: gaussian(**{"amplitude": -1e6, "delay": 8e-6, "width": 1e-6, **keys}),
        {"delay": 8e-6, "width": 1e-6},
    ),
    "step": (
        lambda delay=2e-6, duration=5e-6: step(-2e5, duration, delay, duration / 10),
        {"delay": 2e-6, "duration": 5e-6},
    ),
    "record": (record, {"delay": 4e-6, "stretch": 1.0}),
}
CASES = [(kind, key) for kind, (_, keys) in PULSES.items() for key in keys]


def radii(driving, **more):
    """ln R (N, K), independent of how large the bubble becomes."""
    return np.log(simulate(LAW, {**BASE, **more}, TIMES, driving=driving, **OPTIONS)["R"].values)


@pytest.mark.parametrize("kind", PULSES)
def test_those_of_a_pulse(kind):
    made, keys = PULSES[kind]
    named = {p.name for p in BubbleModel(driving=made()).optional_parameters if p.name.startswith("pulse_")}
    assert named >= {f"pulse_{key}" for key in keys}
    assert kind != "burst" or named == {"pulse_frequency", "pulse_delay"}  # its shape would jump at the ends
    assert kind != "histotripsy" or named == {f"pulse_{key}" for key in keys}


@pytest.mark.parametrize(("kind", "key"), CASES)
def test_paths_and_derivatives_are_those_of_the_key(kind, key):
    """Against runs of a pulse that is made with the number: both the path and its derivative with respect to it."""
    made, keys = PULSES[kind]
    values = [0.98 * keys[key], 1.03 * keys[key]]
    found = radii(made(), **{f"pulse_{key}": values})
    expected = np.concatenate([radii(made(**{key: value})) for value in values])
    scale = np.abs(expected[1] - expected[0]).max()
    assert scale > 1e-3  # it matters
    np.testing.assert_allclose(found, expected, atol=1e-5 * scale)
    np.testing.assert_allclose(found[1] - found[0], expected[1] - expected[0], atol=1e-5 * scale)


def test_all_of_them_together():
    found = radii(histotripsy(), p_A=-20e6, pulse_frequency=0.8e6, pulse_exponent=3.0, pulse_delay=6e-6)
    np.testing.assert_allclose(found, radii(histotripsy(-20e6, 0.8e6, 3.0, 6e-6)), atol=1e-7)


def test_at_their_own_values_they_change_no_bit():
    usual = radii(histotripsy())
    assert radii(histotripsy(), pulse_frequency=1e6, pulse_exponent=3.7, pulse_delay=5e-6).tobytes() == usual.tobytes()


def test_parameters_have_unit_bounds_and_label():
    model = BubbleModel(law=NeoHookeanKelvinVoigt(), driving=PULSES["hann"][0]())
    cycles = next(p for p in model.optional_parameters if p.name == "pulse_cycles")
    assert (cycles.unit, cycles.bounds, cycles.transform, cycles.label) == (
        "1",
        (0.0, 1000.0),
        "lognormal",
        "cycles of the pulse",
    )
    frequency = next(p for p in model.optional_parameters if p.name == "pulse_frequency")
    assert (frequency.unit, frequency.display_unit, frequency.bounds[0]) == ("Hz", "MHz", 0.0)
    assert not [p for p in BubbleModel(driving=silence()).optional_parameters if p.name.startswith("pulse_")]


def _config(tmp_path, line):
    path = tmp_path / "n.yaml"
    path.write_text(CONFIG.format(radii=f"  R0: 5 um\n  {line}", options=""))
    return path


def test_from_yaml(tmp_path):
    config = load_config(_config(tmp_path, "pulse_frequency: {prior: lognormal, median: 1 MHz, log_std: 0.05}"))
    assert config.model.parameters[-1].name == "pulse_frequency"


def test_a_name_that_is_nearly_right(tmp_path):
    with pytest.raises(
        ConfigError, match=r"n\.yaml:12:.*unknown parameter 'pulse_frequencies'.*did you mean 'pulse_frequency'"
    ):
        load_config(_config(tmp_path, "pulse_frequencies: 1 MHz"))
