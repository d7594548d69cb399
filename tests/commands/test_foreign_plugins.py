"""What packages of other people declare by entry points, wrongly."""

from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import pytest

from en4dvar.commands import plugins
from en4dvar.commands.plugins import COMMANDS, PluginCommand
from en4dvar.config.models import find_model, model_listing
from en4dvar.inputs.text_table import number_in
from en4dvar.plumbing import installed as module
from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar_bubble import get_law


def nothing() -> None:
    """A warm-up that forgot its calls."""


def test_no_package_takes_the_place_of_a_built_in_model(monkeypatch):
    ours = module.installed("en4dvar.models")["bubble"]
    foreign = EntryPoint("bubble", "zzz_pkg:Decay", "en4dvar.models")
    monkeypatch.setattr(module, "_all", lambda: EntryPoints([ours, foreign]))
    assert module.installed("en4dvar.models")["bubble"].value == ours.value


def declared_by(package: str, name: str, value: str, group: str) -> EntryPoint:
    entry = EntryPoint(name, value, group)
    vars(entry).update(dist=SimpleNamespace(name=package))
    return entry


@pytest.mark.parametrize(
    ("group", "ask"),
    [
        ("en4dvar.models", find_model),
        ("en4dvar_bubble.laws", get_law),
        ("en4dvar.simulate", lambda name: plugins.loaded(module.installed("en4dvar.simulate")[name], name)),
        ("en4dvar.commands", lambda name: PluginCommand(module.installed(COMMANDS)[name]).make_context(name, [])),
    ],
)
def test_a_name_of_two_packages_is_told_to_who_asks_for_it_with_both(group, ask, monkeypatch):
    """Whoever asks for another name is not disturbed; what both declare alike is the same thing."""
    rivals = [declared_by(f"{n}-pkg", "decay", f"{n}_pkg.code:Decay", group) for n in ("good", "bad")]
    alike = [declared_by(f"{n}-pkg", "same", "math:pi", group) for n in ("good", "bad")]
    monkeypatch.setattr(module, "_all", lambda: EntryPoints([*rivals, *alike]))
    with pytest.raises(ConfigError) as caught:
        ask("decay")
    told = str(caught.value)
    assert f"'decay' is declared in {group} by bad-pkg (bad_pkg.code:Decay) and good-pkg (good_pkg.code:Decay)" in told
    assert module.installed(group)["same"].value == "math:pi"
    assert not hasattr(module.installed(group)["same"], "rivals")


def test_listings_tell_a_name_of_two_packages_and_warm_up_needs_both(monkeypatch):
    rivals = [declared_by(f"{n}-pkg", "decay", f"{n}_pkg:Decay", "en4dvar.models") for n in ("good", "bad")]
    kernels = [declared_by(f"{n}-pkg", "kernel", f"{n}_pkg:calls", plugins.WARM_UP) for n in ("good", "bad")]
    monkeypatch.setattr(module, "_all", lambda: EntryPoints([*rivals, *kernels]))
    monkeypatch.setattr(plugins, "loaded", lambda entry, what: lambda: {entry.value: print})
    assert "by bad-pkg (bad_pkg:Decay) and good-pkg (good_pkg:Decay)" in model_listing()
    assert [what for what, _ in plugins.examples()] == ["bad_pkg:calls", "good_pkg:calls"]


def test_a_warm_up_without_calls_is_named(monkeypatch):
    entry = EntryPoint("mine", f"{__name__}:nothing", plugins.WARM_UP)
    monkeypatch.setattr(plugins, "installed", lambda group: {"mine": entry})
    monkeypatch.setattr(plugins, "loaded", lambda entry, what: nothing)
    with pytest.raises(En4dvarError, match=r"warm-up of 'mine': .* must return a dict of calls, not None"):
        list(plugins.examples())


def test_the_mark_of_a_spreadsheet_for_no_value_is_blank():
    value = number_in("#N/A", "R", Path("a.csv"), 2, None)
    assert value != value
