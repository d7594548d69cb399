"""The ``data:`` section, of one series or of several: which files, how they are read, which observations are used."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, cast, get_args

from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, Tag, WithJsonSchema, model_validator

from en4dvar.config.context import PLACEHOLDER, TEXT, Context, Faults, Made, OfObservable, Place
from en4dvar.config.of_readings import BOUNDS, PLACES, WEIGHTS, Error, Placing, Weighing
from en4dvar.config.quantities import observable_unit, quantity, time_unit, unit_of
from en4dvar.config.schema import Name, QuantityText, Section
from en4dvar.inputs.decimal_sign import Decimal
from en4dvar.inputs.formats import Disorder, Format, Outliers, Repeated
from en4dvar.inputs.parts import Column, TimeStep
from en4dvar.inputs.window import Instant, parse_instant
from en4dvar.model.forward import Observable, field_of
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.files import expanded
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.plumbing.units import UnitError, as_unit, parse_quantity


class Pixel(Section):
    """Lengths that were measured in pixels."""

    pixel: QuantityText
    """What one is long, e.g. 2.76 um."""


def _unit_text(written: Any) -> Any:
    if not isinstance(written, Mapping):
        return written
    if written.keys() != {"pixel"}:
        raise ValueError("write a unit such as um, or {pixel: 2.76 um}")
    return as_unit(str(written["pixel"]), "um")


class _NamedColumn(Section):
    @model_validator(mode="before")
    @classmethod
    def _no_name_alone(cls, written: Any) -> Any:
        if isinstance(written, str):
            raise ValueError(f"its unit is missing; write {{name: {written}, unit: <that of the file>}}")
        return written


class ValueColumn(_NamedColumn):
    """A column of a CSV file or a field of a ``.mat`` file; the unit is required, never guessed."""

    name: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat); ``R_*`` makes each column a data set."""
    unit: Annotated[str, unit_of(observable_unit), BeforeValidator(_unit_text, json_schema_input_type=str | Pixel)]
    """Unit of the numbers in the file, e.g. um, or ``{pixel: 2.76 um}``; required, never guessed."""


class TimeColumn(_NamedColumn):
    """Observation times: a column, or a constant step (a scalar of the file, or a quantity such as ``0.63 us``)."""

    model_config = ConfigDict(
        json_schema_extra={
            "dependentRequired": {"name": ["unit"]},
            "oneOf": [{"required": ["name"]}, {"required": ["step"]}],
        }
    )
    name: str | None = None
    """Column of times; give this or ``step``."""
    step: QuantityText | None = None
    """Constant time step: a quantity such as 0.63 us, or the name of a scalar in the file (then with ``unit``)."""
    unit: Annotated[str | None, unit_of(time_unit)] = None
    """Unit of the times in the file, e.g. us; required with ``name``, never guessed."""
    rate: Annotated[float, quantity(lambda context: f"1/({time_unit(context)})", "positive")] | None = None
    """Frame rate of the camera, e.g. 270 kHz; the column of times is compared with it."""

    def check_values(self, faults: Faults) -> None:
        if (self.name is None) == (self.step is None):
            raise ValueError("give either 'name' (a column of times) or 'step' (a constant time step)")
        if self.name is not None and "unit" not in self.model_fields_set:
            raise ValueError(f"the unit of column {self.name!r} is missing; write unit: us")
        if self.rate is not None and self.name is None:
            raise ValueError("'rate' is compared with a column of times; a step needs none")


def _times(section: TimeColumn, context: Context) -> Column | TimeStep:
    unit = time_unit(context)
    if section.unit is not None:
        named = Column(str(section.name or section.step), section.unit, unit, rate=section.rate)
        return named if section.name else TimeStep(named)
    with retold(UnitError, ConfigError, "", "step"):
        return TimeStep(value=parse_quantity(section.step or 0, unit))


def _values(section: ValueColumn, context: Context) -> Column:
    positive = context.observed is not None and context.observed.positive
    return Column(section.name, section.unit, observable_unit(context), positive)


