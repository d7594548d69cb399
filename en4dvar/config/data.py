"""The ``data:`` section: which files, columns and window, and how well the observations are known."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from en4dvar.config.context import (
    PLACEHOLDER,
    TEXT,
    Context,
    Made,
    OfObservable,
    Spread,
    observable_unit,
    quantity,
    require_sign,
    time_unit,
    unit_of,
)
from en4dvar.config.schema import QuantityText, Section
from en4dvar.config.validate import Faults
from en4dvar.errors import ConfigError, Fault
from en4dvar.files import expanded
from en4dvar.hints import shown, suggest
from en4dvar.inputs.readers import Column, Disorder, Format, Layout, Matrix, Repeated, TimeStep
from en4dvar.inputs.text_table import Decimal
from en4dvar.inputs.window import Instant, parse_instant
from en4dvar.noise import SMOOTHNESS, Kernel
from en4dvar.prior import PriorTerm
from en4dvar.state import Array, Parameter
from en4dvar.units import UnitError, convert, parse_quantity

_RELATIVE = re.compile(r"(.*%)\s+of\s+(?:the\s+)?maximum")
_OF_WINDOW = re.compile(r"(.*%)\s+of\s+(?:the\s+)?window")
HUBER = 1.345  # 95 % efficiency where the errors are Gaussian after all: Huber (1981), Robust Statistics


@dataclass(frozen=True)
class Files:
    """Files, folders and patterns, relative to ``base``."""

    base: Path
    texts: tuple[str, ...]


class Pixel(Section):
    """Lengths that were measured in pixels."""

    pixel: QuantityText
    """What one is long, e.g. 2.76 um."""


def _unit_text(given: Any) -> Any:
    if not isinstance(given, Mapping):
        return given
    number, _, unit = str(given.get("pixel", "")).strip().partition(" ")
    if given.keys() != {"pixel"} or not unit:
        raise ValueError("write a unit such as um, or {pixel: 2.76 um}")
    return f"{number}*{unit}"


class ValueColumn(Section):
    """A column of a CSV file or a field of a ``.mat`` file; the unit is required, never guessed."""

    name: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat); ``R_*`` is a data set a column."""
    unit: Annotated[str, unit_of(observable_unit), BeforeValidator(_unit_text, json_schema_input_type=str | Pixel)]
    """Unit of the numbers in the file, e.g. um, or ``{pixel: 2.76 um}``; required, never guessed."""


class TimeColumn(Section):
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
    rate: QuantityText | None = None
    """Frame rate of the camera, e.g. 270 kHz; the column of times is compared with it."""

    @model_validator(mode="after")
    def _one_of(self) -> Self:
        if (self.name is None) == (self.step is None):
            raise ValueError("give either 'name' (a column of times) or 'step' (a constant time step)")
        if self.name is not None and "unit" not in self.model_fields_set:
            raise ValueError(f"the unit of column {self.name!r} is missing; write unit: us")
        if self.rate is not None and self.name is None:
            raise ValueError("'rate' is compared with a column of times; a step needs none")
        return self


def _times(given: TimeColumn, context: Context) -> Column | TimeStep:
    unit = time_unit(context)
    rate = None if given.rate is None else _rate(given.rate, unit)
    if given.unit is not None:
        named = Column(str(given.name or given.step), given.unit, unit, rate=rate)
        return named if given.name else TimeStep(named)
    try:
        return TimeStep(value=parse_quantity(given.step or 0, unit))
    except UnitError as error:
        raise ConfigError([Fault(str(error), "step")]) from None


def _rate(text: Any, unit: str) -> float:
    try:
        value = parse_quantity(text, f"1/({unit})")
        require_sign(value, "positive", text)
    except ValueError as error:
        raise ConfigError([Fault(str(error), "rate")]) from None
    return value


def _values(given: ValueColumn, context: Context) -> Column:
    positive = context.observed is not None and context.observed.positive
    return Column(given.name, given.unit, observable_unit(context), positive)


_VALUES = Made(_values, ValueColumn)


