"""Every public object says what it is: a docstring of its own, shapes of arrays, errors, units of constants."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from doc_pages import command_words

import en4dvar
import en4dvar_bubble
from en4dvar.cli import main
from en4dvar.config.json_schema import json_schema

SHAPE = re.compile(r"\([\w…'′]{1,7},(?: ?[\w…'′·+]{1,9},?)*\)|any shape")  # (K,), (N, n), (…, K)
ERRORS = {"ConfigError", "DataError", "OutputError", "TooFewMembersError", "En4dvarError", "UnitError", "ValueError"}


def public() -> Iterator[tuple[str, Any]]:
    """Qualified name → object: the public names of both packages and the public members that their classes define."""
    for package in (en4dvar, en4dvar_bubble):
        names = getattr(package, "__all__", None) or [n for n in dir(package) if not n.startswith("_")]
        for name in names:
            value = getattr(package, name)
            yield f"{package.__name__}.{name}", value
            if inspect.isclass(value):
                for key, member in vars(value).items():
                    made = inspect.unwrap(getattr(member, "func", getattr(member, "fget", member)) or member)
                    made = getattr(made, "__func__", made)
                    if not key.startswith("_") and inspect.isfunction(made):
                        yield f"{package.__name__}.{name}.{key}", made


OBJECTS = {name: value for name, value in public() if callable(value)}
FUNCTIONS = {name: value for name, value in OBJECTS.items() if inspect.isfunction(value)}


def told(name: str) -> str:
    """The docstring of an object; that of a method with what its class says."""
    own = inspect.getdoc(OBJECTS[name]) or ""
    owner = name.rpartition(".")[0]
    return own if owner not in OBJECTS else f"{own}\n{inspect.getdoc(OBJECTS[owner])}"


@pytest.mark.parametrize("name", OBJECTS)
def test_it_has_a_docstring_of_its_own(name):
    value = OBJECTS[name]
    text = value.__doc__ or ""
    if inspect.isfunction(value) and not text:  # a method that does what its parent says
        text = inspect.getdoc(value) or _inherited(name)
    assert len(text.split()) >= 2, name
    if inspect.isclass(value):
        assert not text.startswith(f"{value.__name__}("), f"{name}: the generated docstring of a dataclass"


def _inherited(name: str) -> str:
    owner, _, key = name.rpartition(".")
    kinds = OBJECTS[owner].__mro__[1:] if owner in OBJECTS else ()
    return next((doc for kind in kinds if (doc := getattr(getattr(kind, key, None), "__doc__", None))), "")


def arrays(name: str) -> list[str]:
    """Arguments of a function that are arrays, and ``return``."""
    annotations = FUNCTIONS[name].__annotations__.items()
    return [key for key, kind in annotations if re.search(r"\b(?:Array|NDArray|ndarray)\b", str(kind))]


@pytest.mark.parametrize("name", list(filter(arrays, FUNCTIONS)))
def test_arrays_have_shapes(name):
    shaped = SHAPE.search(f"{told(name)}\n{_inherited(name)}")
    assert shaped, f"{name} takes or gives arrays of unknown shape: {', '.join(arrays(name))}"


def raised(name: str) -> set[str]:
    """Our errors that a function raises itself."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(FUNCTIONS[name])))
    return ERRORS & {
        node.exc.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name)
    }


@pytest.mark.parametrize("name", list(filter(raised, FUNCTIONS)))
def test_errors_are_announced(name):
    missing = {error for error in raised(name) if error not in told(name) + _inherited(name)}
    assert missing == set(), f"{name} does not say that it raises {', '.join(sorted(missing))}"


def test_parameters_of_every_law_and_constant_have_unit_and_source():
    for law in en4dvar_bubble.REGISTRY.values():
        for parameter in law.parameters:
            assert parameter.unit, (law, parameter.name)
            assert parameter.label, (law, parameter.name)
            assert parameter.source, (law, parameter.name)
    medium = en4dvar_bubble.WATER_25C
    assert set(medium.constants) == set(medium.sources)


CONTEXT = click.Context(main, info_name="en4dvar")


@pytest.mark.parametrize("name", ["", *main.list_commands(CONTEXT)])
def test_every_help_has_an_example_that_parses(name):
    command = main.get_command(CONTEXT, name) if name else main
    assert command is not None
    command = command.entry.load() if hasattr(command, "entry") else command
    text = command.help or ""
    assert re.search(r"Examples?:", text), f"en4dvar {name} --help shows no example"
    examples = re.findall(r"^ *(en4dvar \S.*)", text.partition("Example")[2].replace("\\\n", " "), re.M)
    assert examples
    for example in examples:
        words = command_words(example)
        found = main.get_command(CONTEXT, words[1])
        assert found is not None, example
        found.make_context(words[1], words[2:], parent=CONTEXT)


ROOT = Path(__file__).resolve().parents[2]
WITH_EXAMPLES = [
    path.relative_to(root).with_suffix("").as_posix().replace("/", ".")
    for root in (ROOT, ROOT / "models")
    for package in sorted(root.glob("en4dvar*/__init__.py"))
    for path in sorted(package.parent.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_in_docstrings_run(module):
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted
    assert result.failed == 0


def _undescribed(node: Any, path: str) -> Iterator[str]:
    """Keys of a JSON schema, at any depth, that no description explains."""
    if isinstance(node, dict):
        for key, value in node.get("properties", {}).items():
            if not value.get("description"):
                yield f"{path}.{key}"
        for key, value in node.items():
            if key == "properties":
                for name, child in value.items():
                    yield from _undescribed(child, f"{path}.{name}")
            elif key not in ("if", "then"):
                yield from _undescribed(value, path)
    elif isinstance(node, list):
        for child in node:
            yield from _undescribed(child, path)


def test_every_yaml_key_has_a_description():
    definitions = json_schema()["$defs"]
    assert [key for name, node in definitions.items() for key in _undescribed(node, name)] == []
    assert list(_undescribed({"anyOf": [{"properties": {"a": {}}}]}, "x")) == ["x.a"]