class Columns(Section):
    """Which columns hold the time and the observable, each with its unit: ``time: {name: t, unit: us}``."""

    model_config = ConfigDict(json_schema_extra={"required": ["time"]}, populate_by_name=False)
    time: Annotated[Column | TimeStep, Made(_times, TimeColumn)] = cast(Any, None)  # a rule says what is missing
    """Observation times."""
    observable: Annotated[Column, Made(_values, ValueColumn), Field(alias=PLACEHOLDER)] = cast(Any, None)
    """The observable."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        if keys.get("time") is None:
            unit = time_unit(context)
            faults.add(("time",), f"required: {{name: <column>, unit: {unit}}}, or {{step: <quantity>}}")


def _instant(text: Any, context: Context) -> Instant:
    possible = (context.observed,) if context.observed else context.units.observables
    symbols = {word for observable in possible for word in (observable.symbol.strip("$"), observable.name)}
    return parse_instant(text, time_unit(context), symbols)


def _prominence(text: Any, context: Context) -> float:
    value = parse_quantity(text, "1")
    if not 0 < value < 1:
        raise ValueError("must lie between 0 and 100 %")
    return value


class WindowSection(Section):
    """First and last observation used (the assimilation window): ``top``, ``trough 2``, ``maximum``, ``minimum 2``,
    ``20 % of maximum``, a time, or ``start``/``end`` of the file; default: all."""

    start: Annotated[Instant, Made(_instant)] = Field("start", alias="from", validate_default=True)
    """First observation: start, top, maximum (also written x_max), trough N, minimum N, or a time on the
    file's clock."""
    end: Annotated[Instant, Made(_instant)] = Field("end", alias="to", validate_default=True)
    """Last observation: end, top, maximum, trough N, minimum N (counted from the window's start), 20 % of maximum (the
    last one before the fall below it), trough N or end (that of files with fewer), or a time on the file's clock."""
    until: Annotated[Instant, Made(_instant)] = Field("end", validate_default=True)
    """Last reading after the window that is predicted; later ones are no longer of the same system."""
    prominence: Annotated[float, Made(_prominence)] = Field("10 %", validate_default=True)
    """How deep a minimum must be to count, relative to the range of the series."""


TimeZero = Literal["file", "window", "top"]


class TimeOfFile(Section):
    """An instant that each data file holds as a scalar, on its own clock: the delay of its trigger."""

    from_file: Annotated[str, Field(min_length=1)]
    """Name of a scalar in each data file, e.g. of a line ``# delay = 7.0``, or of a column with one value a data set
    (data.by)."""
    unit: Annotated[str, unit_of(time_unit)]
    """Unit of that scalar in the file."""
    plus: Annotated[float, quantity(time_unit, "any")] = 0.0
    """A time that is added to it, the same for all files: from the trigger to the pulse's arrival."""


TIME_OR_SCALAR = {"anyOf": [TEXT, TimeOfFile.model_json_schema()]}


def read_time_zero(written: Any, context: Context) -> TimeZero | float | tuple[Column, float]:
    """Of a scalar of each file with what is added to it, in the model's unit."""
    if isinstance(written, Mapping):
        it = TimeOfFile.model_validate(written, context=context)
        return Column(it.from_file, it.unit, time_unit(context)), it.plus
    if written in get_args(TimeZero):
        return cast(TimeZero, written)
    with retold(UnitError, UnitError, "write file, window, top, a time or {from_file: NAME, unit: UNIT}: "):
        return parse_quantity(written, time_unit(context))


def _files(written: str | tuple[str, ...], context: Context) -> tuple[str, ...]:
    """Paths and patterns from the root on."""
    if not written or not all(written):
        raise ValueError("no file is named")
    texts = (written,) if isinstance(written, str) else written
    return tuple(str(context.base / expanded(text)) for text in texts)


