"""Symbols that are taken as they are, without a question to matplotlib, which takes time to import."""

import re
from importlib.metadata import entry_points

import pytest
from hypothesis import given, settings
from hypothesis.strategies import from_regex
from matplotlib.mathtext import MathTextParser

from en4dvar.config.json_schema import _possible_parameters
from en4dvar.config.models import _SIMPLE, FORMULA, GROUP, find_model


@given(from_regex(re.compile(FORMULA, re.ASCII), fullmatch=True))
@settings(max_examples=100, deadline=None)
def test_what_is_taken_as_it_is_can_be_written(text: str) -> None:
    MathTextParser("path").parse(text)


@pytest.mark.parametrize("name", sorted({entry.name for entry in entry_points(group=GROUP)}))
def test_symbols_of_shipped_models_are_simple(name: str) -> None:
    """Half a second of every start."""
    shown = [text for thing in _possible_parameters(find_model(name)) for text in (thing.symbol, thing.label)]
    assert [text for text in shown if not _SIMPLE.fullmatch(text)] == []
