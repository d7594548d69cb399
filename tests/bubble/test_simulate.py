"""The public function: shapes, units, messages."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import en4dvar_bubble
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import api
from en4dvar_bubble.medium import CONSTANT_SETS, UNITS, WATER_25C, known_medium

GEL = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}
TIMES = np.linspace(5e-6, 30e-6, 7)


def test_dataset_has_si_fields_with_units_and_the_parameters():
    data = en4dvar_bubble.simulate(parameters={**GEL, "G": [5e3, 6e3, 7e3]}, times=TIMES)
    assert data.sizes == {"member": 3, "time": 7}
    assert {n: data[n].attrs["units"] for n in ("R", "Rdot", "p_b", "time", "G", "R0")} == {
        "R": "m", "Rdot": "m s-1", "p_b": "Pa", "time": "s", "G": "Pa", "R0": "m",
    }  # fmt: skip
    constants = json.loads(data.attrs.pop("constants"))
    assert constants["S"] == {"value": 0.072, "unit": "N/m", "source": WATER_25C.sources["S"]}
    assert set(constants) == set(UNITS)
    assert data.attrs == {
        "law": "quadratic-kelvin-voigt", "start": "acoustic", "gas": "heat", "driving_read": "instantaneous",
        "radial": "keller-miksis", "vapour": "none", "medium_heat": "cold", "wall": "none",
    }  # fmt: skip
    assert (data.status == 0).all()
    assert list(data.reason.values) == ["", "", ""]


@pytest.mark.parametrize(("members", "beside"), [(48, []), (128, [1]), (1000, [1])])
def test_few_members_are_integrated_by_one_thread(members, beside, monkeypatch):
    """That of the caller; others are ``beside`` it."""
    asked = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, workers):
            asked.append(workers)
            super().__init__(workers)

    monkeypatch.setattr(api, "ThreadPoolExecutor", Pool)
    en4dvar_bubble.simulate(parameters={**GEL, "G": np.full(members, 5e3)}, times=TIMES[:1], workers=2)
    assert asked == beside


def test_units_and_names_are_those_of_a_file():
    by_name = en4dvar_bubble.simulate(parameters={**GEL, "G": "6.9 kPa"}, times=TIMES, medium="imr-v2")
    same = en4dvar_bubble.simulate(parameters=GEL, times=TIMES, medium=CONSTANT_SETS["imr-v2"])
    assert by_name.equals(same)
    gel = en4dvar_bubble.simulate(parameters=GEL, times=TIMES, medium="gelatin")
    assert json.loads(gel.attrs["constants"])["rho"]["value"] == pytest.approx(known_medium("gelatin", None).rho)
    with pytest.raises(ConfigError, match="vapour: unknown name 'foo'"):
        en4dvar_bubble.BubbleModel(vapour="foo")


def test_velocity_is_the_derivative_of_the_radius():
    t = np.linspace(10e-6, 20e-6, 1001)
    data = en4dvar_bubble.simulate(parameters=GEL, times=t, accuracy="reference")
    np.testing.assert_allclose(np.gradient(data.R[0], t)[1:-1], data.Rdot[0][1:-1], rtol=2e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": {"G": 1e3, "mu": 0.1}}, r"missing alpha \(1\), R0 \(m\)"),
        ({"parameters": {**GEL, "beta": 1.0}}, "unknown beta"),
        ({"parameters": {**GEL, "G": [1.0, 2.0], "mu": [1.0, 2.0, 3.0]}}, "lengths differ"),
        ({"parameters": {**GEL, "mu": -1.0}}, "mu must lie in"),
        ({"times": [2e-6, 1e-6]}, "increasing"),
        ({"times": [[1e-6, 2e-6]]}, "one-dimensional"),
        ({"times": 1e-6}, "one-dimensional"),
        ({"workers": 0}, "at least 1, not 0"),
        ({"gas": "polytropic", "vapour": "transport"}, "need gas: heat"),
        ({"law": "rubber"}, "unknown law 'rubber'"),
        ({"gas": "polytrope"}, "gas: unknown name 'polytrope'; did you mean 'polytropic'"),
        ({"vapour": "foo"}, "vapour: unknown name 'foo'; known: none, frozen, transport"),
        ({"medium_heat": "foo"}, "medium_heat: unknown name 'foo'; known: cold, conducting"),
        ({"start": "lazer"}, "start: unknown name 'lazer'; did you mean 'laser'"),
        ({"radial": "foo"}, "radial: unknown name 'foo'; known: rayleigh-plesset, "),
        ({"driving_read": "foo"}, "reading: unknown name 'foo'; known: instantaneous, "),
        ({"accuracy": "foo"}, "accuracy: unknown name 'foo'; known: fast, "),
        ({"accuracy": 3}, "accuracy: 3 is no Accuracy"),
        ({"medium": "jelly"}, "medium: unknown name 'jelly'; known: water-25C, "),
        ({"driving": "sine"}, "driving: 'sine' is no Driving"),
        ({"wall": "rigid"}, r"wall: 'rigid' is no Wall"),
        ({"parameters": {**GEL, "G": "4 kg"}}, "parameters: G: '4 kg'"),
        ({"parameters": {**GEL, "G": ["4 kPa"]}}, "parameters: G: could not convert"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(ConfigError, match=message):
        en4dvar_bubble.simulate(**{"parameters": GEL, "times": TIMES, **change})