class Columns(Section):
    """Which columns hold the time and the observable, each with its unit."""

    model_config = ConfigDict(json_schema_extra={"required": ["time"]}, populate_by_name=False)
    time: Annotated[Column | TimeStep, Made(_times, TimeColumn)] = None  # type: ignore[assignment]  # told by a rule
    """Observation times."""
    observable: Annotated[Column, _VALUES, Field(alias=PLACEHOLDER)] = None  # type: ignore[assignment]  # the same
    """The observable."""

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        if given.get("time") is None:
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
    """First and last observation used: ``maximum``, ``minimum 2``, a time, or ``start``/``end`` of the file."""

    start: Annotated[Instant, Made(_instant)] = Field("start", alias="from", validate_default=True)
    """First observation: start, maximum (for the bubble also R_max), minimum N, or a time on the file's clock."""
    end: Annotated[Instant, Made(_instant)] = Field("end", alias="to", validate_default=True)
    """Last observation: end, maximum, minimum N (counted from the window's start), or a time on the file's clock."""
    prominence: Annotated[float, Made(_prominence)] = Field("10 %", validate_default=True)
    """How deep a minimum must be to count, relative to the range of the series."""


def _square(context: Context) -> str:
    unit = observable_unit(context)
    return "1" if unit == "1" else f"({unit})*({unit})"


class CovarianceFile(Section):
    """A CSV file of the full matrix R, without header; its unit (e.g. ``um^2``) is required, never guessed."""

    path: Annotated[str, Field(min_length=1)]
    """CSV file, relative to the configuration's folder; one row an observation of the window or of the series."""
    unit: Annotated[str, unit_of(_square)]
    """Unit of the covariances, the observable's squared, e.g. um^2."""


def _matrix(given: CovarianceFile, context: Context) -> Matrix:
    return Matrix(context.base / expanded(given.path), given.unit, _square(context))


def parse_error_std(text: Any, unit: str) -> Spread:
    """``"1.4 um"`` or ``"1 % of maximum"``. Raises :class:`UnitError`."""
    word = str(text).strip()
    relative = _RELATIVE.fullmatch(word)
    if relative:
        return Spread(parse_quantity(relative[1], "1"), relative=True)
    try:
        return Spread(parse_quantity(text, unit))
    except UnitError as error:
        hint = f"; write '{word} of maximum'" if word.endswith("%") else ""
        raise UnitError(f"{error}{hint}") from None


class ErrorColumn(Section):
    """A column of standard deviations, one a reading."""

    column: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""
    unit: str | None = None
    """Unit of the numbers in it; default: that of the readings' own column."""


def _error_column(given: Any, context: Context, target: str) -> Column:
    chosen = ErrorColumn.model_validate(given, context=context)
    if chosen.unit is not None:
        convert(1.0, chosen.unit, target)
    return Column(chosen.column, chosen.unit or "", target)


def _error_std(text: Any, context: Context) -> Spread | Column:
    if isinstance(text, Mapping):
        return _error_column(text, context, observable_unit(context))
    spread = parse_error_std(text, observable_unit(context))
    require_sign(spread.value, "positive", text)
    return spread


def _length(text: Any, context: Context) -> Spread:
    relative = _OF_WINDOW.fullmatch(str(text).strip())
    spread = Spread(
        parse_quantity(relative[1] if relative else text, "1" if relative else time_unit(context)), bool(relative)
    )
    require_sign(spread.value, "positive", text)
    return spread


def _rate_unit(context: Context) -> str:
    return f"({observable_unit(context)})/({time_unit(context)})"


LogStd = Annotated[float, Field(gt=0)]


class AmplitudeSection(Section):
    """Lognormal prior of the discrepancy's standard deviation."""

    median: Annotated[Spread, Made(_error_std)] = Field("0.5 % of maximum", validate_default=True)
    """A quantity in the observable's unit, or e.g. '2 % of maximum'."""
    log_std: LogStd = 1.5
    """Standard deviation of the natural logarithm."""


