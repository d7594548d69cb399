"""The sections of a configuration file, as frozen pydantic models. What needs the model's units is text here."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model, field_validator, model_validator

from en4dvar.problem import AssimilationSettings
from en4dvar.units import parse_unit

QuantityText = str | int | float
Name = Annotated[str, Field(pattern=r"^[\w.][\w.+ -]*$", max_length=100)]


class Section(BaseModel):
    """Base of every section: unknown keys are errors, values cannot change, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


def _known_unit(unit: str) -> str:
    parse_unit(unit)
    return unit


class Column(Section):
    """A column of a CSV file or a field of a ``.mat`` file; the unit is required, never guessed."""

    name: Annotated[str, Field(min_length=1)]
    unit: str

    _unit = field_validator("unit")(_known_unit)


class TimeColumn(Section):
    """Observation times: a column, or a constant step (a scalar of the file, or a quantity such as ``0.63 us``)."""

    name: str | None = None
    step: QuantityText | None = None
    unit: str | None = None

    @field_validator("unit")
    @classmethod
    def _unit(cls, unit: str | None) -> str | None:
        return unit if unit is None else _known_unit(unit)

    @model_validator(mode="after")
    def _one_of(self) -> TimeColumn:
        if (self.name is None) == (self.step is None):
            raise ValueError("give either 'name' (a column of times) or 'step' (a constant time step)")
        if self.name is not None and self.unit is None:
            raise ValueError(f"the unit of column {self.name!r} is missing; write unit: us")
        return self


class Window(Section):
    """First and last observation used: ``maximum``, ``minimum 2``, a time, or ``start``/``end`` of the file."""

    start: Annotated[QuantityText, Field(alias="from")] = "start"
    end: Annotated[QuantityText, Field(alias="to")] = "end"
    prominence: QuantityText = "10 %"


class CovarianceFile(Section):
    """A CSV file of the full matrix R, without header; its unit (e.g. ``um^2``) is required, never guessed."""

    path: Annotated[str, Field(min_length=1)]
    unit: str

    _unit = field_validator("unit")(_known_unit)


class Data(Section):
    """Where the observations are, what they mean and how well they are known."""

    path: str | tuple[str, ...]
    format: Literal["csv", "mat"] | None = None
    columns: dict[str, Any]
    window: Window = Window()
    time_zero: QuantityText = "file"
    error: dict[str, QuantityText | dict[str, QuantityText]]

    @field_validator("path")
    @classmethod
    def _not_empty(cls, path: str | tuple[str, ...]) -> str | tuple[str, ...]:
        if not path or not all(path):
            raise ValueError("no file is named")
        return path


class Prior(Section):
    """A prior by name; locations and spreads carry the parameter's unit, a ``%`` spread is relative to the location."""

    prior: Literal["normal", "lognormal", "logit"]
    mean: QuantityText | None = None
    median: QuantityText | None = None
    std: QuantityText | None = None
    log_std: Annotated[float, Field(gt=0)] | None = None
    logit_std: Annotated[float, Field(gt=0)] | None = None
    lower: QuantityText | None = None
    upper: QuantityText | None = None


class InitialSpread(Section):
    """Spread of the initial value of a state field: in its unit (added), or in ``%`` (a factor)."""

    std: QuantityText


class FromFile(Section):
    """A value fixed at a scalar that the data file holds."""

    from_file: Annotated[str, Field(min_length=1)]
    unit: str

    _unit = field_validator("unit")(_known_unit)


class Execution(Section):
    """Where the work is done; never changes the numbers.

    ``address`` is that of a running dask scheduler. ``checkpoint_every``: seconds between two checkpoints of a data
    set; an iteration that follows sooner is not written, 0 writes every one.
    """

    executor: Literal["serial", "threads", "processes", "dask"] | None = None
    workers: Annotated[int, Field(ge=1)] | None = None
    address: Annotated[str, Field(pattern=r"^\w+://\S+$")] | None = None
    checkpoint_every: Annotated[float, Field(ge=0)] = 0.2

    @model_validator(mode="after")
    def _address_is_of_dask(self) -> Execution:
        if self.address is not None and self.executor not in (None, "dask"):
            raise ValueError(f"address is that of a dask scheduler; write executor: dask, not {self.executor}")
        return self


class Output(Section):
    """Run directory; default ``runs/<name>``, relative to the current directory. ``report``: write figures and page."""

    directory: Path | None = None
    report: bool = True


class Times(Section):
    """A uniform grid of instants, both ends included."""

    start: Annotated[QuantityText, Field(alias="from")] = "start"
    end: Annotated[QuantityText, Field(alias="to")]
    step: QuantityText


class Simulate(Section):
    """Settings of ``en4dvar simulate``: when the synthetic observations are taken."""

    times: Times


def _positive(values: tuple[float, ...]) -> tuple[float, ...]:
    if not values or not all(value > 0 for value in values):
        raise ValueError(f"give one or more positive numbers, not {list(values)}")
    return values


_LIMITS: dict[str, Any] = {
    "members": Field(ge=3),
    "epsilon": Field(gt=0, le=1),
    "max_iterations": Field(ge=1),
    "starts": Field(ge=1),
    "step_tolerance": Field(gt=0),
    "cost_tolerance": Field(gt=0),
    "min_active_fraction": Field(gt=0, le=1),
    "mda_coefficients": AfterValidator(_positive),
}


def _assimilation_section() -> type[Section]:
    """Fields, types and defaults come from :class:`AssimilationSettings`, the single declaration."""
    hints = get_type_hints(AssimilationSettings)
    fields: dict[str, Any] = {
        f.name: (Annotated[hints[f.name], _LIMITS[f.name]] if f.name in _LIMITS else hints[f.name], f.default)
        for f in dataclasses.fields(AssimilationSettings)
    }
    fields["weights"] = (Literal["sum", "mean"], "sum")
    return create_model("Assimilation", __base__=Section, **fields)


Assimilation = _assimilation_section()


class Schema(Section):
    """The whole file. ``data``, ``model``, ``parameters`` and ``assimilation`` are validated by themselves."""

    name: Name
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    data: dict[str, Any] | None = None
    model: dict[str, Any]
    parameters: dict[str, Any]
    initial_state: dict[str, Any] | None = None
    assimilation: dict[str, Any] = {}
    execution: Execution = Execution()
    output: Output = Output()
    simulate: Simulate | None = None
