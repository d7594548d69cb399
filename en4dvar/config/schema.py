"""Sections of configuration files as frozen pydantic models: what they have in common, and those of every kind of file.

A key is declared once, as a field: its type, unit, bounds and default; the text below it is its description. Messages,
the JSON schema and the reference of keys follow from that.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar, cast, get_type_hints

from pydantic import ConfigDict, Discriminator, Field, Tag, WithJsonSchema, create_model, model_validator
from pydantic.fields import FieldInfo
from pydantic.functional_validators import ModelWrapValidatorHandler
from pydantic_core import to_jsonable_python

from en4dvar.config.context import Context, Faults, Made, Unknown
from en4dvar.config.quantities import quantity
from en4dvar.executor.limits import Limits, parse_bytes
from en4dvar.plumbing import user_file
from en4dvar.plumbing.described import Described, text_for
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.units import Quantity, parse_quantity
from en4dvar.schemes import DEFAULT, ON_A_WINDOW, keys_of, require_scheme, require_usable, unread
from en4dvar.schemes.base import Scheme
from en4dvar.schemes.settings import AssimilationSettings, Localisation, beside_localisation, beside_noise

QuantityText = str | int | float
T = TypeVar("T")
Name = Annotated[str, Field(pattern=r"^\w[\w.+ -]*$", max_length=100)]


class Section(Described):
    """Base of every section: unknown keys are errors, values cannot change, numbers are finite.

    The text below a key is its description in ``en4dvar schema`` and in the reference of keys.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)

    @classmethod
    def rules(cls, section: Mapping[str, Any], context: Context, faults: Faults) -> None:
        """Add what does not go together in a section as given; it is told beside the faults of single keys."""

    def check_values(self, faults: Faults) -> None:
        """Add, or raise as a ValueError, what does not go together in values that are valid one by one."""

    @model_validator(mode="wrap")
    @classmethod
    def _with_rules(cls, section: Any, validate: ModelWrapValidatorHandler[Self], info: Any) -> Self:
        with Faults() as faults:
            if isinstance(section, dict):
                with suppress(Unknown):
                    cls.rules(section, info.context, faults)
            with faults.at(schema=cls):
                checked = validate(section)
                checked.check_values(faults)
                return checked

    def part(self, kind: type[T]) -> T:
        """A dataclass whose fields are keys of this section."""
        return kind(**{field.name: getattr(self, field.name) for field in fields(cast(Any, kind))})

    def as_written(self, section: Mapping[str, Any]) -> dict[str, Any]:
        """The section as it was given, paths absolute, defaults that a file can say filled in; plain data."""
        keys = {field.alias or name: (name, field) for name, field in type(self).model_fields.items()}
        if not keys.keys() >= section.keys():  # keys named after something of the model
            plain: dict[str, Any] = _plain(section)
            return plain
        written: dict[str, Any] = {}
        for key, (name, field) in keys.items():
            value = getattr(self, name)
            text = section.get(key, _as_a_file_says(field))
            if hasattr(value, "as_written"):
                written[key] = value.as_written(text if isinstance(text, dict) else {})
            elif isinstance(value, tuple) and isinstance(text, list) and all(isinstance(v, Section) for v in value):
                written[key] = [v.as_written(part) for v, part in zip(value, text, strict=True)]
            elif isinstance(value, Path) and value.is_absolute():
                written[key] = str(value)
            elif text is not None:
                written[key] = _plain(text)
        return written


def _as_a_file_says(field: FieldInfo) -> Any:
    """The default of a key; None where a file says it otherwise, as a number in the units of the model."""
    converted = not field.validate_default and any(isinstance(it, Made | Quantity) for it in field.metadata)
    return None if converted else field.get_default(call_default_factory=True)


def _plain(value: Any) -> Any:
    """As YAML and JSON have it: no tuples, paths or numbers of other kinds."""
    return to_jsonable_python(value)


