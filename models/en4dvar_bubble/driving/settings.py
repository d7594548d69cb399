"""The ``driving:`` section of a YAML file for the bubble: one model per ``kind``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from en4dvar.errors import En4dvarError
from en4dvar.units import Quantity, convert
from en4dvar_bubble.driving import pulses
from en4dvar_bubble.driving.base import Driving
from en4dvar_bubble.driving.tabulated import from_file

Pressure = Annotated[float, Quantity("Pa")]
Frequency = Annotated[float, Quantity("Hz"), Field(gt=0)]
Time = Annotated[float, Quantity("s")]
Delay = Annotated[Time, Field(ge=0)]
Width = Annotated[Time, Field(gt=0)]


class _Kind(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def build(self) -> Driving:
        """The driving. Raises ValueError or :class:`En4dvarError`."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _can_be_built(self) -> _Kind:
        try:
            driving = self.build()
        except En4dvarError as error:
            raise ValueError(str(error)) from None
        if driving.end <= 0:
            raise ValueError(f"the driving has ended by time zero, at {driving.end:g} s")
        return self


class NoDriving(_Kind):
    """No driving."""

    kind: Literal["none"] = "none"

    def build(self) -> Driving:
        return pulses.silence()


class Histotripsy(_Kind):
    """The rarefactional half cycle of a histotripsy pulse."""

    kind: Literal["histotripsy"] = "histotripsy"
    amplitude: Pressure = -24e6
    frequency: Frequency = 1e6
    exponent: Annotated[float, Field(ge=1)] = 3.7
    delay: Time = 5e-6

    def build(self) -> Driving:
        return pulses.histotripsy(self.amplitude, self.frequency, self.exponent, self.delay)


class Sine(_Kind):
    """A sine burst, with or without an envelope; ``phase`` in radians."""

    kind: Literal["sine"] = "sine"
    amplitude: Pressure
    frequency: Frequency
    cycles: Annotated[float, Field(gt=0, le=1000)]
    delay: Delay = 0.0
    phase: float = 0.0
    envelope: pulses.Envelope = "none"
    taper: Annotated[float, Field(ge=0.01, le=1)] = 0.5

    def build(self) -> Driving:
        return pulses.sine_burst(
            self.amplitude, self.frequency, self.cycles, self.delay, self.phase, self.envelope, self.taper
        )


class Gaussian(_Kind):
    """A Gaussian pulse centred at ``delay`` with standard deviation ``width``."""

    kind: Literal["gaussian"] = "gaussian"
    amplitude: Pressure
    delay: Delay
    width: Width

    def build(self) -> Driving:
        return pulses.gaussian(self.amplitude, self.delay, self.width)


class Step(_Kind):
    """A step that lasts, or an impulse that ends after ``duration``."""

    kind: Literal["step"] = "step"
    amplitude: Pressure
    duration: Width
    delay: Delay = 0.0
    rise: Width = 20e-9

    def build(self) -> Driving:
        return pulses.step(self.amplitude, self.duration, self.delay, self.rise)


class _Column(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    name: Annotated[str, Field(min_length=1)]
    unit: str


class TimeOfRecord(_Column):
    """Column of times; the unit is required."""

    @field_validator("unit")
    @classmethod
    def _unit(cls, unit: str) -> str:
        convert(1.0, unit, "s")
        return unit


class PressureOfRecord(_Column):
    """Column of pressures; the unit is required."""

    @field_validator("unit")
    @classmethod
    def _unit(cls, unit: str) -> str:
        convert(1.0, unit, "Pa")
        return unit


class Columns(BaseModel):
    """Which columns of the file hold time and pressure, and their units."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    time: TimeOfRecord
    pressure: PressureOfRecord


class Tabulated(_Kind):
    """A measured p(t) from a CSV or ``.mat`` file, shifted by ``delay`` and multiplied by ``scale``."""

    kind: Literal["tabulated"] = "tabulated"
    file: str
    columns: Columns
    format: Literal["csv", "mat"] | None = None
    delay: Time = 0.0
    scale: Annotated[float, Field()] = 1.0

    @field_validator("file")
    @classmethod
    def _absolute(cls, value: str, info: ValidationInfo) -> str:
        base = (info.context or {}).get("base", Path())
        return str((Path(base) / value).resolve())

    def build(self) -> Driving:
        time, pressure = self.columns.time, self.columns.pressure
        return from_file(
            Path(self.file), (time.name, time.unit), (pressure.name, pressure.unit), self.delay, self.scale, self.format
        )


DrivingSettings = Annotated[
    NoDriving | Histotripsy | Sine | Gaussian | Step | Tabulated,
    Field(discriminator="kind"),
]


def with_kind(value: Any) -> Any:
    """``none`` for ``{kind: none}``; a section without ``kind`` is a histotripsy pulse."""
    if isinstance(value, str):
        return {"kind": value}
    if isinstance(value, dict) and "kind" not in value:
        return {"kind": "histotripsy", **value}
    return value
