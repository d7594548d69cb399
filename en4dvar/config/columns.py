"""``data.columns``: which columns of a file hold the times and the observable, each with its unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from en4dvar.config.context import PLACEHOLDER, Context, Made, observable_unit, require_sign, time_unit, unit_of
from en4dvar.config.schema import QuantityText, Section
from en4dvar.config.validate import Faults
from en4dvar.errors import ConfigError, Fault
from en4dvar.inputs.asked import Column, TimeStep
from en4dvar.units import UnitError, parse_quantity


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
    """Header of the column (CSV) or name of the field (.mat); ``R_*`` makes each column a data set."""
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
