"""Pydantic's verdicts, told as faults of the file: where, what, and what was probably meant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from en4dvar.config.document import Document
from en4dvar.errors import Fault
from en4dvar.hints import suggest

M = TypeVar("M", bound=BaseModel)

_MESSAGES = {
    "missing": "required, but not given",
    "dict_type": "expected 'key: value' lines",
    "model_type": "expected 'key: value' lines",
    "model_attributes_type": "expected 'key: value' lines",
    "string_type": "expected text; put it in quotes",
}


def check(
    schema: type[M],
    value: Any,
    path: Sequence[str | int],
    document: Document,
    faults: list[Fault],
    context: Mapping[str, Any] | None = None,
) -> M | None:
    """Validate ``value``, found at ``path``; every fault is appended to ``faults`` and None returned."""
    try:
        return schema.model_validate(value, context=dict(context or {}))
    except ValidationError as error:
        seen: set[Fault] = set()
        for item in error.errors():
            fault = _fault(item, schema, tuple(path), document)
            if fault not in seen:
                seen.add(fault)
                faults.append(fault)
    return None


def _fault(item: Any, schema: type[BaseModel], path: tuple[str | int, ...], document: Document) -> Fault:
    kind, loc = item["type"], tuple(item["loc"])
    # Pydantic puts names of union branches into the location; the document decides what is a path.
    real: tuple[str | int, ...] = path
    for n, part in enumerate(loc):
        if document.has((*real, part)) or (kind == "missing" and n == len(loc) - 1):
            real = (*real, part)
    if kind == "union_tag_invalid":
        choices = [c.strip("' ") for c in item["ctx"]["expected_tags"].split(", ")]
        name, given = item["ctx"]["discriminator"].strip("'"), item["ctx"]["tag"]
        message = f"{given!r} is not one of {', '.join(choices)}"
        hint = suggest(given, choices)
        return document.fault((*real, name), message + (hint if hint.startswith("; did") else ""))
    if kind == "extra_forbidden":
        known = sorted(_known(schema, loc[:-1]))
        return document.fault(real, f"unknown key {str(loc[-1])!r}{suggest(loc[-1], known)}", at_key=True)
    return document.fault(real, _message(item))


def _message(item: Any) -> str:
    kind, context = item["type"], item.get("ctx", {})
    if kind in ("value_error", "assertion_error"):
        return str(context["error"])
    if kind in ("literal_error", "enum"):
        choices = [c.strip("' ") for c in context["expected"].replace(" or ", ", ").split(", ")]
        hint = suggest(item["input"], choices)
        return f"{item['input']!r} is not one of {', '.join(choices)}" + (hint if hint.startswith("; did") else "")
    message = _MESSAGES.get(kind, item["msg"].replace("Input should be", "should be"))
    return message if kind == "missing" else f"{message}, not {item['input']!r}"


def _known(schema: type[BaseModel], loc: Sequence[str | int]) -> set[str]:
    """Keys accepted at ``loc``: fields (or aliases) of the models found by following the annotations."""
    models = [schema]
    for part in loc:
        inner = [f.annotation for m in models for k, f in m.model_fields.items() if part in (k, f.alias)]
        if inner:
            models = [m for annotation in inner for m in _models_in(annotation)]
    return {f.alias or k for m in models for k, f in m.model_fields.items()}


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