class Data(Section):
    """Where the observations are, what they mean and how well they are known; in the model's units."""

    path: Annotated[tuple[str, ...], Made(_files, str | tuple[str, ...])]
    """A data file, a folder (one without data files: its subfolders), a pattern such as data/*.csv, or a list of them;
    relative to this file's folder."""
    name: Name | None = None
    """Name of the data set, where there is one; default: that of its file (of several series, of the first's)."""
    format: Format | None = None
    """Format of the files; default: by their suffix."""
    decimal: Decimal = "."
    """Decimal sign of the numbers in a CSV file, where they do not tell it: beside 998.2, 1,201 is 1201."""
    by: Annotated[str | None, Field(min_length=1)] = None
    """Column of a table that says which data set a row belongs to: each is estimated by itself."""
    sheet: str = ""
    """Sheet of an Excel workbook, a range of it, or both: ``Film 3``, ``A3:D40``, ``Film 3!A3:D40``."""
    unsorted: Disorder = "refuse"
    """What to do with rows whose times do not increase: refuse the file, or sort them."""
    repeated: Repeated = "refuse"
    """What to do with several readings of one time, without ``places``: refuse the file, or average them."""
    outliers: Outliers = "keep"
    """Readings far from what three neighbours to each side say (8 standard deviations): keep, or leave out. Up to
    three in a row are judged together; the bottom of a collapse is kept."""
    since: Annotated[Instant, Made(_instant)] = Field("start", validate_default=True)
    """First reading that is looked at, as if the file began with it: an instant as in ``window``, such as ``trough 1``,
    seen in the whole file."""
    columns: Annotated[Columns, OfObservable("column role")]
    window: WindowSection = Field({}, validate_default=True)
    time_zero: Annotated[TimeZero | float | tuple[Column, float], Made(read_time_zero, json=TIME_OR_SCALAR)] = Field(
        "file", validate_default=True
    )
    """Where the model's clock starts: file (the file's own zero), window (the first observation used), top (the vertex
    of a parabola through the readings about the largest), a time, or ``{from_file: delay, unit: us}``, an instant that
    each file states as a scalar."""
    weights: Annotated[Weighing | None, WEIGHTS] = None
    """How often each observation counts, beside ``assimilation.weights``: a list, ``{column: NAME}``,
    ``{zero_near_minima: 2 us}``, or ``{function: ./weights.py:name}``. Other than 0 and 1 they are not Bayesian."""
    places: Annotated[Placing | None, PLACES] = None
    """Where on an observed field: an index, a coordinate such as 3 m, a list of them, or ``{column: NAME}``, with
    ``unit`` for coordinates. There may then be several readings at a time."""
    error: Annotated[Error, OfObservable()]

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        for key, word in (("repeated", "average"), ("outliers", "leave out")):
            if keys.get(key) == word and "places" in keys:
                faults.add((key,), "not together with places, of which each has a reading of its own", at_key=True)
        error = keys.get("error")
        if keys.get("repeated") == "average" and isinstance(error, dict) and any(map(error.get, BOUNDS)):
            faults.add(("repeated",), f"not together with {' or '.join(BOUNDS)}: bounds have no mean", at_key=True)
        block = field_of(context.units, context.observed) if context.observed else None
        if block is not None and block.size > 1 and "places" not in keys:
            faults.add(("places",), f"required: {block.name!r} is a field of {block.size} values; say which were read")
        columns = keys.get("columns")
        if context.observed:
            if not isinstance(columns, dict) or context.observed.name not in columns:
                name = context.observed.name
                faults.add(("columns", name), f"required: the column of {name}, {{name: <column>, unit: <unit>}}")
            return
        if not isinstance(columns, dict):
            return
        roles = ["time", *(observable.name for observable in context.units.observables)]
        for name in columns:
            if name not in roles:
                faults.add(("columns", name), f"unknown column role {shown(name)}{suggest(name, roles)}", at_key=True)
        if columns.keys() <= set(roles):
            faults.add(("columns",), f"name the column of one observable of: {', '.join(roles[1:])}")

    @property
    def columns_beside(self) -> dict[str, Column]:
        """The columns that hold errors of readings or times, say which readings are bounds, their weights or places."""
        time = self.columns.time
        clock = time if isinstance(time, Column) else time.column
        errors = self.error.columns(self.columns.observable.unit, clock.unit if clock else "")
        stated = {"weights": self.weights, "places": self.places}
        return errors | {key: it.column for key, it in stated.items() if it is not None and it.column is not None}

    def as_written(self, source: Mapping[str, Any]) -> dict[str, Any]:
        """The section as it was written, with absolute paths."""
        written = super().as_written(source)
        written["path"] = self.path[0] if len(self.path) == 1 else list(self.path)
        if self.error.covariance is not None:
            written["error"]["covariance"]["path"] = str(self.error.covariance.path)
        if self.weights is not None and self.weights.stated is not None:
            written["weights"] = self.weights.stated
        return written


RESERVED = ("time", "path_time", "reading", "parameter", "chain", "draw", "correlation", "mode", "active", "dfs")
EACH = {"type": "object", "minProperties": 1, "additionalProperties": {"x-definition": "series"}}
Correlation = Annotated[float, Field(gt=-1, lt=1)]


class SeriesData(Data):
    """One series: where its readings are, and what they are of."""

    observable: str | None = None
    """Name of the observable that was read; default: the name of the series."""
    group: Annotated[str | None, Field(min_length=1)] = None
    """Series of one group count as one when weights are ``balanced``; default: each by itself."""


@dataclass(frozen=True)
class SeriesPlan:
    """How one series is read."""

    name: str
    observable: Observable
    data: Data
    group: str = ""


@dataclass(frozen=True)
class DataPlan:
    """How a data set is read: its series, and the correlation of the errors of two of them at equal times."""

    series: tuple[SeriesPlan, ...]
    correlation: Mapping[tuple[str, str], float]

    def as_written(self, source: Mapping[str, Any]) -> dict[str, Any]:
        """The section as it was written, each series complete, with absolute paths."""
        if "series" not in source:
            return self.series[0].data.as_written(source)
        common, written = _common(source), dict[str, Any]()
        for series in self.series:
            section = series.data.as_written(_merged(common, source["series"][series.name]))
            written[series.name] = {key: value for key, value in section.items() if value is not None and key != "name"}
        rest = {key: source[key] for key in ("name", "correlation") if source.get(key)}
        return {"series": written, **rest}


