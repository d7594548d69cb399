"""A scheme owns its keys: what it does not read is an error that names it and who reads the key."""

from __future__ import annotations

import ast
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from syntax import nodes
from toys import Decay, make_problem

from en4dvar import AssimilationSettings
from en4dvar.config import load_config, load_twin
from en4dvar.config.load import recorded
from en4dvar.config.schema import Assimilation
from en4dvar.config.sequential import Sequential
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError
from en4dvar.schemes import MINIMISERS, ON_A_SERIES, ON_A_WINDOW, SCHEMES, keys_of
from en4dvar.schemes.settings import AFTERWARDS, Localisation

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
KEYS = sorted({key for kind in SCHEMES.values() for key in keys_of(kind)})
OF_ESTIMATES = {f.name: f.default for f in fields(AssimilationSettings) if f.name not in ("scheme", "own")}
# where one key says how another is to be given
TOGETHER: dict[str, dict[str, Any]] = {"shift": {"lag": 2}, "mda_weights": {"lag": 1}}


def default(key: str, scheme: str = "") -> Any:
    """That of a scheme, or of any that has the key."""
    kinds = [SCHEMES[scheme]] if scheme and key in keys_of(SCHEMES[scheme]) else SCHEMES.values()
    return next(f.default for kind in kinds for f in fields(kind) if f.name == key)