class LengthSection(Section):
    """Lognormal prior of the time over which the discrepancy forgets itself."""

    median: Annotated[Spread, Made(_length)] = Field("10 % of window", validate_default=True)
    """A time, or e.g. '10 % of window'."""
    log_std: LogStd = 0.7
    """Standard deviation of the natural logarithm."""


class DiscrepancySection(Section):
    """What the model misses: a Gaussian process beside the errors whose amplitude and length are estimated."""

    amplitude: AmplitudeSection = Field({}, validate_default=True)
    """Prior of ``discrepancy_amplitude``, its standard deviation."""
    length: LengthSection = Field({}, validate_default=True)
    """Prior of ``discrepancy_length``, its correlation time."""
    kernel: Literal["exponential", "matern-3/2", "matern-5/2"] = "exponential"
    """Correlation in time: exponential (rough paths), or Matérn's with one or two derivatives."""
    grows_beyond: Annotated[float | None, quantity(_rate_unit, "positive")] = None
    """Rate of the observable beyond which the amplitude grows in proportion to it, e.g. 20 m/s; default: constant."""

    def kernel_at(self, times: Array) -> Kernel:
        """The kernel at observation times (K,)."""
        return Kernel(times, SMOOTHNESS[self.kernel], self.grows_beyond or math.inf)

    def terms(self, parameters: tuple[Parameter, Parameter], maximum: float, window: float) -> tuple[PriorTerm, ...]:
        """Priors of amplitude and length, from the largest observation and the duration of the window."""
        amplitude, length = parameters
        return (
            PriorTerm.lognormal(amplitude, self.amplitude.median.absolute(maximum), self.amplitude.log_std),
            PriorTerm.lognormal(length, self.length.median.absolute(window), self.length.log_std),
        )


def _estimated(given: Any) -> Any:
    if given == "estimated":
        return {}
    if given is not None and not isinstance(given, dict):
        raise ValueError("write estimated, or the priors of its amplitude and length")
    return given


def _time_std(text: Any, context: Context) -> float | Column:
    if isinstance(text, Mapping):
        return _error_column(text, context, time_unit(context))
    value = parse_quantity(text, time_unit(context))
    require_sign(value, "not negative", text)
    return value


_QUANTITY_OR_COLUMN = {"anyOf": [TEXT, ErrorColumn.model_json_schema()]}


class Error(Section):
    """Observation errors: a std or a covariance, of the times, correlation, a robust cost, what the model misses."""

    model_config = ConfigDict(populate_by_name=False)
    std: Annotated[Spread | Column | None, Made(_error_std, json=_QUANTITY_OR_COLUMN)] = Field(
        None, alias=f"{PLACEHOLDER}_std"
    )
    """Std of the observation error: a quantity, e.g. '1 % of maximum', or ``{column: NAME}``, one a reading."""
    time_std: Annotated[float | Column, Made(_time_std, json=_QUANTITY_OR_COLUMN)] = 0.0
    """Std of the observation times, a quantity or ``{column: NAME}``: adds (rate × time_std)²."""
    correlation_time: Annotated[float | None, quantity(time_unit, "positive")] = None
    """Errors are correlated as exp(−|Δt|/τ)."""
    covariance: Annotated[Matrix | None, Made(_matrix, CovarianceFile)] = None
    """File of the whole R."""
    robust: Literal["huber"] | None = None
    """Robust cost: readings far off count less."""
    threshold: Annotated[float, quantity(lambda c: "1", "positive")] = HUBER
    """Threshold of the robust cost in std."""
    discrepancy: Annotated[
        DiscrepancySection | None,
        BeforeValidator(_estimated, json_schema_input_type=Literal["estimated"] | DiscrepancySection | None),
    ] = None
    """What the model misses: ``estimated``, or priors. Adds ``discrepancy_amplitude`` and ``discrepancy_length``."""

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        std = f"{PLACEHOLDER}_std"
        for name, other, reason in (
            ("covariance", std, "the file holds the variances"),
            ("covariance", "correlation_time", "the file holds the correlations"),
            ("robust", "correlation_time", "a robust cost needs independent observation errors"),
            ("robust", "covariance", "a robust cost needs independent observation errors"),
        ):
            if name in given and other in given:
                faults.add((name,), f"not together with {other}: {reason}", at_key=True)
        if "threshold" in given and "robust" not in given:
            faults.add(("threshold",), "is that of the robust cost; write robust: huber as well", at_key=True)
        if context.observed and not given.keys() & {std, "covariance"}:
            faults.add((std,), "required: the standard deviation of the observation error")

    def column(self, which: Literal["std", "time_std"], readings: str) -> Column | None:
        """The column of errors, in the unit ``readings`` where it has none of its own; None: no column."""
        chosen = getattr(self, which)
        return replace(chosen, unit=chosen.unit or readings) if isinstance(chosen, Column) else None

    @property
    def huber(self) -> float | None:
        """The threshold of the robust cost, None where the cost is quadratic."""
        return self.threshold if self.robust else None


