"""Pydantic's verdicts, told as faults of the file; and fields whose meaning depends on the model: what the file gives
becomes what the program needs while it is validated.

What is known of the model is the validation context. Where the model's own section is at fault, it is asked for what it
does not know, and whatever needs that stays unread; everything else is still checked.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar, get_args

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema

from en4dvar.config.document import Document
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.plumbing.errors import ConfigError, Fault
from en4dvar.plumbing.files import expanded
from en4dvar.plumbing.hints import shown, suggest

M = TypeVar("M", bound=BaseModel)
Place = tuple[str | int, ...]

_KIND = re.compile(r"\w+_(type|parsing|parsing_size|from_float)|finite_number")  # verdicts on what a value is
_NOT = ", not "
_MESSAGES = {
    "missing": "required, but not given",
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "expected 'key: value' lines"),
    "string_too_short": "must not be empty",
    "tuple_type": "expected a list, e.g. [1, 2]",
    "string_type": "expected text; put it in quotes",
    "path_type": "expected the path of a file or folder",
    "int_parsing_size": "too large for a whole number",
    r"^\w+://\S+$": "expected an address such as tcp://10.0.0.1:8786",
    r"^\w[\w.+ -]*$": "expected letters, digits, blanks and . + - _, a letter or digit first",
}


def check(
    schema: type[M], value: Any, path: Sequence[str | int], document: Document, faults: list[Fault], context: Any = None
) -> M | None:
    """Validate ``value``, found at ``path``; every fault is appended to ``faults`` and None returned."""
    try:
        return schema.model_validate(value, context=context)
    except ValidationError as error:
        findings = [(_written(finding, path, document, schema), finding) for finding in _tell(error, schema)]
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
            hint = suggest(place[-1], _keys_at(schema, place[:-1]))
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


def _written(finding: _Finding, path: Sequence[str | int], document: Document, schema: type[BaseModel]) -> Place:
    """Pydantic puts names of union branches into the place; the document decides what is a path."""
    real = tuple(path)
    for n, part in enumerate(finding.place, 1):
        default = n == 1 and part in schema.model_fields
        if default or document.has((*real, part)) or (finding.absent and n == len(finding.place)):
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
    message = _MESSAGES.get(context.get("pattern", kind), item["msg"].replace("Input should be", "should be"))
    return message if kind == "missing" else f"{message}{_NOT}{shown(item['input'])}"


def _not_one_of(written: object, expected: str) -> str:
    choices = [choice.strip("' ") for choice in expected.split(", ")]
    hint = suggest(written, choices)
    few = f"one of {', '.join(choices)}" if len(choices) > 1 else choices[0]
    return f"{shown(written)} is not {few}" + (hint if hint.startswith("; did") else "")


def _keys_at(schema: type[BaseModel], place: Place) -> dict[str, str]:
    """Keys accepted at ``place``, and what those mean whose annotation says it: fields (or aliases) of the models found
    by following the annotations.
    """
    models = [schema]
    for part in place:
        inner = [f.annotation for m in models for k, f in m.model_fields.items() if part in (k, f.alias)]
        if inner:
            models = [m for annotation in inner for m in _models_in(annotation)]
    fields = {f.alias or k: f.metadata for m in models for k, f in m.model_fields.items()}
    return {key: " ".join(words for words in fields[key] if isinstance(words, str)) for key in sorted(fields)}


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


T = TypeVar("T")
PLACEHOLDER = "<observable>"
TEXT: Mapping[str, Any] = {"type": ["string", "number"]}  # a quantity in the JSON schema


class Unknown(Exception):
    """Something of the model that its faulty section does not tell."""


@dataclass
class Context:
    """``built``: the model of the file, None where it is at fault; then ``default`` is it with default settings.
    ``observed``: what the data hold. ``subject``: what the entry of a section by name is about, e.g. a parameter.
    """

    base: Path
    built: ForwardModel | None = None
    default: ForwardModel | None = None
    observed: Observable | None = None
    subject: Any = None

    @property
    def model(self) -> ForwardModel:
        """The model of the file. Raises :class:`Unknown`."""
        return _known(self.built)

    @property
    def units(self) -> ForwardModel:
        """A model with the units and observables of the file's. Raises :class:`Unknown`."""
        return _known(self.built or self.default)

    @property
    def observable(self) -> Observable:
        """The observable that the data hold. Raises :class:`Unknown`."""
        return _known(self.observed)

    def path(self, text: str) -> Path:
        """The absolute path of a file that the file names."""
        return self.base.absolute() / expanded(text)


def _known(thing: T | None) -> T:
    if thing is None:
        raise Unknown
    return thing


@dataclass(frozen=True, eq=False)
class Made:
    """Pydantic annotation: the file gives an ``entry`` of this type, and the field holds ``make(it, context)``, or
    None where what that needs is unknown.

    A :class:`ConfigError` of ``make`` is told at the path that its faults have below the field. In the JSON schema the
    field is ``json``; by default that of the entry, or of a quantity.
    """

    make: Callable[[Any, Context], Any]
    entry: Any = Any
    json: Mapping[str, Any] | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_after_validator_function(self._make, handler.generate_schema(self.entry))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        if self.json is not None:
            return dict(self.json)
        return dict(TEXT) if self.entry is Any else handler(schema)

    def _make(self, value: Any, info: Any) -> Any:
        with Faults() as faults, faults.at(), suppress(Unknown):
            return self.make(value, info.context)
        return None


def read_each(
    section: Mapping[str, Any],
    known: Mapping[str, Any],
    context: Context,
    faults: Faults,
    read: Callable[[Any, Context], T],
    unknown: Callable[[str], str] | None = None,
) -> dict[str, T]:
    """What ``read`` makes of each entry, named after what is ``known``; ``unknown`` words what is wrong with others."""
    values: dict[str, T] = {}
    for name, value in section.items():
        if name not in known:
            words = unknown(name) if unknown else f"unknown key {shown(name)}{suggest(name, known)}"
            faults.add((name,), words, at_key=True)
            continue
        context.subject = known[name]
        with faults.at(name):
            values[name] = read(value, context)
    return values


@dataclass(frozen=True)
class OfObservable:
    """Pydantic annotation of a section where one key is named after the observable, ``<observable>`` as declared."""

    what: str = "key"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        declared = [field.alias or name for name, field in source.model_fields.items()]

        def read(section: Any, validate: Callable[[Any], Any], info: Any) -> Any:
            observable = info.context.observed
            if not isinstance(section, dict):
                return validate(section)
            if observable is None:  # told elsewhere
                return validate({key: value for key, value in section.items() if key in declared})
            names = {key: key.replace(PLACEHOLDER, observable.name) for key in declared}
            keys = {written: key for key, written in names.items()}
            with Faults(names) as faults:
                for key in section:
                    if key not in keys:
                        faults.add((key,), f"unknown {self.what} {shown(key)}{suggest(key, keys)}", at_key=True)
                with faults.at(schema=source):
                    return validate({keys[key]: value for key, value in section.items() if key in keys})

        return core_schema.with_info_wrap_validator_function(read, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        resolved = handler.resolve_ref_schema(handler(schema))
        fixed = "|".join(key for key in resolved["properties"] if PLACEHOLDER not in key)
        resolved["patternProperties"] = {
            f"^(?!({fixed})$){key.replace(PLACEHOLDER, '.*')}$": resolved["properties"].pop(key)
            for key in list(resolved["properties"])
            if PLACEHOLDER in key
        }
        return resolved
