"""The JSON schema of a configuration file, from the same pydantic models that validate it.

An editor that reads it completes and checks keys while one types; the words are the descriptions of the settings. It
accepts every file that loads, but cannot tell everything that loading tells (units that do not fit, files that are not
there). What depends on packages comes from them: the settings of each registered model (group ``en4dvar.models``) and
further kinds of files (group ``en4dvar.schemas``: the key that marks the kind → pydantic model of the whole file).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any

from pydantic import BaseModel

from en4dvar.config import schema, synthetic, twin
from en4dvar.config.models import GROUP, find_model, settings_of
from en4dvar.errors import En4dvarError
from en4dvar.state import NOISE_SCALE, TIME_SHIFT, Parameter

Json = dict[str, Any]
KINDS = "en4dvar.schemas"
_QUANTITY: Json = {"type": ["string", "number"]}


def json_schema() -> Json:
    """The schema (draft 2020-12). A model that cannot be loaded is left out: its settings are then not checked."""
    definitions: Json = {
        "parameter": {
            "description": "A prior (estimated), a quantity (fixed), or a scalar of the data file (fixed).",
            "anyOf": [_QUANTITY, _of(schema.Prior), _of(schema.FromFile)],
        },
    }
    models = dict(_models(definitions))
    definitions["model"] = _model_section(models)
    definitions["estimation"] = _estimation(definitions)
    definitions["twin"] = _twin(definitions)
    definitions["campaign"] = _campaign(definitions)
    kinds = {"twin": "twin", "campaign": "campaign"}
    for entry in entry_points(group=KINDS):
        definitions[f"{entry.name}_file"] = _of(entry.load())
        kinds[entry.name] = f"{entry.name}_file"
    chosen: Json = {"$ref": "#/$defs/estimation"}
    for key, name in reversed(kinds.items()):
        chosen = {"if": {"required": [key]}, "then": {"$ref": f"#/$defs/{name}"}, "else": chosen}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "en4dvar configuration",
        "type": "object",
        **chosen,
        "$defs": definitions,
    }


def schema_text() -> str:
    """The schema as the text of a ``.json`` file."""
    return json.dumps(json_schema(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _of(model: type[BaseModel]) -> Json:
    """Schema of one pydantic model, references inside it resolved in place, defaults as a file would write them."""
    found = model.model_json_schema()
    inner = found.pop("$defs", {})
    return _tidy(_resolve(found, inner))


def _resolve(node: Any, inner: Json) -> Any:
    """References replaced by what they mean; text beside a reference goes before the text behind it."""
    if isinstance(node, list):
        return [_resolve(item, inner) for item in node]
    if not isinstance(node, dict):
        return node
    if "$ref" in node:
        target = _resolve(inner[node["$ref"].rpartition("/")[2]], inner)
        return {**target, **{k: _resolve(v, inner) for k, v in node.items() if k != "$ref"}}
    return {k: _resolve(v, inner) for k, v in node.items() if k != "discriminator"}


def _tidy(node: Any) -> Any:
    """Without generated titles and without defaults that JSON cannot hold; quantities as text with their unit."""
    if isinstance(node, list):
        return [_tidy(item) for item in node]
    if not isinstance(node, dict):
        return node
    tidy = {
        key: {name: _tidy(child) for name, child in value.items()} if key == "properties" else _tidy(value)
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


def _models(definitions: Json) -> Iterator[tuple[str, str]]:
    """(name, definition) of each registered model; its settings and parameters are added to the definitions."""
    for name in sorted({entry.name for entry in entry_points(group=GROUP)}):
        try:
            kind: Any = find_model(name)
        except En4dvarError:
            continue
        settings = _of(settings_of(kind))
        settings["properties"] = {
            "name": {"const": name, "description": "Name of the model."},
            **settings["properties"],
        }
        definitions[f"model_{name}"] = settings
        definitions[f"parameters_{name}"] = _parameters(_possible_parameters(kind))
        yield name, f"model_{name}"


def _possible_parameters(kind: Any) -> tuple[Parameter, ...]:
    """Every parameter that a model may have; where they depend on its settings, these tell."""
    settings: Any = settings_of(kind)
    if hasattr(settings, "possible_parameters"):
        return tuple(settings.possible_parameters())
    fixed = getattr(kind, "parameters", ())
    return fixed if isinstance(fixed, tuple) else ()


def _parameters(known: tuple[Parameter, ...]) -> Json:
    """The ``parameters`` section: names that an editor can offer; others are a matter of the model's settings."""
    named = {p.name: p for p in (*known, TIME_SHIFT, NOISE_SCALE)}
    entry = {"$ref": "#/$defs/parameter"}
    return {
        "type": "object",
        "properties": {n: {**entry, "description": f"{p.label}, unit {p.unit}"} for n, p in named.items()},
        "additionalProperties": entry,
    }


