"""Fields whose meaning depends on the model: what the file gives becomes what the program needs while it is validated.

What is known of the model is the validation context. Where the model's own section is at fault, it is asked for what it
does not know, and whatever needs that stays unread; everything else is still checked.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from en4dvar.config.validate import Faults
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.plumbing.described import text_for
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.files import expanded
from en4dvar.plumbing.hints import brief, shown, suggest
from en4dvar.plumbing.units import convert, parse_quantity, parse_unit

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


Unit = Callable[[Context], str]


def time_unit(context: Context) -> str:
    return context.units.time_unit


def observable_unit(context: Context) -> str:
    return context.observable.unit


def subject_unit(context: Context) -> str:
    return str(context.subject.unit)


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


def quantity(unit: Unit, sign: Literal["", "positive", "not negative"] = "") -> Made:
    """A number in ``unit``, given with a unit of its own."""

    def read(text: Any, context: Context) -> float:
        value = parse_quantity(text, unit(context))
        if sign:
            require_sign(value, sign, text)
        return value

    return Made(read)


def require_sign(value: float, sign: Literal["positive", "not negative"], text: object) -> None:
    """Raises :class:`ConfigError` for a value of another sign."""
    if sign == "positive" and not value > 0:
        raise ConfigError(f"must be positive, not {brief(str(text), 80)}")
    if value < 0:
        raise ConfigError(f"must not be negative, not {brief(str(text), 80)}")


@dataclass(frozen=True)
class Spread:
    """A standard deviation: ``value`` in a unit, or a share of something known later."""

    value: float
    relative: bool = False
    unit: str = ""  # as it is written

    def absolute(self, whole: float) -> float:
        """The standard deviation in the unit of ``whole``."""
        return self.value * abs(whole) if self.relative else self.value


def parse_spread(text: Any, unit: str, usual: str = "") -> Spread:
    """``"0.1 kPa"``, or relative, ``"5 %"``; positive. Raises :class:`ConfigError`, :class:`UnitError`."""
    relative = str(text).strip().endswith("%") and unit != "%"
    spread = Spread(parse_quantity(text, "1" if relative else unit, usual), relative)
    require_sign(spread.value, "positive", text)
    return spread


SPREAD = Made(lambda text, context: parse_spread(text, subject_unit(context), context.subject.display_unit))
"""A :class:`Spread` of what the entry of a section is about."""


def unit_of(target: Unit) -> Made:
    """The text of a unit that can be converted to ``target``."""

    def fits(unit: str, context: Context) -> str:
        convert(1.0, unit, target(context))
        return unit

    return Made(fits, Annotated[str, text_for(parse_unit)])


def read_each(
    section: Mapping[str, Any],
    known: Mapping[str, Any],
    context: Context,
    faults: Faults,
    read: Callable[[Any, Context], T],
    unknown: Callable[[str], str] | None = None,
) -> dict[str, T]:
    """The result of ``read`` for each entry of a section whose keys are the names of ``known`` things, its subjects.

    ``unknown`` words what is wrong with another name.
    """
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