def section_of(*kinds: Any, base: type[Section] = Section) -> Any:
    """``base`` with the fields of dataclasses, declared there as ``members: Annotated[int, Ge(3), "Size."] = 48``."""
    declared: dict[str, Any] = {}
    for kind in kinds:
        hints = get_type_hints(kind, include_extras=True)
        for field in fields(kind):
            # the scheme, whose keys are a section's as well; what _require_free refuses
            if field.name == "own" or hasattr(base, field.name):
                continue
            words = [text for text in getattr(hints[field.name], "__metadata__", ()) if isinstance(text, str)]
            declared[field.name] = (hints[field.name], Field(field.default, description=" ".join(words) or None))
    return create_model(f"{base.__name__}Of", __base__=base, **declared)


class OfReadings(Section):
    """A column with a number for each reading."""

    column: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""


class Output(Section):
    """Where results go."""

    directory: Path | None = None
    """Run directory; default runs/<name>, relative to the current directory."""
    report: bool = True
    """Write report.html."""
    figures: bool = False
    """Also keep the figures of the report as PDF and PNG, in figures/."""


class File(Section):
    """A whole file."""

    name: Name
    """Name of the run; its results go to runs/<name>."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of every random number; the same seed gives the same bits on any machine and number of workers. Each data
    set draws from its own streams, by its name."""
    model: Annotated[dict[str, Any], WithJsonSchema({"x-definition": "model"})]  # see config.models
    """The forward model: its ``name`` (see ``en4dvar models``) and its settings."""


class Execution(Section):
    """Where the work is done; never changes the numbers."""

    executor: Literal["serial", "threads", "processes", "dask"] | None = None
    """What runs the members; default: threads where the model is compiled, else processes."""
    workers: Annotated[int, Field(ge=1)] | None = None
    """Parallel workers; default: the cores this process may use."""
    address: Annotated[str, Field(pattern=r"^\w+://\S+$")] | None = None
    """Address of a running dask scheduler, e.g. tcp://10.0.0.1:8786."""
    checkpoint_every: Annotated[float, Field(ge=0)] = 0.2
    """Seconds between two checkpoints of a data set; an iteration that follows sooner is not written, 0 writes all.
    Never so often that writing takes more than 5 % of the time."""

    time_limit: Annotated[float, Quantity("s"), Field(gt=0)] | None = None
    """Longest that one batch of members (one member, unless the model batches) may take, e.g. 60 s; past it they have
    failed. Needs executor processes (then the default) or dask."""
    memory_limit: Annotated[str, text_for(parse_bytes)] | None = None
    """Most that a worker process may allocate, e.g. 4 GB; members that need more have failed. Linux; needs executor
    processes (then the default) or dask."""

    @property
    def limits(self) -> Limits:
        """What a worker process may take."""
        return Limits(self.time_limit, None if self.memory_limit is None else parse_bytes(self.memory_limit))

    def check_values(self, faults: Faults) -> None:
        if self.limits and self.executor in ("serial", "threads"):
            raise ValueError(f"only a process is ended at its limit; write executor: processes, not {self.executor}")
        if self.address is not None and self.executor not in (None, "dask"):
            raise ValueError(f"address is for a dask scheduler only; write executor: dask, not {self.executor}")


def _of_coordinates(context: Context) -> str:
    """The unit of the first field of the state that has coordinates."""
    return next((f.coordinate_unit for f in context.units.layout if f.coordinates is not None), "1")