def _model_section(models: dict[str, str]) -> Json:
    return {
        "type": "object",
        "required": ["name"],
        "properties": {
            "name": {
                "description": "Name of the model (see 'en4dvar models'), or package:object.",
                "anyOf": [{"enum": sorted(models)}, {"type": "string", "pattern": ":"}],
            }
        },
        "allOf": [_if_model(name, {"$ref": f"#/$defs/{definition}"}) for name, definition in models.items()],
    }


def _if_model(name: str, then: Json) -> Json:
    return {"if": {"properties": {"name": {"const": name}}, "required": ["name"]}, "then": then}


def _with_sections(whole: type[BaseModel], /, **sections: Json) -> Json:
    """The schema of a whole file, with sections that are validated by themselves put in their place."""
    found = _of(whole)
    for key, section in sections.items():
        described = {"description": found["properties"][key]["description"]}
        found["properties"][key] = {**section, **described}
    return found


def _by_model(found: Json, definitions: Json) -> Json:
    """Parameters are those of the model that the file names."""
    names = [key.removeprefix("model_") for key in definitions if key.startswith("model_")]
    found["allOf"] = [
        {
            "if": {"required": ["model"], "properties": {"model": _if_model(name, {})["if"]}},
            "then": {"properties": {"parameters": {"$ref": f"#/$defs/parameters_{name}"}}},
        }
        for name in names
    ]
    return found


def _estimation(definitions: Json) -> Json:
    data = _of(schema.Data)
    data["properties"]["columns"] |= {
        "properties": {"time": {"description": "Observation times.", **_without_text(_of(schema.TimeColumn))}},
        "required": ["time"],
        "additionalProperties": {"description": "The observable.", **_without_text(_of(schema.Column))},
    }
    std = {"description": "Std of the observation error: a quantity, or e.g. '1 % of maximum'.", **_QUANTITY}
    data["properties"]["error"] |= {
        "properties": {
            "time_std": {"description": "Std of the observation times: adds (rate × time_std)².", **_QUANTITY},
            "correlation_time": {"description": "Errors are correlated as exp(−|Δt|/τ).", **_QUANTITY},
            "covariance": {"description": "File of the whole R.", **_without_text(_of(schema.CovarianceFile))},
            "robust": {"description": "Robust cost: readings far off count less.", "enum": ["huber"]},
            "threshold": {"description": "Threshold of the robust cost in std.", "type": ["number", "string"]},
        },
        "patternProperties": {"^(?!time_std$).*_std$": std},
        "additionalProperties": False,
    }
    found = _with_sections(
        schema.Schema,
        data=data,
        model={"$ref": "#/$defs/model"},
        parameters={"type": "object", "additionalProperties": {"$ref": "#/$defs/parameter"}},
        initial_state={"type": "object", "additionalProperties": _of(schema.InitialSpread)},
        assimilation=_of(schema.Assimilation),
    )
    return _by_model(found, definitions)


def _twin(definitions: Json) -> Json:
    found = _with_sections(
        twin.TwinSchema,
        model={"$ref": "#/$defs/model"},
        parameters={"type": "object", "additionalProperties": {"$ref": "#/$defs/parameter"}},
        twin=_of(twin.Twin),
        assimilation=_of(twin.Sequential),
    )
    return _by_model(found, definitions)


def _campaign(definitions: Json) -> Json:
    section = _of(synthetic.Campaign)
    (group,) = section["properties"]["groups"]["patternProperties"].values()
    group["properties"]["parameters"] |= {"additionalProperties": {"$ref": "#/$defs/parameter"}}
    return _with_sections(synthetic.CampaignSchema, model={"$ref": "#/$defs/model"}, campaign=section)


def _without_text(node: Json) -> Json:
    return {key: value for key, value in node.items() if key != "description"}
