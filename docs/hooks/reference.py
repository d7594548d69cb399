"""Reference pages made from the code while the site is built: YAML keys, command line, Python names."""

from __future__ import annotations

import importlib
import logging
from typing import Any

import click
from mkdocs.structure.files import File, Files

log = logging.getLogger("mkdocs.hooks.reference")
Json = dict[str, Any]
WIDTH = 84  # characters of a block beside the navigation, on a screen of 1280 pixels


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the generated pages to the site."""
    pages = {
        "reference_yaml.md": yaml_page(),
        "reference_cli.md": command_page(),
        "reference_warnings.md": warnings_page(),
        "reference_api.md": python_page(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


# --- YAML keys, from the JSON schema that editors use


def yaml_page() -> str:
    """Every key of every kind of configuration file."""
    from en4dvar.config.json_schema import json_schema

    definitions = json_schema()["$defs"]
    models = sorted(name.removeprefix("model_") for name in definitions if name.startswith("model_"))
    others = [key for key in definitions if key.endswith("_file")]
    parts = [
        "# YAML keys",
        "Generated from the models that validate a configuration; `en4dvar schema > schema.json` writes the same for "
        "editors. A dot goes one level down. **Bold** keys are required. A *quantity* is a number with its unit, such "
        "as `0.42 kPa` or `2.5 us`; any unit of the right dimension will do. Unknown keys are errors. Relative paths "
        "start at the folder of the file, the run directory at the current one.",
        "## An estimation",
        _table(definitions["estimation"], definitions),
        "## parameters",
        definitions["parameter"]["description"],
        "A prior:",
        _table(definitions["parameter"]["anyOf"][1], definitions),
        "A scalar of the data file:",
        _table(definitions["parameter"]["anyOf"][2], definitions),
    ]
    for name in models:
        section = definitions[f"model_{name}"]
        parts += [f"## model: {name}", section.get("description", ""), _table(section, definitions)]
        known = definitions[f"parameters_{name}"]["properties"].items()
        parts += [
            "Parameters, as far as they do not depend on the settings:",
            _rows(["parameter", "what"], [[f"`{key}`", about["description"]] for key, about in known]),
        ]
    kinds = {
        "twin": "A twin experiment",
        "campaign": "A synthetic campaign",
        **{k: f"A file with {k[:-5]}" for k in others},
    }
    for key, title in kinds.items():
        section = definitions[key]
        parts += [f"## {title}", section.get("description", ""), _table(section, definitions)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _table(section: Json, definitions: Json) -> str:
    rows = [row for key, node in section["properties"].items() for row in _key(key, node, section, definitions)]
    return _rows(["key", "takes", "default", "meaning"], rows)


def _key(path: str, node: Json, parent: Json, definitions: Json) -> list[list[str]]:
    """The row of one key and those of the keys below it."""
    name = path.rpartition(".")[2]
    required = name in parent.get("required", [])
    default = "" if node.get("default") in (None, "", [], {}) else f"`{_text(node['default'])}`"
    if not node.get("description"):
        log.warning("YAML key %s has no description", path)
    shown = f"**`{path}`**" if required else f"`{path}`"
    rows = [[shown, _takes(node, definitions), default, _prose(node.get("description", ""))]]
    for option in _options(node):
        kind = option.get("properties", {}).get("kind", {}).get("const")
        for key, child in option.get("properties", {}).items():
            if key != "kind":
                below = _key(f"{path}.{key}", child, option, definitions)
                below[0][3] = f"({kind}) {below[0][3]}" if kind else below[0][3]
                rows += below
        for child in [option.get("additionalProperties"), *option.get("patternProperties", {}).values()]:
            if isinstance(child, dict) and ("description" in child or "properties" in child):
                rows += _key(f"{path}.<name>", {"description": "One of them.", **child}, option, definitions)
    return rows


def _options(node: Json) -> list[Json]:
    """The objects that a key may hold, alternatives and compositions opened."""
    extra = node.get("additionalProperties")
    found = [node] if "properties" in node or "patternProperties" in node or isinstance(extra, dict) else []
    for combined in ("anyOf", "allOf", "oneOf"):
        for option in node.get(combined, []):
            found += _options(option)
    return found


def _takes(node: Json, definitions: Json) -> str:
    if "$ref" in node:
        return f"[section](#{_anchor(node['$ref'].rpartition('/')[2])})"
    if "const" in node:
        return f"`{_text(node['const'])}`"
    if "enum" in node:
        return ", ".join(f"`{_text(value)}`" for value in node["enum"])
    if "x-unit" in node:
        return f"quantity, {node['x-unit']}" if node["x-unit"] != "1" else "number"
    if either := node.get("anyOf") or node.get("oneOf"):
        kinds = [_takes(option, definitions) for option in either if option.get("type") != "null"]
        kinds = list(dict.fromkeys(kind for kind in kinds if kind))
        return "quantity" if set(kinds) == {"text", "integer", "number"} else " or ".join(kinds)
    if "allOf" in node:
        return _takes(node["allOf"][0], definitions)
    if "properties" in node:
        kind = node["properties"].get("kind", {}).get("const")
        return f"section `kind: {kind}`" if kind else "section"
    types = node.get("type", "")
    if types == "array":
        return f"list of {_takes(node['items'], definitions)}" if isinstance(node.get("items"), dict) else "list"
    if isinstance(types, list):
        return "quantity"
    if types == "object" and isinstance(node.get("additionalProperties"), dict):
        return "section, by name"
    words = {"string": "text", "object": "section", "boolean": "`true`, `false`"}
    limits = [
        f"{sign} {node[key]:g}"
        for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in node and abs(node[key]) < 1e15
    ]
    return " ".join([words.get(types, types), ", ".join(limits)]).strip()


def _anchor(definition: str) -> str:
    return {"parameter": "parameters", "model": "model-bubble"}.get(definition, definition.replace("_", "-"))


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def _prose(text: str) -> str:
    """Docstring text as Markdown in one table cell."""
    code = [piece if i % 2 else piece.replace("<", "&lt;") for i, piece in enumerate(text.split("``"))]
    return " ".join("`".join(code).replace("|", "\\|").split())


def _rows(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


# --- command line, from click


def command_page() -> str:
    """Every command as ``--help`` tells it."""
    from en4dvar.cli import main

    context = click.Context(main, info_name="en4dvar")
    parts = [
        "# Command line",
        "Generated from `--help`. Errors are told as `file:line:column: key: message`, all at once.",
        _rows(
            ["exit code", "means"],
            [
                ["0", "done"],
                ["1", "the run failed, or some data sets of a campaign did"],
                ["2", "usage, configuration, data, or output directory"],
                ["3", "too few members survived (in a campaign: nothing else failed)"],
                ["130", "interrupted; to be continued with `--resume`"],
            ],
        ),
    ]
    for name in main.list_commands(context):
        command = main.get_command(context, name)
        assert command is not None
        width = {"max_content_width": WIDTH, "terminal_width": WIDTH}
        inner = click.Context(_loaded(command), info_name=name, parent=context, **width)
        parts += [f"## {name}", f"```text\n{inner.command.get_help(inner)}\n```"]
    return "\n\n".join(parts) + "\n"


def _loaded(command: click.Command) -> click.Command:
    """A command of an application package is imported only when it is asked for."""
    entry = getattr(command, "entry", None)
    return command if entry is None else entry.load()


# --- warnings, from their catalogue


def warnings_page() -> str:
    """Every code a result can warn with."""
    from en4dvar.plumbing.caution import CATALOGUE, SEVERITIES, TRIGGERS

    meaning = {
        "serious": "do not trust the posterior before this is settled",
        "caution": "read it with care",
        "note": "worth knowing",
    }
    parts = [
        "# Warnings",
        "DFS are degrees of freedom for signal: how many numbers the data determine, or of one parameter 1 − posterior "
        "variance / prior variance. J is the cost that is minimised, χ² its part that compares model and readings.",
        "Generated. A result says what should keep you from trusting it: in the report, in `run.log`, "
        "on the terminal and in `posterior.nc` (`warnings`, `warning_codes`), each with a code that does not change. "
        "They stand in the order of what they do to the numbers, the worst first. No interval is printed of the "
        "parameters that a serious one, `non-gaussian` or `at-bound` is about. "
        "What is behind them: [What a posterior means](trusting_a_posterior.md#when-not-to-trust-it).",
    ]
    for severity in SEVERITIES:
        rows = [
            [f"`{code}`", _prose(TRIGGERS[code]), _prose(advice)]
            for code, (kind, advice) in CATALOGUE.items()
            if kind == severity
        ]
        parts += [f"## {severity.capitalize()}: {meaning[severity]}", _rows(["code", "when", "what to do"], rows)]
    return "\n\n".join(parts) + "\n"


# --- Python, from the public names

API = {
    "Running and reading": (
        "run", "run_campaign", "run_twin", "simulate", "load_config", "load_twin", "load_result", "Result",
    ),
    "Writing a model": (
        "ForwardModel", "Trajectory", "Failure", "Observable", "StateField", "Parameter", "Field", "StateLayout",
        "Quantity",
    ),
    "From arrays": ("Observations", "Prior", "PriorTerm", "InverseProblem", "AssimilationSettings", "Analysis"),
    "Errors": ("En4dvarError", "ConfigError", "DataError", "OutputError", "TooFewMembersError"),
}  # fmt: skip


def python_page() -> str:
    """Every public name of the framework and of the bubble, by what one wants to do."""
    framework, bubble = (importlib.import_module(name) for name in ("en4dvar", "en4dvar_bubble"))
    public = [name for name in dir(framework) if not name.startswith("_")]
    sorted_in = {name for names in API.values() for name in names}
    groups = {title: [name for name in names if name in public] for title, names in API.items()}
    groups["More"] = [name for name in public if name not in sorted_in]
    parts = ["# Python", "All that the command line does, and the pieces. Values are SI unless a name says otherwise."]
    for title, names in groups.items():
        parts += [f"## {title}", *(f"::: {_home(framework, name)}" for name in names)] if names else []
    parts += ["## The bubble", *(f"::: {_home(bubble, name)}" for name in bubble.__all__)]
    return "\n\n".join(parts) + "\n"


def _home(package: Any, name: str) -> str:
    """Where a name is defined, so that the page describes the thing and not an alias."""
    home = getattr(getattr(package, name), "__module__", "")
    defined = home.split(".")[0] == package.__name__ and hasattr(importlib.import_module(home), name)
    return f"{home}.{name}" if defined else f"{package.__name__}.{name}"