class LocalisationSection(Section):
    """Which readings act on what: by distance, or by correlation for what has no place."""

    by: Literal["distance", "correlation"] = "distance"
    """distance: covariances are tapered (Gaspari and Cohn); correlation: a reading acts on what the ensemble correlates
    it with by more than chance, which takes a scheme that minimises no J."""
    radius: Annotated[float, quantity(_of_coordinates, "positive")] | None = None
    """Radius of the taper, in the unit of the model's coordinates; no influence from twice this distance on."""
    at: dict[str, QuantityText | tuple[QuantityText, ...]] | None = None
    """Places of parameters, and of series that are no part of a field: ``{k_1: [0, 50], well: [10, 20]}``."""
    velocity: QuantityText | tuple[QuantityText, ...] | None = None
    """Of what carries the field along, in the units of the model's coordinates and of time: ``5 m/s``, or one of each
    coordinate. What is read of a field at a time acts where that was when the model's clock began."""
    threshold: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Correlations below this size are taken for chance; default 3/√N."""

    @classmethod
    def rules(cls, section: Mapping[str, Any], context: Context, faults: Faults) -> None:
        by = section.get("by", "distance")
        if by == "distance" and not {"radius", "threshold"} & section.keys():
            faults.add(("radius",), "required: how far a reading acts, or write by: correlation")
        for key in {"distance": ("threshold",), "correlation": ("radius", "at", "velocity")}.get(str(by), ()):
            if key in section:
                faults.add((key,), f"not with by: {by}", at_key=True)


def _localisation_of(section: LocalisationSection, context: Context) -> Localisation:
    unit, moving = _of_coordinates(context), section.velocity or ()
    places = {name: where if isinstance(where, tuple) else (where,) for name, where in (section.at or {}).items()}
    at = {name: tuple(parse_quantity(text, unit) for text in where) for name, where in places.items()}
    a_time = f"({unit})/({context.units.time_unit})"
    moves = tuple(parse_quantity(text, a_time) for text in (moving if isinstance(moving, tuple) else (moving,)))
    return Localisation(section.radius, at, moves, section.threshold)


class GivenStart(Section):
    """Where the one descent starts; the prior stays as it is."""

    place: Annotated[
        Path | dict[str, QuantityText],
        Made(
            lambda value, context: context.path(value) if isinstance(value, str) else value,
            Annotated[str, Field(min_length=1)] | Annotated[dict[str, QuantityText], Field(min_length=1)],
        ),
    ] = Field(alias="from")
    """Values, such as ``{G: 5 kPa}`` (the others start at the prior's mean), a file of members such as posterior.nc
    of an earlier run, whose medians are taken, or summary.csv of an earlier campaign: each data set starts at the
    centre of the one of its name, or of that before it."""


class OfScheme(Section):
    """A section that names a scheme. Its keys are its own and those of the scheme; those of others are errors."""

    kinds: ClassVar[dict[str, type[Scheme]]]

    @model_validator(mode="wrap")
    @classmethod
    def _in_a_file(cls, section: Any, validate: ModelWrapValidatorHandler[Self], info: Any) -> Self:
        """With ``scheme: ./file.py:Class``, the section of that scheme's keys, under its absolute reference."""
        name = section.get("scheme") if isinstance(section, dict) else None
        known = cls.model_fields["scheme"].annotation is str
        if known or not (isinstance(name, str) and user_file.is_file_reference(name)):
            with Faults() as faults, faults.at("scheme"):
                kind = cls.kinds.get(name, Scheme) if isinstance(name, str) and not known else Scheme
                cls._require_free(kind, section)
                require_usable(str(name))
                if isinstance(name, str) and ":" in name and name not in cls.kinds:
                    raise ConfigError(f"{shown(name)} is no scheme; one of your own is named as ./file.py:Class")
            return validate(section)
        reference = user_file.absolute(name, info.context.base)
        with Faults() as faults, faults.at("scheme"):
            # The scheme that a file holds
            kind = user_file.load(reference, f"scheme {shown(reference)}")
            require_scheme(kind, reference)
            cls._require_free(kind, section)
            cls.kinds[reference] = kind
        own = cast(Any, create_model(cls.__name__, __base__=section_of(cls.kinds[reference], base=cls), scheme=str))
        made: Self = own.model_validate({**section, "scheme": reference}, context=info.context)
        return made

    @classmethod
    def rules(cls, section: Mapping[str, Any], context: Context, faults: Faults) -> None:
        for key, message in cls.unread(section).items():
            faults.add((key,), message, at_key=True)

    @classmethod
    def _require_free(cls, kind: type[Scheme], section: Any) -> None:
        """Raise :class:`ConfigError` where a key of the scheme has a name that means something else in the section,
        or has no default and is not given.
        """
        own = cls.model_fields.keys() - frozenset().union(*map(keys_of, cls.kinds.values()))
        names = [key.name for key in fields(kind)]
        if taken := [name for name in names if name in own or hasattr(cls, name) or name.startswith("_")]:
            why = f"{shown(taken[0])} cannot be the name of a key, since it is that of something else in this section"
            raise ConfigError(f"{why}; give the field of {kind.__name__} another name")
        bare = [key.name for key in fields(kind) if key.default is key.default_factory is MISSING]
        if missing := [name for name in bare if name not in section]:
            raise ConfigError(f"{shown(missing[0])} of {kind.__name__} has no default; give the key here, or a default")

    @classmethod
    def unread(cls, section: Mapping[str, Any]) -> dict[str, str]:
        """The keys that the scheme does not read, each with a message."""
        name = section.get("scheme", cls.model_fields["scheme"].default)
        return unread(name, cls.kinds, section) if isinstance(name, str) and name in cls.kinds else {}

    @property
    def own(self) -> dict[str, Any]:
        """The keys of the scheme that were given, with their values."""
        keys = keys_of(self.kinds[getattr(self, "scheme")]) & self.model_fields_set  # noqa: B009
        return {key: getattr(self, key) for key in keys}

    def as_written(self, section: Mapping[str, Any]) -> dict[str, Any]:
        """As given, without what the scheme does not read."""
        written = {**super().as_written(section), "scheme": getattr(self, "scheme")}  # noqa: B009
        unread = type(self).unread(written)
        return {key: value for key, value in written.items() if key not in unread}


def listed(kinds: Mapping[str, type[Scheme]]) -> str:
    """The schemes, with what each is."""
    return f"The scheme: {', '.join(f'{n} ({kind.words})' for n, kind in kinds.items())}, or ./file.py:Class."


def keys_of_schemes(of: dict[str, type[Scheme]], *others: Any, base: type[OfScheme] = OfScheme) -> Any:
    """``base`` with the keys of the schemes ``of`` a kind, which are told, and with those of other dataclasses."""
    section = section_of(*others, *of.values(), base=base)
    for name, field in section.model_fields.items():
        readers = [scheme for scheme, kind in of.items() if name in keys_of(kind)]
        if 0 < len(readers) < len(of):
            field.description = f"{field.description} ({', '.join(readers)})"
    section.kinds = of
    return section


def or_in_a_file(schema: dict[str, Any]) -> None:
    """In the JSON schema: the name of a scheme, or ``./file.py:Class``."""
    schema["anyOf"] = [{"enum": schema.pop("enum")}, {"pattern": r"\.py:\w+$"}]


if TYPE_CHECKING:
    OnAWindow = str
    _Settings = OfScheme
else:
    OnAWindow = Literal[tuple(ON_A_WINDOW)]
    _Settings = keys_of_schemes(ON_A_WINDOW, AssimilationSettings)


class Assimilation(_Settings):
    """Scheme, ensemble size and stopping rules, and how observations count; the defaults are the recommended ones."""

    scheme: Annotated[OnAWindow, Field(description=listed(ON_A_WINDOW), json_schema_extra=or_in_a_file)] = DEFAULT
    weights: Literal["sum", "mean", "balanced"] = "sum"
    """sum: every observation counts (the Bayesian posterior); mean: β = 1/K, as in the published code; balanced: every
    series, or group of series, counts as if it had as many readings as the others. The latter two are not Bayesian."""
    start: Annotated[
        Annotated[Literal["best-member", "prior-mean"], Tag("a word")] | Annotated[GivenStart, Tag("a place")],
        Discriminator(lambda start: "a place" if isinstance(start, dict | GivenStart) else "a word"),
    ] = "best-member"
    """Where the iterations start: the prior members of lowest J, the prior mean, or a place that is given, from which
    one descent goes (en4dvar)."""
    localisation: Annotated[Localisation, Made(_localisation_of, LocalisationSection)] | None = None
    """Which readings act on what, for fields and for many parameters. Default: all readings on everything."""

    @classmethod
    def unread(cls, section: Mapping[str, Any]) -> dict[str, str]:
        faults: dict[str, str] = super().unread(section)
        faults = beside_noise(section) | faults
        name = section.get("scheme", DEFAULT)
        if section.get("localisation") is not None and isinstance(name, str) and name in ON_A_WINDOW:
            faults |= beside_localisation(name, section)
        return faults

    @property
    def settings(self) -> AssimilationSettings:
        """What the scheme takes."""
        common = {f.name: getattr(self, f.name) for f in fields(AssimilationSettings) if f.name != "own"}
        return AssimilationSettings(**common, **self.own)