def as_in_a_file(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def estimate(changes: dict[str, Any]) -> Any:
    config = load_config(CONFIGS / "quickstart.yaml", {f"assimilation.{key}": value for key, value in changes.items()})
    return config.assimilation.own


def twin(changes: dict[str, Any]) -> Any:
    changes = {"inflation": 1.0, "rotation": False} | changes
    config = load_twin(CONFIGS / "linear_etkf.yaml", {f"assimilation.{key}": v for key, v in changes.items()})
    return config.experiment.sequential.scheme


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize(
    ("scheme", "kinds", "load"),
    [*((s, ON_A_WINDOW, estimate) for s in ON_A_WINDOW), *((s, ON_A_SERIES, twin) for s in ON_A_SERIES)],
)
def test_every_key_beside_every_scheme(key: str, scheme: str, kinds: dict[str, Any], load: Any) -> None:
    changes = {"scheme": scheme, key: as_in_a_file(default(key, scheme))} | TOGETHER.get(key, {})
    if key in keys_of(kinds[scheme]):
        made = load(changes)
        assert type(made) is kinds[scheme]
        assert getattr(made, key) == default(key, scheme)
        return
    with pytest.raises(ConfigError) as error:
        load(changes)
    told = {fault.path: fault.message for fault in error.value.problems}[f"assimilation.{key}"]
    readers = [name for name, kind in kinds.items() if key in keys_of(kind)]
    if readers:
        assert told == f"scheme {scheme} does not read it; it is a key of {' and '.join(readers)}"
    else:
        assert f"unknown key '{key}'" in told


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("scheme", ON_A_WINDOW)
def test_every_key_given_to_the_settings_from_python(key: str, scheme: str) -> None:
    kind = ON_A_WINDOW[scheme]
    if key in keys_of(kind):
        changed = {key: (1.0, 2.0) if isinstance(default(key, scheme), tuple) else "other"}
        assert AssimilationSettings(scheme, **changed).own == replace(kind(), **changed)
        return
    with pytest.raises(ConfigError, match=rf"{key}: (scheme {scheme} does not read it; .*key of|unknown key)"):
        AssimilationSettings(scheme, **{key: default(key)})


@pytest.mark.parametrize("key", [*KEYS, *AFTERWARDS])
@pytest.mark.parametrize("scheme", [name for name, kind in ON_A_WINDOW.items() if kind.localised_keys is not None])
def test_every_key_beside_a_localisation(key: str, scheme: str) -> None:
    kind, value = ON_A_WINDOW[scheme], default(key, scheme) if key in KEYS else OF_ESTIMATES[key]
    if key in keys_of(kind, localised=True):
        assert AssimilationSettings(scheme, localisation=Localisation(1.0), **{key: value}).own == kind()
        return
    given = {"scheme": scheme, key: as_in_a_file(value), "localisation": "{radius: 1}"}
    with pytest.raises(ConfigError) as error:
        estimate(given)
    assert f"assimilation.{key}" in {fault.path for fault in error.value.problems}


def test_a_misspelt_key_is_told_with_what_was_meant() -> None:
    with pytest.raises(ConfigError, match="unknown key 'stars'; did you mean 'starts'"):
        estimate({"stars": 2})
    with pytest.raises(ConfigError, match="stars: unknown key; did you mean 'starts'"):
        AssimilationSettings(stars=2)
    with pytest.raises(ConfigError, match=r"'esmda' is not a scheme .*; did you mean 'es-mda'"):
        AssimilationSettings("esmda")


def test_a_key_that_is_accepted_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run asks for every field of its scheme, and for every key of an estimate but what other schemes need."""
    read: dict[str, set[str]] = {}

    def watched(kind: type) -> None:
        original = kind.__getattribute__

        def get(self: Any, name: str) -> Any:
            read.setdefault(kind.__name__, set()).add(name)
            return original(self, name)

        monkeypatch.setattr(kind, "__getattribute__", get)

    problem = make_problem(Decay(), [1.5, 1.2])
    for name, kind in {**ON_A_WINDOW, "settings": AssimilationSettings}.items():
        watched(kind)
        scheme = "en4dvar" if name == "settings" else name
        long = {"step_tolerance": 1e-9} if scheme in MINIMISERS else {}  # until J falls no more
        settings = AssimilationSettings(scheme, members=12, **long)
        read.clear()
        assimilate(problem, settings, 1)
        keys = keys_of(kind) if name in ON_A_WINDOW else OF_ESTIMATES.keys()
        assert keys - read.get(kind.__name__, set()) <= {"draws", "emulator"}, name  # of a cheap model


def test_settings_can_be_changed_and_their_keys_read() -> None:
    settings = AssimilationSettings("es-mda", members=20, mda_coefficients=(2.0, 2.0))
    changed = replace(settings, members=30, mda_form="square-root")
    assert (changed.members, changed.mda_coefficients, changed.mda_form) == (30, (2.0, 2.0), "square-root")
    assert replace(changed, scheme="etkf") == AssimilationSettings("etkf", members=30)
    assert changed.keys == {
        "scheme": "es-mda", **OF_ESTIMATES, "members": 30, "mda_coefficients": (2.0, 2.0), "mda_form": "square-root",
    }  # fmt: skip


def test_what_is_written_has_the_keys_that_are_read_alone() -> None:
    for section, kinds, others in ((Assimilation, ON_A_WINDOW, {}), (Sequential, ON_A_SERIES, {"members": 10})):
        for scheme, kind in kinds.items():
            given = {"scheme": scheme, **others}
            written = section.model_validate(given).as_written(given)
            assert written.keys() & set(KEYS) == keys_of(kind)
            assert section.model_validate(written).as_written(written) == written


def test_no_scheme_is_named_outside_its_folder() -> None:
    """What a scheme can do is a property of it: nobody asks which it is, and no message needs its name."""
    classes = "|".join({kind.__name__ for kind in SCHEMES.values()} | {"Minimiser"})
    asked = re.compile(rf"isinstance\([^)]*\b({classes})\b|isinstance\(\s*(self\.)?scheme\b")
    names = re.compile(rf"\b({'|'.join(set(SCHEMES) - {'en4dvar'})})\b|\b(use|scheme:?) en4dvar\b")
    files = "|".join({kind.__module__.rpartition(".")[2] for kind in SCHEMES.values()})
    imported = re.compile(rf"en4dvar\.schemes\.({files})\b")
    told = []
    for path in (ROOT / "en4dvar").rglob("*.py"):
        if path.parent.name == "schemes" or path.name == "moved.py":  # which knows former names of modules
            continue
        source = path.read_text(encoding="utf-8")
        told += [f"{path.name}: {hit.group()}" for each in (asked, imported) for hit in each.finditer(source)]
        told += [f"{path.name}: {text}" for text in strings(source) if names.search(text)]
    assert told == []


def strings(source: str) -> list[str]:
    """Texts of a file but those that describe a module, class, function or key."""
    described = {id(node.value) for node in nodes(source) if isinstance(node, ast.Expr)}
    constants = [node for node in nodes(source) if isinstance(node, ast.Constant) and id(node) not in described]
    return [node.value for node in constants if isinstance(node.value, str)]


def test_a_configuration_that_version_1_0_recorded_is_read_without_what_its_scheme_does_not_read() -> None:
    """It wrote the defaults of every key, whatever the scheme."""
    text = "assimilation: {scheme: etkf, members: 9, mda_form: perturbed, starts: 2, weights: sum, refine: auto}"
    assert recorded(text, "posterior.nc").data["assimilation"] == {
        "scheme": "etkf", "members": 9, "weights": "sum", "refine": "auto",
    }  # fmt: skip
