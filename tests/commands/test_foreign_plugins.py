"""What packages of other people declare by entry points, wrongly."""

from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from en4dvar.commands import plugins
from en4dvar.inputs.text_table import number_in
from en4dvar.plumbing import installed as module
from en4dvar.plumbing.errors import En4dvarError


def nothing() -> None:
    """A warm-up that forgot its calls."""


def test_no_package_takes_the_place_of_a_built_in_model(monkeypatch):
    ours = module.installed("en4dvar.models")["bubble"]
    foreign = EntryPoint("bubble", "zzz_pkg:Decay", "en4dvar.models")
    monkeypatch.setattr(module, "_all", lambda: EntryPoints([ours, foreign]))
    assert module.installed("en4dvar.models")["bubble"].value == ours.value


def test_a_warm_up_without_calls_is_named(monkeypatch):
    entry = EntryPoint("mine", f"{__name__}:nothing", plugins.WARM_UP)
    monkeypatch.setattr(plugins, "installed", lambda group: {"mine": entry})
    monkeypatch.setattr(plugins, "loaded", lambda entry, what: nothing)
    with pytest.raises(En4dvarError, match=r"warm-up of 'mine': .* must return a dict of calls, not None"):
        list(plugins.examples())


def test_the_mark_of_a_spreadsheet_for_no_value_is_blank():
    value = number_in("#N/A", "R", Path("a.csv"), 2, None)
    assert value != value
