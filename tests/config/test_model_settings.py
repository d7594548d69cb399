"""A class of the user's own named in the ``model:`` section: with and without settings, and what does not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import toy_models
from pydantic import BaseModel

from en4dvar import estimate
from en4dvar.config import load_twin
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.result import load_result

TWIN = """\
name: bare
model: {{name: "toy_models:{name}"{more}}}
twin: {{cycles: 3, interval: 1 s, error: {{x_std: 1}}, initial_std: {{x: 1}}}}
assimilation: {{scheme: etkf, members: 4}}
"""


class Bare(ForwardModel):
    """Stands still; takes no settings."""

    parameters = ()
    layout = StateLayout((Field("x"),))
    observables = (Observable("x", "1", StateField("x")),)

    def initial_state(self, theta):
        return np.ones(1)

    def step(self, x, t0, t1):
        return x


class Sized(Bare):
    def __init__(self, size):
        raise AssertionError("not reached")


class Half(Bare):
    Settings = BaseModel


class Blind(Bare):
    observables = (Observable("x", "1", StateField("x_1")),)


class Thousandfold(Bare):
    layout = StateLayout((Field("x", unit="m"),))
    observables = (Observable("x", "mm", StateField("x")),)


class Rateless(Bare):
    observables = (Observable("x", "1", StateField("x", rate_of="v")),)


class Apart(Bare):
    time_unit, time_display_unit = "1", "s"


class Miscast(Bare):
    observables = (Observable("x", "1", StateField("x"), display_unit="m"),)


class Drift(Bare):
    """A slope that may change, in times without a unit."""

    parameters = (Parameter("slope", "1"),)
    layout = StateLayout((Field("x"), Field("slope")))
    time_unit = "1"

    def initial_state(self, theta):
        return np.array([0.0, theta["slope"]])

    def step(self, x, t0, t1):
        return x + np.array([x[1] * (t1 - t0), 0])


def test_times_are_shown_in_the_unit_of_the_model_unless_it_says_another(tmp_path):
    model = Drift()
    assert (model.time_display_unit, Bare().time_display_unit) == ("1", "s")
    model.time_unit = "min"
    assert model.time_display_unit == "min"
    t = np.arange(1.0, 7)
    slope = {"prior": "normal", "mean": 1, "std": 1, "varies": {"at": [2.5], "std": 0.3}}
    result = estimate(Drift(), (t, t), {"slope": slope}, error=0.1)
    result = load_result(result.save(tmp_path / "drift.nc"))
    times = result.dataset("prior_predictive")["time"]
    assert (times.attrs["units"], times.attrs["display_units"]) == ("1", "1")
    with pytest.raises(ConfigError, match="Apart: unit and display unit of its times: unit '1' cannot be converted"):
        estimate(Apart(), (t, t), {}, error=0.1)


def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type[ForwardModel], more: str = ""):
    monkeypatch.setattr(toy_models, kind.__name__, kind, raising=False)
    path = tmp_path / "twin.yaml"
    path.write_text(TWIN.format(name=kind.__name__, more=more))
    return load_twin(path)


def test_a_class_without_settings_is_called_without_arguments(tmp_path, monkeypatch):
    config = load(tmp_path, monkeypatch, Bare)
    assert type(config.experiment.model) is Bare
    assert "model:\n  name: toy_models:Bare\n" in config.resolved


class Sheet(Bare):
    """A field of 2 x 3 cells."""

    layout = StateLayout((Field("x", 6),))

    def initial_state(self, theta):
        return np.ones(6)


def test_a_field_on_a_grid_is_localised_in_cells(tmp_path, monkeypatch):
    path = tmp_path / "twin.yaml"
    load(tmp_path, monkeypatch, Sheet)
    text = path.read_text().replace("members: 4", "members: 4, localisation: {radius: 0.5, shape: [2, 3]}")
    path.write_text(text)
    taper = load_twin(path).experiment.sequential.localisation.taper
    assert np.array_equal(taper, np.eye(6))  # a line apart, as 2 and 3 in the order of the state, is far
    path.write_text(text.replace("0.5", "1"))
    taper = load_twin(path).experiment.sequential.localisation.taper
    assert taper[0, 3] == taper[0, 1] == pytest.approx(5 / 24)
    assert taper[2, 3] == 0
    for wrong, message in (
        ("shape: [2, 4]", "2 x 4 cells, but x has 6"),
        ("shape: [2, 3], block_size: 2", "block_size: only"),
    ):
        path.write_text(text.replace("shape: [2, 3]", wrong))
        with pytest.raises(ConfigError, match=message):
            load_twin(path)


def test_a_function_of_the_field_under_its_name_is_not_localised(tmp_path, monkeypatch):
    """Nobody knows where its values are: the first was taken for that of the first cell."""

    class Turned(Sheet):
        observables = (Observable("x", "1", lambda path: path["x"][..., ::-1]),)

    load(tmp_path, monkeypatch, Turned)
    path = tmp_path / "twin.yaml"
    path.write_text(path.read_text().replace("members: 4", "members: 4, localisation: {radius: 1}"))
    with pytest.raises(ConfigError, match=r"this field observed as it is, by StateField\('x'\), and nothing else"):
        load_twin(path)


@pytest.mark.parametrize(
    ("kind", "more", "message"),
    [
        (Bare, ", size: 3", "unknown key 'size'"),
        (Sized, "", "missing 1 required positional argument: 'size'; a class that takes arguments needs Settings and"),
        (Half, "", "Settings and from_settings go together, it lacks from_settings"),
        (Blind, "", "the observable 'x' reads 'x_1', which is not in the layout; known: x"),
        (Apart, "", "Apart: unit and display unit of its times: unit '1' cannot be converted to 's'"),
        (Miscast, "", "Miscast: unit and display unit of x: unit '1' cannot be converted to 'm'"),
        (Thousandfold, "", "the observable 'x' reads 'x', which is in m, not mm; give it that unit, and display_unit"),
        (Rateless, "", "the observable 'x' reads 'v', which is not in the layout"),
    ],
)
def test_what_does_not_fit_is_told_at_its_place(tmp_path, monkeypatch, kind, more, message):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, monkeypatch, kind, more)
    (fault,) = error.value.problems
    assert fault.file.endswith("twin.yaml")
    assert fault.line == 2
    assert message in fault.message
