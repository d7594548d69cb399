"""The pulse as a function on knots: what the numbers do to p_f, and a known gel that tells the pulse."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator
from scipy.linalg import cholesky

import en4dvar
from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import Accuracy, simulate
from en4dvar_bubble.driving import histotripsy, silence, sine_burst, tabulated, with_knots

KNOTS, STD, LENGTH = 8, 0.15, 1.0  # std of the amplitude, correlation length in knots
NAMES = [f"pulse_knot_{k}" for k in range(1, KNOTS + 1)]
GEL = {"G": 2e3, "mu": 0.02, "R0": 20e-6}
PULSE = {"amplitude": -0.4e6, "frequency": 0.2e6, "exponent": 3.7, "delay": 3e-6}
TIMES = np.arange(0.2e-6, 20e-6, 0.2e-6)
NOISE = 0.1e-6
OPTIONS = {"gas": "polytropic", "accuracy": Accuracy(rtol=1e-9)}
CONFIG = """name: pulse
seed: 1
data:
  path: bubble.csv
  columns: {{time: {{name: t, unit: s}}, radius: {{name: R, unit: m}}}}
  error: {{radius_std: 0.1 um}}
model:
  name: bubble
  law: neo-hookean-kelvin-voigt
  gas: polytropic
  driving: {{kind: histotripsy, amplitude: -0.4 MPa, frequency: 0.2 MHz, delay: 3 us, knots: {knots}}}
parameters:
  G: 2 kPa
  mu: 0.02 Pa s
  R0: 20 um
{lines}
prior_correlation:
  - {{between: [{names}], kernel: gaussian, at: {places}, length: 1}}
output: {{report: false}}
"""


def config(folder, knots=KNOTS):
    lines = "\n".join(f"  {name}: {{prior: normal, mean: 0, std: {STD}}}" for name in NAMES)
    places = list(range(1, KNOTS + 1))
    (folder / "pulse.yaml").write_text(CONFIG.format(knots=knots, lines=lines, names=", ".join(NAMES), places=places))
    return folder / "pulse.yaml"


def drawn(seed):
    """Values at the knots from that prior (Gaussian kernel exp(−d²/2))."""
    place = np.arange(KNOTS)
    correlation = np.exp(-0.5 * ((place[:, None] - place) / LENGTH) ** 2)
    factor = cholesky(correlation + 1e-10 * np.eye(KNOTS), lower=True)
    return STD * factor @ np.random.default_rng(seed).standard_normal(KNOTS)


def members(values):
    return {name: np.atleast_1d(value) for name, value in zip(NAMES, np.transpose(values), strict=True)}


@pytest.mark.parametrize("base", [histotripsy(), sine_burst(1e6, 1e6, cycles=3)])
def test_the_pulse_goes_through_the_knots_and_through_a_trigonometric_polynomial(base):
    """Between the knots against barycentric interpolation: sin(kθ)/sin θ is a polynomial in cos θ."""
    driving, values = with_knots(base, KNOTS), drawn(3)
    share = np.linspace(0, 1, 500)[1:-1]
    t = base.begin + share * (base.end - base.begin)
    more = driving.of_each(t[None], members(values[None]))[0] - base.pressure(t)
    angle = np.pi * np.arange(1, KNOTS + 1) / (KNOTS + 1)
    polynomial = BarycentricInterpolator(np.cos(angle), values / np.sin(angle))
    expected = base.amplitude * polynomial(np.cos(np.pi * share)) * np.sin(np.pi * share)
    np.testing.assert_allclose(more, expected, atol=1e-8 * abs(base.amplitude))


@pytest.mark.slow
def test_paths_are_those_of_a_record_of_the_pulse():
    """Each member's own pulse against the same pressures as a table from a hydrophone."""
    base = histotripsy(**PULSE)
    values = np.array([drawn(1), drawn(2)])
    driving = with_knots(base, KNOTS)
    found = simulate("neo-hookean-kelvin-voigt", {**GEL, **members(values)}, TIMES, driving=driving, **OPTIONS)
    t = np.linspace(base.begin, base.end, 2001)
    for i, own in enumerate(values):
        record = tabulated(t, driving.of_each(t[None], members(own[None]))[0])
        alone = simulate("neo-hookean-kelvin-voigt", GEL, TIMES, driving=record, **OPTIONS)
        np.testing.assert_allclose(found.R[i], alone.R[0], atol=1e-5 * GEL["R0"])


def test_silence_has_no_knots():
    with pytest.raises(ValueError, match="there is no driving that they could change"):
        with_knots(silence(), 3)


def test_a_number_beyond_the_knots_is_refused(tmp_path):
    (tmp_path / "bubble.csv").write_text("t,R\n1e-6,2e-5\n2e-6,2e-5\n")
    with pytest.raises(ConfigError, match="pulse_knot_8"):
        load_config(config(tmp_path, knots=7))


def twin(folder, seed):
    """Instants within the pulse, the true p_f there, and that of the posterior's members (N, K), in Pa."""
    base, truth = histotripsy(**PULSE), members(drawn(seed)[None])
    driving, t = with_knots(base, KNOTS), np.linspace(base.begin, base.end, 101)
    R = simulate("neo-hookean-kelvin-voigt", {**GEL, **truth}, TIMES, driving=driving, **OPTIONS).R.values[0]
    noisy = R + NOISE * np.random.default_rng([35, seed]).standard_normal(len(TIMES))
    rows = [f"{a!r},{b!r}" for a, b in zip(TIMES.tolist(), noisy.tolist(), strict=True)]
    (folder / "bubble.csv").write_text("\n".join(["t,R", *rows]))
    changes = {"execution.workers": 1, "output.directory": str(folder / "run")}
    result = en4dvar.run(config(folder), overrides=changes)
    posterior = {name: result.posterior[name].values.ravel() for name in NAMES}
    found = driving.of_each(np.tile(t, (len(posterior[NAMES[0]]), 1)), posterior)
    return t, driving.of_each(t[None], truth)[0], found


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_a_known_gel_tells_the_pulse(tmp_path):
    """A twin: p_f is told far better than it was known, and is as far off as its bands say."""
    t, true, found = twin(tmp_path, 5)
    before = rms(true - histotripsy(**PULSE).pressure(t))
    off, said = rms(np.median(found, axis=0) - true), rms(found.std(axis=0))
    assert said < 0.25 * before
    assert off < 2 * said


@pytest.mark.slow
@pytest.mark.long
def test_bands_of_the_pulse_hold_it(tmp_path):
    """Of 40 pulses from the prior, 90 % bands hold p_f over 84 to 96 % of the time."""
    inside = []
    for seed in range(100, 140):
        (tmp_path / str(seed)).mkdir()
        _, true, found = twin(tmp_path / str(seed), seed)
        low, high = np.quantile(found, (0.05, 0.95), axis=0)
        inside.append(np.mean((true >= low) & (true <= high)))
    assert 0.84 < np.mean(inside) < 0.96
