"""A class of the user's own named in the ``model:`` section: with and without settings, and what does not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import toy_models
from pydantic import BaseModel

from en4dvar.config import load_twin
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, StateLayout
from en4dvar.plumbing.errors import ConfigError

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


class Rateless(Bare):
    observables = (Observable("x", "1", StateField("x", rate_of="v")),)


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


@pytest.mark.parametrize(
    ("kind", "more", "message"),
    [
        (Bare, ", size: 3", "unknown key 'size'"),
        (Sized, "", "missing 1 required positional argument: 'size'; a class that takes arguments needs Settings and"),
        (Half, "", "Settings and from_settings go together, it lacks from_settings"),
        (Blind, "", "the observable 'x' reads 'x_1', which is not in the layout; known: x"),
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
