"""Modules that moved are still imported by their former names: the same objects, and a warning with the new name."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module

import pytest

from en4dvar.config.models import find_model
from en4dvar.data.series import Series
from en4dvar.model.programs.model import CommandModel
from en4dvar.plumbing.moved import MOVED


@pytest.fixture(autouse=True)
def as_in_a_new_process(monkeypatch):
    inside = tuple(f"{old}." for old in MOVED)
    for name in list(sys.modules):
        if f"{name}.".startswith(inside):
            monkeypatch.delitem(sys.modules, name)


@pytest.mark.parametrize("old", MOVED)
def test_a_former_name_gives_the_module_of_today(old):
    with pytest.warns(DeprecationWarning, match=f"{old} is now {MOVED[old]}"):
        module = import_module(old)
    assert module is import_module(MOVED[old])
    assert module.__name__ == module.__spec__.name == MOVED[old]


def test_a_module_inside_a_folder_that_moved_is_not_loaded_twice():
    with pytest.warns(DeprecationWarning, match=r"is now en4dvar\.series"):
        from en4dvar.cycling.problem import SeriesProblem
    from en4dvar.series.problem import SeriesProblem as OfToday

    assert SeriesProblem is OfToday


def test_the_warning_points_at_the_line_of_the_user():
    with pytest.warns(DeprecationWarning, match="en4dvar.plumbing.units") as told:
        from en4dvar.units import Quantity  # noqa: F401
    assert {warning.filename for warning in told} == {__file__}


def test_the_readings_of_one_observable_are_told_from_a_series_of_cycles():
    with pytest.warns(DeprecationWarning, match=r"en4dvar\.data\.series\.Series") as told:
        from en4dvar.series import Series as Former
    assert Former is Series
    assert told[0].filename == __file__
    with pytest.raises(ImportError, match="nothing"):
        from en4dvar.series import nothing  # noqa: F401


def test_a_model_is_known_by_the_name_that_version_1_0_wrote():
    with pytest.warns(DeprecationWarning, match="en4dvar.model.programs"):
        assert find_model("en4dvar.programs.model:CommandModel") is CommandModel


def test_what_never_was_is_named_as_it_was_asked_for():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ModuleNotFoundError, match="no_such"):
            import_module("en4dvar.programs.no_such")


def test_names_of_today_do_not_warn():
    """Warnings are errors here: this import would raise."""
    for new in MOVED.values():
        import_module(new)


def test_a_name_that_moved_by_itself_warns_and_is_the_same_object() -> None:
    from en4dvar import problem
    from en4dvar.schemes import settings
    from en4dvar.series import moments

    with pytest.warns(DeprecationWarning, match=r"SequentialResult is now en4dvar\.series\.moments\.SequentialState"):
        assert moments.SequentialResult is moments.SequentialState
    with pytest.warns(DeprecationWarning, match="AssimilationSettings is now en4dvar.schemes.settings.Assim"):
        assert problem.AssimilationSettings is settings.AssimilationSettings
    with pytest.warns(DeprecationWarning, match="Localising is now en4dvar.schemes.settings.Localisation"):
        assert problem.Localising is settings.Localisation
    with pytest.raises(AttributeError, match="no attribute 'Problem'"):
        problem.Problem  # noqa: B018
