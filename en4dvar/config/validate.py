"""Pydantic's verdicts, told as faults of the file: where, what, and what was probably meant."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Self, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from en4dvar.config.document import Document
from en4dvar.plumbing.errors import ConfigError, Fault
from en4dvar.plumbing.hints import shown, suggest

M = TypeVar("M", bound=BaseModel)
Place = tuple[str | int, ...]

_KIND = re.compile(r"\w+_(type|parsing|parsing_size|from_float)|finite_number")  # verdicts on what a value is
_NOT = ", not "
_SECTION = "expected 'key: value' lines"
_MESSAGES = {
    "missing": "required, but not given",
    "dict_type": _SECTION,
    "model_type": _SECTION,
    "model_attributes_type": _SECTION,
    "string_too_short": "must not be empty",
    "tuple_type": "expected a list, e.g. [1, 2]",
    "string_type": "expected text; put it in quotes",
    "path_type": "expected the path of a file or folder",
    "int_parsing_size": "too large for a whole number",
}


def check(
    schema: type[M], value: Any, path: Sequence[str | int], document: Document, faults: list[Fault], context: Any = None
) -> M | None:
    """Validate ``value``, found at ``path``; every fault is appended to ``faults`` and None returned."""
    try:
        return schema.model_validate(value, context=context)
    except ValidationError as error:
        findings = [(_written(finding, path, document), finding) for finding in _tell(error, schema)]
        for place, finding in _one_each(findings):
            fault = document.fault(place, finding.message, at_key=finding.at_key)
            if fault not in faults:
                faults.append(fault)
    return None


@dataclass(frozen=True)
class _Finding:
    """A fault at ``place``; ``absent``: its last key may be one that the file lacks; ``kind``: the value is of no
    kind that can stand there, of which there may be several."""

    place: Place
    message: str
    at_key: bool = False
    absent: bool = False
    kind: bool = False


class Faults:
    """Faults that a validator of ours finds, each with its place below the value; told to pydantic on leaving.

    ``names``: declared → as the file has it, where a key is named after something else.
    """

    def __init__(self, names: Mapping[str, str] | None = None) -> None:
        self._names = dict(names or {})
        self._lines: list[InitErrorDetails] = []

    def add(self, place: Place, message: str, *, at_key: bool = False) -> None:
        """A fault at a key, or of a key that is not there."""
        self._add(_Finding(place, message, at_key, absent=bool(place)))

    def _add(self, finding: _Finding) -> None:
        message = finding.message
        for declared, written in self._names.items():
            message = message.replace(declared, written)
        context = {"message": message, "at_key": finding.at_key, "absent": finding.absent, "kind": finding.kind}
        where = tuple(self._names.get(str(part), part) for part in finding.place)
        if not finding.kind and any(line["loc"] == where for line in self._lines):
            return  # one at a place: what holds for several sections is told once
        self._lines.append({"type": PydanticCustomError("fault", "{message}", context), "loc": where, "input": None})

    @contextmanager
    def at(
        self, *above: str | int, schema: type[BaseModel] = BaseModel, place: Callable[[Place], Place] | None = None
    ) -> Iterator[None]:
        """Collects what is raised inside as faults below ``above``, or at the ``place`` that is made of their own;
        ``schema`` is what was validated."""
        put = place or (lambda where: (*above, *where))
        try:
            yield
        except ValidationError as error:
            for finding in _tell(error, schema):
                self._add(replace(finding, place=put(finding.place)))
        except ConfigError as error:
            for fault in error.problems:
                self._add(_Finding(put((fault.path,) if fault.path else ()), fault.message, absent=bool(fault.path)))
        except ValueError as error:
            self._add(_Finding(put(()), str(error)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if self._lines and error is None:
            raise ValidationError.from_exception_data("faults", self._lines)


def _tell(error: ValidationError, schema: type[BaseModel]) -> Iterator[_Finding]:
    for item in error.errors(include_url=False):
        kind, place, context = item["type"], tuple(item["loc"]), item.get("ctx", {})
        if kind == "fault":
            yield _Finding(place, **context)
        elif kind == "union_tag_invalid":
            name = context["discriminator"].strip("'")
            yield _Finding((*place, name), _not_one_of(context["tag"], context["expected_tags"]), absent=True)
        elif kind == "extra_forbidden":
            hint = suggest(place[-1], sorted(_known(schema, place[:-1])))
            yield _Finding(place, f"unknown key {shown(str(place[-1]))}{hint}", at_key=True)
        elif kind != "too_short" or len(item["input"]) < context["min_length"]:  # else of its parts some are at fault
            yield _Finding(place, _message(item), absent=kind == "missing", kind=bool(_KIND.fullmatch(kind)))


def _one_each(findings: Sequence[tuple[Place, _Finding]]) -> Iterator[tuple[Place, _Finding]]:
    """One finding a place: where no kind fits, one that names all that do, unless more is told of it or its parts."""
    known = set[Place]()
    for place, finding in findings:
        more = any(p[: len(place)] == place and (p != place or not other.kind) for p, other in findings)
        if place in known or (finding.kind and more):
            continue
        known.add(place)
        if finding.kind:
            words = dict.fromkeys(other.message.partition(_NOT)[0] for p, other in findings if p == place)
            finding = replace(finding, message=" or ".join(words) + _NOT + finding.message.partition(_NOT)[2])
        yield place, finding


def _written(finding: _Finding, path: Sequence[str | int], document: Document) -> Place:
    """Pydantic puts names of union branches into the place; the document decides what is a path."""
    real = tuple(path)
    for n, part in enumerate(finding.place, 1):
        if document.has((*real, part)) or (finding.absent and n == len(finding.place)):
            real = (*real, part)
    return real


def _message(item: Any) -> str:
    kind, context = item["type"], item.get("ctx", {})
    if kind in ("value_error", "assertion_error"):
        return str(context["error"])
    if kind in ("literal_error", "enum"):
        return _not_one_of(item["input"], context["expected"].replace(" or ", ", "))
    if kind == "too_short":
        return f"give at least {context['min_length']}, not {shown(item['input'])}"
    message = _MESSAGES.get(kind, item["msg"].replace("Input should be", "should be"))
    return message if kind == "missing" else f"{message}{_NOT}{shown(item['input'])}"


def _not_one_of(written: object, expected: str) -> str:
    choices = [choice.strip("' ") for choice in expected.split(", ")]
    hint = suggest(written, choices)
    few = f"one of {', '.join(choices)}" if len(choices) > 1 else choices[0]
    return f"{shown(written)} is not {few}" + (hint if hint.startswith("; did") else "")


def _known(schema: type[BaseModel], place: Place) -> set[str]:
    """Keys accepted at ``place``: fields (or aliases) of the models found by following the annotations."""
    models = [schema]
    for part in place:
        inner = [f.annotation for m in models for k, f in m.model_fields.items() if part in (k, f.alias)]
        if inner:
            models = [m for annotation in inner for m in _models_in(annotation)]
    return {f.alias or k for m in models for k, f in m.model_fields.items()}


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
