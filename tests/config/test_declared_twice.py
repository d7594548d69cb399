"""Two things of one name: of a class, and of a law beside the bubble it is in."""

from __future__ import annotations

import re

import numpy as np
import pytest
from toys import Linear

from en4dvar.config.models import checked
from en4dvar.model.state import DISCREPANCY, OF_READINGS, Parameter
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import BubbleModel, NeoHookeanKelvinVoigt, simulate
from en4dvar_bubble.laws.loading import check_law
from en4dvar_bubble.laws.parameters import MU, G
from en4dvar_bubble.numbers import ALL


class Observed(Linear):
    observables = Linear.observables * 2


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (Linear(("a", "b", "a")), "Linear: two parameters are called 'a'"),
        (Observed(), "Observed: two observables are called 'y'"),
    ],
)
def test_a_model_is_refused_by_name(model, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        checked(model)


class Dense(NeoHookeanKelvinVoigt):
    title, parameters = "with a density", (G, MU, Parameter("rho", "kg/m^3"))


def test_a_law_is_refused_where_it_is_used():
    with pytest.raises(ConfigError, match=r"Dense: the parameter name 'rho' is taken .* 'rho_law'"):
        simulate(Dense(), {"G": 1e3, "mu": 0.1, "rho": 1e3, "R0": 1e-6}, np.linspace(0, 1e-6, 3))


@pytest.mark.parametrize("name", ["Z", "R_eq", *(p.name for p in (*ALL, *OF_READINGS, *DISCREPANCY))])
def test_its_check_refuses_every_name_that_is_taken(name):
    law = type("Mine", (NeoHookeanKelvinVoigt,), {"parameters": (G, MU, Parameter(name, "1"))})
    with pytest.raises(ConfigError, match=f"mine: the parameter name '{name}' is taken by"):
        check_law(law, "mine")


def test_what_is_declared_with_its_own_names_is_not_refused():
    assert checked(BubbleModel()).parameters


@pytest.mark.parametrize(
    ("defaults", "words"),
    [
        ({"qq": 1.0}, "Linear: defaults: 'qq' is not one of its parameters; known: a, b"),
        ({"b": "3 cm"}, "Linear: defaults: b is '3 cm'; give a number from -inf to inf m"),
        ({"b": float("nan")}, "Linear: defaults: b is nan; give a number from -inf to inf m"),
        ({"c": -5.0}, "Linear: defaults: c is -5.0; give a number from 0 to 1 m"),
    ],
)
def test_defaults_are_numbers_within_the_bounds_of_its_parameters(defaults, words):
    model = Linear()
    model.defaults = defaults
    model.parameters += (Parameter("c", "m", bounds=(0, 1)),) if "c" in defaults else ()
    with pytest.raises(ConfigError, match=re.escape(words)):
        checked(model)
