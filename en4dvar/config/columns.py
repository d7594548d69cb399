"""``data.columns``: which columns of a file hold the times and the observable, each with its unit."""

from collections.abc import Mapping
from typing import Annotated, Any, Self, cast

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from en4dvar.config.context import PLACEHOLDER, Context, Made, observable_unit, quantity, time_unit, unit_of
from en4dvar.config.schema import QuantityText, Section
from en4dvar.config.validate import Faults
from en4dvar.inputs.asked import Column, TimeStep
from en4dvar.plumbing.errors import ConfigError, retold
from en4dvar.plumbing.units import UnitError, as_unit, parse_quantity


class OfReadings(Section):
    """A column with a number for each reading."""

    column: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""


class Pixel(Section):
    """Lengths that were measured in pixels."""

    pixel: QuantityText
    """What one is long, e.g. 2.76 um."""


def _unit_text(written: Any) -> Any:
    if not isinstance(written, Mapping):
        return written
    if written.keys() != {"pixel"}:
        raise ValueError("write a unit such as um, or {pixel: 2.76 um}")
    return as_unit(str(written["pixel"]), "m")


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

    @model_validator(mode="after")
    def _one_of(self) -> Self:
        if (self.name is None) == (self.step is None):
            raise ValueError("give either 'name' (a column of times) or 'step' (a constant time step)")
        if self.name is not None and "unit" not in self.model_fields_set:
            raise ValueError(f"the unit of column {self.name!r} is missing; write unit: us")
        if self.rate is not None and self.name is None:
            raise ValueError("'rate' is compared with a column of times; a step needs none")
        return self


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


_VALUES = Made(_values, ValueColumn)


class Columns(Section):
    """Which columns hold the time and the observable, each with its unit."""

    model_config = ConfigDict(json_schema_extra={"required": ["time"]}, populate_by_name=False)
    time: Annotated[Column | TimeStep, Made(_times, TimeColumn)] = cast(Any, None)  # a rule says what is missing
    """Observation times."""
    observable: Annotated[Column, _VALUES, Field(alias=PLACEHOLDER)] = cast(Any, None)
    """The observable."""

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        if keys.get("time") is None:
            unit = time_unit(context)
            faults.add(("time",), f"required: {{name: <column>, unit: {unit}}}, or {{step: <quantity>}}")
