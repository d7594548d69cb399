"""The ``model:`` section: resolved configurations load back to themselves, faults are located, constants sourced."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from en4dvar.config import load_config
from en4dvar.config.document import parse_document
from en4dvar.config.load import resolve
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import BubbleModel
from en4dvar_bubble.medium import CONSTANT_SETS, MEDIA, UNITS, known_medium
from en4dvar_bubble.settings import BubbleSettings, ConstantsSettings, MediumName

HEAD = "name: x\nmodel:\n  name: bubble\n"
TAIL = """parameters:
  G: {prior: lognormal, median: 5 kPa, log_std: 0.5}
  alpha: 0.02
  mu: 0.1 Pa s
  R0: 1 um
simulate: {times: {to: 30 us, step: 1 us}}
"""
LASER = """parameters:
  G: 5 kPa
  alpha: 0.02
  mu: {prior: lognormal, median: 0.1 Pa s, log_std: 0.5}
  R_eq: 20 um
  R_max: 200 um
simulate: {times: {to: 30 us, step: 1 us}}
"""
VARIANTS = {
    "defaults": "",
    "histotripsy": "  driving: {amplitude: -20 MPa, exponent: 3}\n",
    "none": "  driving: none\n",
    "sine": "  driving: {kind: sine, amplitude: 1 MPa, frequency: 1 MHz, cycles: 3}\n",
    "tukey": "  driving: {kind: sine, amplitude: 1 MPa, frequency: 1 MHz, cycles: 3.3, envelope: tukey, taper: 0.1}\n",
    "gaussian": "  driving: {kind: gaussian, amplitude: -1 MPa, delay: 5 us, width: 0.3 us}\n",
    "step": "  driving: {kind: step, amplitude: 50 kPa, duration: 1 ms, rise: 0.1 us}\n",
    "tabulated": "  driving:\n    kind: tabulated\n    file: p.csv\n    scale: 2\n    columns: "
    "{time: {name: t, unit: us}, pressure: {name: p, unit: MPa}}\n",
    "vapour pressure": "  vapour_pressure: 3.17 kPa\n",
    "saturated": "  vapour_pressure: saturated\n",
    "constant set": "  constants: imr-v2\n",
    "constants": "  constants: {set: imr-v1, S: 0.06 N/m, kappa: 1.3, sources: {S: pendant drop}}\n",
    "medium": "  medium: polyacrylamide\n",
    "medium at a concentration": "  medium: {name: peg, concentration: 30 %}\n  constants: {S: 0.06 N/m}\n",
    "accuracy": "  accuracy: fast\n  nodes: 6\n  rtol: 1e-6\n  mach_limit: 3\n",
}


def load(text, folder, name="c.yaml"):
    (folder / "p.csv").write_text("t,p\n0,0\n1,-1\n2,-3\n3,-1\n4,0\n", encoding="utf-8")
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def fault(section, folder):
    with pytest.raises(ConfigError) as caught:
        load(HEAD + section + TAIL, folder)
    assert len(caught.value.problems) == 1
    return caught.value.problems[0]


class TestRoundTrip:
    @pytest.mark.parametrize("variant", VARIANTS)
    def test_resolved_configuration_loads_back_to_itself(self, variant, tmp_path):
        config = load(HEAD + VARIANTS[variant] + TAIL, tmp_path)
        elsewhere = tmp_path / "run"
        elsewhere.mkdir()
        again = load(config.resolved, elsewhere)
        assert again.resolved == config.resolved
        assert same(again.model, config.model)

    def test_laser(self, tmp_path):
        config = load(HEAD + "  start: laser\n  vapour_pressure: 2 kPa\n" + LASER, tmp_path)
        assert "kind: none" in config.resolved
        again = resolve(parse_document(config.resolved), tmp_path)
        assert again.resolved == config.resolved
        assert same(again.model, config.model)

    def test_a_laser_bubble_may_be_driven(self, tmp_path):
        section = "  start: laser\n  driving: {kind: gaussian, amplitude: 1 kPa, delay: 9 us, width: 1 us}\n"
        assert load(HEAD + section + LASER, tmp_path).model.driving.amplitude == 1e3

    def test_two_models_that_differ_are_told_apart(self, tmp_path):
        one = load(HEAD + VARIANTS["sine"] + TAIL, tmp_path).model
        assert not same(one, load(HEAD + VARIANTS["tukey"] + TAIL, tmp_path).model)


def same(a: BubbleModel, b: BubbleModel) -> bool:
    return (
        np.array_equal(a.driving.table, b.driving.table)
        and np.array_equal(a.driving.breaks, b.driving.breaks)
        and a.driving.amplitude == b.driving.amplitude
        and (a.medium, a.medium.sources, a.accuracy, a.gas, a.start, a.reading)
        == (b.medium, b.medium.sources, b.accuracy, b.gas, b.start, b.reading)
    )


class TestFaults:
    @pytest.mark.parametrize(
        ("section", "path", "message", "line"),
        [
            ("  driving: {kind: sin, amplitude: 1 MPa}\n", "model.driving.kind", "did you mean 'sine'?", 4),
            ("  driving: triangle\n", "model.driving.kind", "'triangle' is not one of none, histotripsy", 4),
            (
                "  driving:\n    kind: sine\n    amplitude: 1 MPa\n    frequency: 1 MHz\n    cycle: 3\n    cycles: 3\n",
                "model.driving.cycle", "unknown key 'cycle'; did you mean 'cycles'?", 8,
            ),
            (
                "  driving: {kind: sine, amplitude: 1 MPa, frequency: 1 us, cycles: 3}\n",
                "model.driving.frequency", "cannot be converted to 'Hz'", 4,
            ),
            ("  driving: {kind: gaussian, amplitude: 1 MPa, delay: 1 us}\n", "model.driving.width", "required", 4),
            (
                "  driving: {kind: sine, amplitude: 1 MPa, frequency: 1 MHz, cycles: 2.2}\n",
                "model.driving", "jumps at its end", 4,
            ),
            (
                "  driving: {kind: tabulated, file: q.csv, columns: {time: {name: t, unit: us}, "
                "pressure: {name: p, unit: MPa}}}\n",
                "model.driving", "no such file; the folder holds p.csv", 4,
            ),
            (
                "  driving: {kind: tabulated, file: p.csv, columns: {time: {name: t, unit: us}, "
                "pressure: {name: q, unit: MPa}}}\n",
                "model.driving", "no column 'q'; the columns are: t, p", 4,
            ),
            (
                "  driving: {kind: tabulated, file: p.csv, columns: {time: {name: t}, "
                "pressure: {name: p, unit: Pa}}}\n",
                "model.driving.columns.time.unit", "required", 4,
            ),
            (
                "  driving: {kind: tabulated, file: p.csv, columns: {time: {name: t, unit: us}, "
                "pressure: {name: p, unit: mm}}}\n",
                "model.driving.columns.pressure.unit", "cannot be converted to 'Pa'", 4,
            ),
            ("  driving: {kind: gaussian, amplitude: 1 kPa, delay: 0 s, width: .inf}\n", "model.driving.width", "", 4),
            ("  constants: water\n", "model.constants", "'water' is not one of water-25C, imr-v1, imr-v2", 4),
            ("  constants: {set: imr-v22}\n", "model.constants.set", "did you mean 'imr-v2'?", 4),
            ("  constants: {rho: 998}\n", "model.constants.rho", "998 has no unit", 4),
            ("  constants: {surface_tension: 0.05 N/m}\n", "model.constants.surface_tension", "did you mean 'S'?", 4),
            ("  constants: {sources: {roh: me}}\n", "model.constants.sources", "did you mean 'rho'?", 4),
            ("  medium: jelly\n", "model.medium", "'jelly' is not one of water, polyacrylamide", 4),
            ("  medium: {name: peg, concentration: 30 m}\n", "model.medium.concentration", "converted", 4),
            ("  vapour_pressure: 3170\n", "model.vapour_pressure", "3170 has no unit", 4),
        ],
    )  # fmt: skip
    def test_one_located_fault(self, section, path, message, line, tmp_path):
        found = fault(section, tmp_path)
        assert (found.path, found.line) == (path, line)
        assert message in found.message

    def test_a_medium_that_says_nothing_is_refused(self, tmp_path):
        """Beside parameters for both numbers that it gives; beside one of them it gives the other."""
        rho, c = "  rho: 1030 kg/m^3\n", "  c: {prior: lognormal, median: 1.5 km/s, log_std: 0.01}\n"
        tail = TAIL.replace("parameters:\n", f"parameters:\n{rho}{c}")
        with pytest.raises(ConfigError, match=r"model\.medium: not read, for it says rho and c"):
            load(HEAD + "  medium: agarose\n" + tail, tmp_path)
        load(HEAD + "  medium: agarose\n" + tail.replace(rho, ""), tmp_path)
        load(HEAD + tail, tmp_path)


class TestConstants:
    def test_every_constant_of_every_set_has_a_unit_and_a_source(self):
        for medium in CONSTANT_SETS.values():
            assert set(medium.constants) == set(UNITS)
            assert all(medium.sources[name] for name in UNITS)

    def test_a_name_means_its_set(self):
        for name, medium in CONSTANT_SETS.items():
            settings = ConstantsSettings.model_validate(name)
            assert settings.medium == medium
            assert settings.medium.sources == medium.sources

    def test_replaced_constants_say_so(self):
        given = {"set": "imr-v1", "S": "0.06 N/m", "c": "1.5 km/s", "sources": {"c": "our own measurement"}}
        medium = BubbleSettings.model_validate({"constants": given}).liquid
        assert (medium.rho, medium.S, medium.c) == (1060.0, 0.06, 1500.0)
        assert medium.sources["S"] == "given in the configuration"
        assert medium.sources["c"] == "our own measurement"
        assert medium.sources["rho"] == CONSTANT_SETS["imr-v1"].sources["rho"]

    def test_vapour_pressure_follows_the_temperature(self):
        warm = {"vapour_pressure": "saturated", "constants": {"T_inf": "310 K"}}
        assert BubbleSettings.model_validate(warm).liquid.p_v == pytest.approx(1.17e11 * np.exp(-5200 / 310))


class TestMedium:
    """Densities against measurements that the table was not made from."""

    @pytest.mark.parametrize(
        ("name", "fraction", "density", "within"),
        [
            ("peg", 0.05, 1005.7, 1e-3),  # PEG 3000, 298.15 K: J. Korean Chem. Soc. 63 (2019), supplement
            ("peg", 0.20, 1029.7, 1e-3),
            ("polyacrylamide", 0.16, 1.6e6 / 1544, 0.015),  # Lafon et al. (2005): impedance over speed
        ],
    )
    def test_density(self, name, fraction, density, within):
        known = known_medium(name, fraction)
        assert known.rho == pytest.approx(density, rel=within)
        assert known.rho_log_std >= abs(np.log(known.rho / density)) / 2

    def test_a_name_is_all_there_is_to_say(self):
        for name in MEDIA:
            usual, known = known_medium(name), BubbleSettings.model_validate({"medium": name}).liquid
            assert (known.rho, known.c) == (usual.rho, usual.c)
            assert known.sources["rho"] == known.sources["c"] == usual.source
            assert 990 < known.rho < 1080
            assert usual.rho_log_std >= known_medium(name, 0.0).rho_log_std  # what is not said is not known
        assert set(MEDIA) == set(get_args(MediumName))

    def test_constants_go_before(self):
        given = {
            "medium": {"name": "peg", "concentration": "30 %"},
            "constants": {"set": "imr-v1", "rho": "1040 kg/m^3"},
        }
        medium = BubbleSettings.model_validate(given).liquid
        assert (medium.rho, medium.c, medium.S) == (1040.0, known_medium("peg", 0.3).c, 0.056)
        assert "30" in medium.sources["c"] or "0.3" in medium.sources["c"]


def test_constants_of_earlier_versions_are_left_out():
    """They stood in no equation; the resolved configurations of earlier runs record them."""
    old = {"set": "imr-v2", "A_v": "3.3e-05 W/(m K^2)", "B_v": "0.01742 W/(m K)", "sources": {"A_v": "a paper"}}
    assert ConstantsSettings.model_validate(old) == ConstantsSettings.model_validate("imr-v2")