def _time_zero(text: Any, context: Context) -> Literal["file", "window"] | float:
    if text in ("file", "window"):
        return "file" if text == "file" else "window"
    try:
        return parse_quantity(text, time_unit(context))
    except UnitError as error:
        raise UnitError(f"write file, window or a time: {error}") from None


def _not_empty(path: str | tuple[str, ...]) -> str | tuple[str, ...]:
    if not path or not all(path):
        raise ValueError("no file is named")
    return path


def _files(given: str | tuple[str, ...], context: Context) -> Files:
    return Files(context.base, (given,) if isinstance(given, str) else given)


class Data(Section):
    """Where the observations are, what they mean and how well they are known; in the model's units."""

    path: Annotated[Files, Made(_files, Annotated[str | tuple[str, ...], AfterValidator(_not_empty)])]
    """A data file, a folder, a pattern such as data/*.csv, or a list of them; relative to this file's folder."""
    format: Format | None = None
    """Format of the files; default: by their suffix."""
    decimal: Decimal = "."
    """Decimal sign of the numbers in a CSV file."""
    by: Annotated[str | None, Field(min_length=1)] = None
    """Column of a table that says which data set a row belongs to: each is estimated by itself."""
    sheet: str = ""
    """Sheet of an Excel workbook, a range of it, or both: ``Film 3``, ``A3:D40``, ``Film 3!A3:D40``."""
    unsorted: Disorder = "refuse"
    """Rows whose times do not increase: refuse the file, or sort them."""
    repeated: Repeated = "refuse"
    """Several readings of one time: refuse the file, or average them."""
    columns: Annotated[Columns, OfObservable("column role")]
    """Which columns hold the time and the observable, each with its unit: ``time: {name: t, unit: us}``."""
    window: WindowSection = Field({}, validate_default=True)
    """Which observations are used (the assimilation window); default: all."""
    time_zero: Annotated[Literal["file", "window"] | float, Made(_time_zero)] = Field("file", validate_default=True)
    """Where the model's clock starts: file (the file's own zero), window (the first observation used), or a time."""
    error: Annotated[Error, OfObservable()]
    """Observation errors: ``<observable>_std``, ``time_std``, ``correlation_time``, ``covariance``, ``robust``,
    ``discrepancy``."""

    @property
    def layout(self) -> Layout:
        """How the files are laid out."""
        return Layout(self.format, self.decimal, self.by, self.sheet, self.unsorted, self.repeated)

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        columns = given.get("columns")
        if not isinstance(columns, dict) or context.observed:
            return
        roles = ["time", *(observable.name for observable in context.units.observables)]
        for name in columns:
            if name not in roles:
                faults.add(("columns", name), f"unknown column role {shown(name)}{suggest(name, roles)}", at_key=True)
        if columns.keys() <= set(roles):
            faults.add(("columns",), f"name the column of one observable of: {', '.join(roles[1:])}")

    def as_written(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As given, with absolute paths."""
        written = super().as_written(given)
        paths = [str(self.path.base / text) for text in self.path.texts]
        written["path"] = paths[0] if len(paths) == 1 else paths
        if self.error.covariance is not None:
            written["error"]["covariance"]["path"] = str(self.error.covariance.path)
        return written
