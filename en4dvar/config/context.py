"""Fields whose meaning depends on the model: what the file gives becomes what the program needs while it is validated.

The validation context holds what is known of the model. Where its section is at fault, what depends on it stays None:
the fault of the model is told, and everything else is still checked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict, get_args

from pydantic import AfterValidator, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from en4dvar.config.validate import Faults
from en4dvar.errors import ConfigError
from en4dvar.forward import ForwardModel, Observable
from en4dvar.hints import suggest
from en4dvar.state import Field, Parameter
from en4dvar.units import convert, parse_quantity, parse_unit

PLACEHOLDER = "<observable>"


class Context(TypedDict, total=False):
    """``model``: of the file, None where it is at fault; ``units``: it, or the same with default settings.

    ``observable``: that of the data. ``subject``: what the entry of a section by name is about, e.g. a parameter.
    """

    base: Path
    model: ForwardModel | None
    units: ForwardModel | None
    observable: Observable | None
    subject: Parameter | Field | Observable


Need = Literal["model", "units", "observable", "subject", "base"]


@dataclass(frozen=True)
class Made:
    """Pydantic annotation: the file gives a ``given``, and the field holds ``make(it, context)``.

    It holds None where the context lacks what ``make`` needs. A :class:`ConfigError` of ``make`` is told at the path
    that its faults have below the field.
    """

    make: Callable[[Any, Any], Any]
    given: Any = Any
    needs: Need = "units"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_after_validator_function(self._make, handler.generate_schema(self.given))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": ["string", "number"]} if self.given is Any else handler(schema)

    def _make(self, value: Any, info: ValidationInfo) -> Any:
        context = info.context or {}
        if context.get(self.needs) is None:
            return None
        faults, made = Faults(), None
        with faults.at():
            made = self.make(value, context)
        faults.tell()
        return made


def time_unit(context: Context) -> str:
    """The unit of the model's clock."""
    return context["units"].time_unit  # type: ignore[union-attr]


def observable_unit(context: Context) -> str:
    """The unit of the observable that the data hold."""
    return context["observable"].unit  # type: ignore[union-attr]


def subject_unit(context: Context) -> str:
    """The unit of what an entry is about."""
    return context["subject"].unit


def no_unit(context: Context) -> str:
    """That of a ratio."""
    return "1"


def quantity(
    unit: Callable[[Context], str], sign: Literal["", "positive", "not negative"] = "", needs: Need = "units"
) -> Made:
    """A number in ``unit``, given with a unit of its own."""

    def read(text: Any, context: Context) -> float:
        value = parse_quantity(text, unit(context))
        if sign:
            require_sign(value, sign, text)
        return value

    return Made(read, needs=needs)


@dataclass(frozen=True)
class Spread:
    """A standard deviation: ``value`` in a unit, or a share of something known later."""

    value: float
    relative: bool = False

    def absolute(self, whole: float) -> float:
        """The standard deviation in the unit of ``whole``."""
        return self.value * abs(whole) if self.relative else self.value


def parse_spread(text: Any, unit: str) -> Spread:
    """``"0.1 kPa"``, or relative, ``"5 %"``; positive. Raises :class:`ConfigError`, :class:`UnitError`."""
    relative = str(text).strip().endswith("%") and unit != "%"
    spread = Spread(parse_quantity(text, "1" if relative else unit), relative)
    require_sign(spread.value, "positive", text)
    return spread


def require_sign(value: float, sign: Literal["positive", "not negative"], text: object) -> None:
    """Raises :class:`ConfigError` for a value of another sign."""
    if sign == "positive" and not value > 0:
        raise ConfigError(f"must be positive, not {text}")
    if value < 0:
        raise ConfigError(f"must not be negative, not {text}")


def _known_unit(unit: str) -> str:
    parse_unit(unit)
    return unit


def unit_of(target: Callable[[Context], str], needs: Need = "units") -> Made:
    """The text of a unit that can be converted to ``target``."""

    def fits(unit: str, context: Context) -> str:
        convert(1.0, unit, target(context))
        return unit

    return Made(fits, Annotated[str, AfterValidator(_known_unit)], needs)


def _nothing_missing(name: str, subject: Any, model: ForwardModel) -> None:
    return None


def _unknown_key(name: str, known: Mapping[str, Any], model: ForwardModel) -> str:
    return f"unknown key {name!r}{suggest(name, known)}"


@dataclass(frozen=True)
class ByName:
    """Pydantic annotation of a dict: one entry a name that the model knows, read with the thing named as ``subject``.

    ``unknown`` words a name that the model does not know, ``missing`` one that is not given and has to be; ``some``: one
    at least has to be given.
    """

    known: Callable[[ForwardModel], Mapping[str, Any]]
    unknown: Callable[[str, Mapping[str, Any], ForwardModel], str] = _unknown_key
    missing: Callable[[str, Any, ForwardModel], str | None] = _nothing_missing
    some: bool = False
    definition: str = ""  # of an entry in the JSON schema

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        entry = handler.generate_schema(get_args(source)[1])
        return core_schema.with_info_wrap_validator_function(self._read, entry)

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        found = handler(core_schema.dict_schema(core_schema.str_schema(), schema["schema"]))
        if self.definition:
            found["additionalProperties"] = {"x-definition": self.definition}
        return found | {"minProperties": 1} if self.some else found

    def _read(self, given: Any, read_entry: Callable[[Any], Any], info: ValidationInfo) -> dict[str, Any]:
        if not isinstance(given, dict):
            raise PydanticKnownError("dict_type")
        context: Any = info.context or {}
        model = context.get("model")
        if model is None:
            return {}
        known, faults, entries = self.known(model), Faults(), {}
        if self.some and not given:
            faults.add((), f"give at least one of: {', '.join(known)}")
        for name, value in given.items():
            if name not in known:
                faults.add((name,), self.unknown(name, known, model), at_key=True)
                continue
            context["subject"] = known[name]
            with faults.at(name):
                entries[name] = read_entry(value)
        for name in known:
            if name not in given and (words := self.missing(name, known[name], model)):
                faults.add((name,), words)
        faults.tell()
        return entries


@dataclass(frozen=True)
class OfObservable:
    """Pydantic annotation of a section where one key is named after the observable, ``<observable>`` as declared."""

    what: str = "key"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        declared = [field.alias or name for name, field in source.model_fields.items()]

        def read(given: Any, validate: Callable[[Any], Any], info: ValidationInfo) -> Any:
            observable = (info.context or {}).get("observable")
            if not isinstance(given, dict):
                return validate(given)
            if observable is None:  # told elsewhere
                return validate({key: value for key, value in given.items() if key in declared})
            names = {key: key.replace(PLACEHOLDER, observable.name) for key in declared}
            keys = {written: key for key, written in names.items()}
            faults = Faults(names)
            for key in given:
                if key not in keys:
                    faults.add((key,), f"unknown {self.what} {key!r}{suggest(key, keys)}", at_key=True)
            with faults.at(schema=source):
                section = validate({keys[key]: value for key, value in given.items() if key in keys})
            faults.tell()
            return section

        return core_schema.with_info_wrap_validator_function(read, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        found = handler.resolve_ref_schema(handler(schema))
        fixed = "|".join(key for key in found["properties"] if PLACEHOLDER not in key)
        found["patternProperties"] = {
            f"^(?!({fixed})$){key.replace(PLACEHOLDER, '.*')}$": found["properties"].pop(key)
            for key in list(found["properties"])
            if PLACEHOLDER in key
        }
        return found
