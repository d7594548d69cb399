"""Mistakes in what a model of the user's own declares: each is a sentence with the class and what to give instead."""

import re

import numpy as np
import pytest
import toy_models
from pydantic import BaseModel
from toys import Linear, make_problem

from en4dvar.config.models import NoSettings, build_model, find_model
from en4dvar.diagnosis.honesty.examine import doubts
from en4dvar.ensemble.forecast import forecast
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.plumbing.errors import ConfigError, En4dvarError

A = Parameter("A", "m")
X = Observable("x", "m", StateField("x"))


class Undeclared(ForwardModel):
    def initial_state(self, theta):
        return np.array([theta["A"]])

    def step(self, x, t0, t1):
        return x


class Sound(Undeclared):
    parameters = (A,)
    layout = StateLayout((Field("x", unit="m"),))
    observables = (X,)


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("layout", (Field("x"),), "layout is (Field("),
        ("layout", None, "layout is None; give StateLayout((Field(…), …))"),
        ("parameters", A, "; give a tuple of Parameter"),
        ("parameters", ("A",), "parameters is ('A',); give a tuple of Parameter"),
        ("parameters", lambda model: (A,), "; give a tuple of Parameter"),
        ("parameters", (A, A), "two parameters are called 'A'"),
        ("observables", X, "; give a tuple of Observable"),
        ("observables", (), "observables is (); give one Observable at least"),
        ("observables", (Observable("x", "m", "x"),), "the operator of x is 'x', which cannot be called; give"),
        ("observables", (Observable("x", None, StateField("x")),), "display unit of x: a unit is a text such as 'm/s'"),
        ("optional_parameters", ("q",), "optional_parameters is ('q',); give a tuple of Parameter"),
        ("validity", ("x",), "validity is ('x',); give a tuple of ValidityLimit"),
        ("alternatives", ("x",), "alternatives is ('x',); give a tuple of Alternative"),
        ("path_quantities", "x", "path_quantities is 'x'; give a tuple of PathQuantity"),
        ("path_parameters", ("k",), "path_parameters: 'k' is not in the layout; known: x"),
        ("defaults", None, "defaults is None; give a dict"),
        ("known_by", ("q",), "known_by is ('q',); give a dict"),
        ("unforeseen", ("q",), "unforeseen is ('q',); give a dict"),
        ("time_unit", None, "its times: a unit is a text"),
    ],
)
def test_a_declaration_of_another_type_is_named(attribute, value, words):
    kind = type("Wrong", (Sound,), {attribute: value})
    with pytest.raises(ConfigError, match=rf"^Wrong: .*{re.escape(words)}"):
        build_model(kind, NoSettings())


def test_a_declaration_that_is_missing_is_named():
    with pytest.raises(ConfigError, match="Undeclared: it has no parameters; give a tuple of Parameter"):
        build_model(Undeclared, NoSettings())
    with pytest.raises(ConfigError, match=r"Still has neither step nor trajectories; write one of them$"):
        build_model(type("Still", (Sound,), {"step": ForwardModel.step}), NoSettings())
    with pytest.raises(ValueError, match=re.escape("StateLayout((Field('x'), …)), not of ('x', 'v')")):
        StateLayout(("x", "v"))


@pytest.mark.parametrize(
    ("from_settings", "words"),
    [
        (classmethod(lambda cls, settings: None), "Made.from_settings returned None; return the model, such as cls(…)"),
        (classmethod(lambda cls, settings: {"a": 1}), "Made.from_settings returned {'a': 1}; return the model"),
        (classmethod(lambda cls, settings: cls({}["rtol"])), "Made cannot be made: KeyError: 'rtol' ("),
        (
            classmethod(lambda cls, settings: settings.size),
            "Made cannot be made: AttributeError: 'Settings' object",
        ),
        (lambda cls, settings: cls(), "write @classmethod above its from_settings(cls, settings)"),
    ],
)
def test_a_mistake_in_from_settings_is_told_with_its_line(from_settings, words, monkeypatch):
    class Settings(BaseModel):
        pass

    made = type("Made", (Sound,), {"from_settings": from_settings, "Settings": Settings})
    monkeypatch.setattr(toy_models, "Made", made, raising=False)
    with pytest.raises(ConfigError) as caught:
        build_model(find_model("toy_models:Made"), Settings())
    assert words in str(caught.value)
    assert "Error: " not in words or f"{__file__}:" in str(caught.value)


def test_the_line_is_not_that_of_a_library_of_another_environment(tmp_path, monkeypatch):
    """As of a user's site, or of the Python below an environment with ``--system-site-packages``."""
    (tmp_path / "site-packages").mkdir()
    (tmp_path / "site-packages" / "borrowed.py").write_text("def size(settings):\n    return settings.size\n")
    monkeypatch.syspath_prepend(tmp_path / "site-packages")
    from borrowed import size

    asks = classmethod(lambda cls, settings: size(settings))
    made = type("Made", (Sound,), {"from_settings": asks, "Settings": NoSettings})
    monkeypatch.setattr(toy_models, "Made", made, raising=False)
    with pytest.raises(ConfigError, match=re.escape(f"({__file__}:")):
        build_model(find_model("toy_models:Made"), NoSettings())


def test_settings_that_are_no_pydantic_model_are_refused(monkeypatch):
    made = type("Made", (Sound,), {"from_settings": classmethod(lambda cls, s: cls()), "Settings": {"rtol": 1}})
    monkeypatch.setattr(toy_models, "Made", made, raising=False)
    with pytest.raises(ConfigError, match=r"its Settings are \{'rtol': 1\}; make them a subclass of pydantic"):
        find_model("toy_models:Made")


def test_a_parameter_that_initial_state_asks_for_and_the_model_lacks_is_named(monkeypatch):
    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    monkeypatch.setattr(Linear, "initial_state", lambda self, theta: theta["damping"])
    (reason,) = set(forecast(problem, problem.prior.sample(4, 0)).failures)
    assert reason.startswith(f"initial_state asks for a parameter 'damping'; known: a, b ({__file__}:")


@pytest.mark.parametrize(
    ("method", "words"),
    [
        (lambda *asked: None, "Linear.doubts returned None; return a list of texts"),
        (lambda *asked: "high", "Linear.doubts returned 'high'; return a list of texts"),
        (lambda *asked: {}["scale"], "Linear.doubts: KeyError: 'scale' ("),
    ],
)
def test_doubts_that_are_no_list_of_texts_are_named(method, words, monkeypatch):
    problem = make_problem(Linear(("a", "b")), [1.0, 1.0])
    monkeypatch.setattr(Linear, "doubts", method)
    with pytest.raises(En4dvarError) as caught:
        doubts(problem, np.ones((3, 2)), np.ones((3, len(problem.observations))))
    assert words in str(caught.value)
