"""The JSON schema of a configuration file, from the same pydantic models that validate it.

An editor that reads it completes and checks keys while one types; the words are the descriptions of the settings. It
accepts every file that loads, but cannot tell everything that loading tells (units that do not fit, files that are not
there). What depends on packages comes from them: the settings of each registered model (group ``en4dvar.models``) and
further kinds of files (group ``en4dvar.schemas``: the key that marks the kind → pydantic model of the whole file,
whose ``PURPOSE`` says what it is and which command it is for).
"""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from typing import Any

from en4dvar.config.context import TEXT
from en4dvar.config.data import SeriesData
from en4dvar.config.kinds import CampaignFile, SequenceFile, TwinFile
from en4dvar.config.load import OTHERS, Estimation
from en4dvar.config.models import COMMAND, GROUP, find_model, settings_of
from en4dvar.config.parameters import FromFile, PriorSection, TiedSection
from en4dvar.model.state import OF_READINGS, Parameter
from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar.plumbing.installed import installed
from en4dvar.plumbing.user_code import loading

Json = dict[str, Any]


def json_schema() -> Json:
    """The schema (draft 2020-12). A model that cannot be loaded is left out: its settings are then not checked."""
    definitions: Json = {
        "parameter": {
            "description": "A prior (estimated), a quantity (fixed), or a scalar of the data file (fixed).",
            "anyOf": [dict(TEXT), *(_of(kind.model_json_schema()) for kind in (PriorSection, FromFile, TiedSection))],
        }
    }
    definitions["series"] = _partial(_of(SeriesData.model_json_schema()))  # the rest is said for all series
    models = list(_models(definitions))
    definitions["model"] = _model_section(models)
    marked: dict[str, Any] = {"twin": TwinFile, "sequence": SequenceFile, "campaign": CampaignFile}  # by their sections
    for name, kind in ({"estimation": Estimation} | marked).items():
        definitions[name] = _of(kind.model_json_schema())
    for name in ("estimation", "twin", "sequence"):
        definitions[name]["allOf"] = [
            _if({"required": ["model"], "properties": {"model": _names(model)}},
                {"properties": {"parameters": {"$ref": f"#/$defs/parameters_{model}"}}})
            for model in models
        ]  # fmt: skip
    kinds = {name: name for name in marked}
    for name, entry in installed(OTHERS).items():
        with suppress(ConfigError), loading(f"schema {name!r}"):  # another package's may not end the command
            definitions[f"{name}_file"] = _of(entry.load().model_json_schema())
            kinds[name] = f"{name}_file"
    chosen: Json = {"$ref": "#/$defs/estimation"}
    for key, name in reversed(kinds.items()):
        chosen = {**_if({"required": [key]}, {"$ref": f"#/$defs/{name}"}), "else": chosen}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "en4dvar configuration",
        "type": "object",
        **chosen,
        "$defs": definitions,
    }


@cache
def schema_text() -> str:
    """The schema as the text of a ``.json`` file."""
    return json.dumps(json_schema(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _of(schema: Json) -> Json:
    """The schema of pydantic, references inside it resolved in place, defaults as a file would write them."""
    return _tidy(_resolve(schema, schema.pop("$defs", {})))


def _resolve(node: Json, inner: Json) -> Json:
    """References replaced by what they mean; text beside a reference goes before the text behind it."""
    if "x-definition" in node:  # of the whole schema, not of the section
        return {"$ref": f"#/$defs/{node['x-definition']}", **{k: v for k, v in node.items() if k != "x-definition"}}
    if "$ref" in node:
        target = _resolve(inner[node["$ref"].rpartition("/")[2]], inner)
        return {**target, **{k: _each(v, _resolve, inner) for k, v in node.items() if k != "$ref"}}
    resolved = {k: _each(v, _resolve, inner) for k, v in node.items() if k != "discriminator"}
    match resolved.get("anyOf"):
        case [{"description": words}, {"type": "null"}]:  # of a section that may be left out
            resolved.setdefault("description", words)
    return resolved


def _each(node: Any, change: Callable[..., Json], *more: Any) -> Any:
    """Every section that is in a list, or is itself the ``node``, changed; anything else as it is."""
    if isinstance(node, list):
        return [_each(item, change, *more) for item in node]
    return change(node, *more) if isinstance(node, dict) else node


def _partial(node: Json) -> Json:
    """The same with nothing required, at any depth."""
    parts = {k: _each(v, _partial) for k, v in node.items() if k != "required" or not isinstance(v, list)}
    return {k: v for k, v in parts.items() if k != "oneOf" or {} not in v}  # alternatives that only required are none


def _tidy(node: Json) -> Json:
    """Without generated titles and without defaults that JSON cannot hold; quantities as text with their unit."""
    tidy = {
        key: {name: _each(child, _tidy) for name, child in value.items()}
        if key == "properties"
        else _each(value, _tidy)
        for key, value in node.items()
        if key != "title"
    }
    default = tidy.get("default")
    if isinstance(default, float) and not math.isfinite(default):
        del tidy["default"]
    elif isinstance(default, float) and "x-unit" in tidy:
        tidy["default"] = f"{default:g} {tidy['x-unit']}"
    elif isinstance(default, dict):  # a section: its keys have their own
        del tidy["default"]
    return tidy


def _models(definitions: Json) -> Iterator[str]:
    """Name of each registered model; its settings and parameters are added to the definitions."""
    for name in installed(GROUP):
        try:
            kind: Any = find_model(name)
        except En4dvarError:
            continue
        settings = _of(settings_of(kind).model_json_schema())
        own = {"const": name, "description": "Name of the model."}
        settings["properties"] = {"name": own, **settings["properties"]}
        definitions[f"model_{name}"] = settings
        definitions[f"parameters_{name}"] = _parameters(_possible_parameters(kind))
        yield name


def _possible_parameters(kind: Any) -> tuple[Parameter, ...]:
    """Every parameter that a model may have; where they depend on its settings, these tell."""
    settings: Any = settings_of(kind)
    if hasattr(settings, "possible_parameters"):
        return tuple(settings.possible_parameters())
    fixed = getattr(kind, "parameters", ())
    return fixed if isinstance(fixed, tuple) else ()


def _parameters(known: tuple[Parameter, ...]) -> Json:
    """The ``parameters`` section: names that an editor can offer; others are a matter of the model's settings."""
    named = {p.name: p for p in (*known, *OF_READINGS)}
    entry = {"$ref": "#/$defs/parameter"}
    return {
        "type": "object",
        "properties": {n: {**entry, "description": f"{p.label}, unit {p.unit}"} for n, p in named.items()},
        "additionalProperties": entry,
    }


def _model_section(models: list[str]) -> Json:
    unnamed = {"required": [COMMAND], "not": {"required": ["name"]}}
    return {
        "type": "object",
        "anyOf": [{"required": ["name"]}, {"required": [COMMAND]}],
        "properties": {
            "name": {
                "description": "Name of the model (see 'en4dvar models'), ./my_model.py:MyModel, or package:MyModel.",
                "anyOf": [{"enum": sorted(models)}, {"type": "string", "pattern": ":"}],
            }
        },
        "allOf": [
            *(_if(_names(name), {"$ref": f"#/$defs/model_{name}"}) for name in models),
            *[_if(unnamed, {"$ref": f"#/$defs/model_{COMMAND}"})] * (COMMAND in models),
        ],
    }


def _names(model: str) -> Json:
    """Matches the section of this model."""
    return {"properties": {"name": {"const": model}}, "required": ["name"]}


def _if(condition: Json, then: Json) -> Json:
    return {"if": condition, "then": then}