class DataOfSeries(Section):
    """Several series that are assimilated together, each with its own file, times, units, errors and weights.

    Every other key of ``data:`` holds for all series that do not say otherwise, for instance the path of a file that
    has a column of each.
    """

    model_config = ConfigDict(extra="allow")

    series: Annotated[dict[str, Any], Field(min_length=1), WithJsonSchema(EACH)]
    """Name of the series → what ``data:`` says of a single one; the name is that of its observable, unless it says
    ``observable``."""
    correlation: dict[str, dict[str, Correlation]] | None = None
    """Correlation of the errors of two series at equal times: ``prey: {predator: 0.5}``."""


def _common(keys: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in keys.items() if key not in ("series", "correlation")}


def _merged(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a series over those that hold for all; sections are merged key by key."""
    sections = [key for key, value in own.items() if isinstance(value, dict) and isinstance(common.get(key), dict)]
    return {**common, **own, **{key: {**common[key], **own[key]} for key in sections}}


def _plan(section: DataOfSeries, context: Context) -> DataPlan:
    keys = {"series": section.series, **(section.model_extra or {})}
    common, plans = _common(keys), dict[str, SeriesPlan]()
    with Faults() as faults:
        for name, own in section.series.items():
            if not isinstance(own, dict):
                faults.add(("series", name), "expected 'key: value' lines")
            elif "name" in own:
                words = "a data set has one name; write it above the series"
                faults.add(("series", name, "name"), words, at_key=True)
            elif fault := _name_fault(name, {**common, **own}, context):
                faults.add(("series", name), fault, at_key=True)
            else:

                def place(where: Place, name: str = name, own: dict[str, Any] = own) -> Place:
                    return ("series", name, *where) if _has(own, where) or not _has(common, where) else where

                with faults.at(schema=SeriesData, place=place):
                    plans[name] = _series(name, _merged(common, own), context)
        for name, others in (section.correlation or {}).items():
            for other in others:
                _check_pair(name, other, section, faults)
    context.observed = None
    pairs = {(a, b): value for a, others in (section.correlation or {}).items() for b, value in others.items()}
    return DataPlan(tuple(plans.values()), pairs)


def _has(keys: Any, where: Place) -> bool:
    """True if the section says something at a place, or above it."""
    return (
        bool(where)
        and isinstance(keys, dict)
        and where[0] in keys
        and (len(where) == 1 or not isinstance(keys[where[0]], dict) or _has(keys[where[0]], where[1:]))
    )


def _name_fault(name: str, keys: Mapping[str, Any], context: Context) -> str:
    """The fault of a series' name, after which variables of the result are called; "" where there is none."""
    if not name.isidentifier() or name in RESERVED:
        return f"{shown(name)} cannot be the name of a series; use letters, digits and _, as in well_3"
    known = [observable.name for observable in context.units.observables]
    if "observable" in keys or name in known:
        return ""
    return f"unknown observable {shown(name)}{suggest(name, known)}; of another name, it has to say observable: NAME"


def _series(name: str, keys: dict[str, Any], context: Context) -> SeriesPlan:
    known = {observable.name: observable for observable in context.units.observables}
    chosen = str(keys.get("observable", name))
    if chosen not in known:
        raise ConfigError(f"unknown observable {shown(str(chosen))}{suggest(str(chosen), known)}", "observable")
    context.observed = known[chosen]
    data = SeriesData.model_validate(keys, context=context)
    if data.error is not None and data.error.discrepancy is not None:
        words = "a discrepancy is that of a single series; leave it out, or estimate this series by itself"
        raise ConfigError(words, "error.discrepancy")
    return SeriesPlan(name, known[chosen], data, data.group or name)


def _check_pair(name: str, other: str, section: DataOfSeries, faults: Faults) -> None:
    if name not in section.series:
        faults.add(("correlation", name), f"no series {shown(name)}{suggest(name, section.series)}", at_key=True)
    elif other not in section.series or other == name:
        others = [candidate for candidate in section.series if candidate != name]
        message = f"no other series {shown(other)}{suggest(other, others)}"
        faults.add(("correlation", name, other), message, at_key=True)
    elif name in ((section.correlation or {}).get(other) or {}) and name > other:
        faults.add(("correlation", name, other), f"given as {other}: {{{name}: …}} as well", at_key=True)


_ALONE = Made(lambda section, c: DataPlan((SeriesPlan(c.observable.name, c.observable, section),), {}), Data)
DATA = Annotated[
    Annotated[DataPlan, _ALONE, Tag("of one series")]
    | Annotated[DataPlan, Made(_plan, DataOfSeries), Tag("of several series")],
    Discriminator(lambda data: "of several series" if isinstance(data, dict) and "series" in data else "of one series"),
]
