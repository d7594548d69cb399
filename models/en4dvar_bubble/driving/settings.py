"""The ``driving:`` section of a YAML file for the bubble: one model per ``kind``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

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


class Section(BaseModel):
    """A section of a YAML file: unknown keys are errors, the texts under its keys are their descriptions."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class _Kind(Section):
    model_config = ConfigDict(allow_inf_nan=False)
    pulse: ClassVar[Callable[..., Driving]]
    """The function whose arguments are the keys."""

    def build(self) -> Driving:
        """The driving. Raises ValueError or :class:`En4dvarError`."""
        return type(self).pulse(**self.model_dump(exclude={"kind"}))

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

    pulse = staticmethod(pulses.silence)
    kind: Literal["none"] = "none"
    """No driving."""


class Histotripsy(_Kind):
    """The rarefactional half cycle of a histotripsy pulse."""

    pulse = staticmethod(pulses.histotripsy)
    kind: Literal["histotripsy"] = "histotripsy"
    """p_A [(1 + cos ω(t−δ))/2]^n for |t−δ| ≤ π/ω."""
    amplitude: Pressure = -24e6
    """p_A; negative for rarefaction."""
    frequency: Frequency = 1e6
    """ω/2π."""
    exponent: Annotated[float, Field(ge=1)] = 3.7
    """n."""
    delay: Time = 5e-6
    """δ: the instant of the peak."""


class Sine(_Kind):
    """A sine burst, with or without an envelope."""

    pulse = staticmethod(pulses.sine_burst)
    kind: Literal["sine"] = "sine"
    """A sine burst."""
    amplitude: Pressure
    """Pressure amplitude."""
    frequency: Frequency
    """Frequency."""
    cycles: Annotated[float, Field(gt=0, le=1000)]
    """Length of the burst in periods."""
    delay: Delay = 0.0
    """When the burst begins."""
    phase: float = 0.0
    """Phase at its beginning, in radians."""
    envelope: pulses.Envelope = "none"
    """Window that the burst is multiplied by; without one the burst must begin and end at zero."""
    taper: Annotated[float, Field(ge=0.01, le=1)] = 0.5
    """Share of the burst that the two tapers of the Tukey window take."""


class Gaussian(_Kind):
    """A Gaussian pulse centred at ``delay`` with standard deviation ``width``."""

    pulse = staticmethod(pulses.gaussian)
    kind: Literal["gaussian"] = "gaussian"
    """A Gaussian pulse."""
    amplitude: Pressure
    """Peak pressure."""
    delay: Delay
    """The instant of the peak."""
    width: Width
    """Standard deviation of the pulse in time."""


class Step(_Kind):
    """A step that lasts, or an impulse that ends after ``duration``."""

    pulse = staticmethod(pulses.step)
    kind: Literal["step"] = "step"
    """A step or an impulse."""
    amplitude: Pressure
    """Pressure after the step."""
    duration: Width
    """How long the pressure lasts."""
    delay: Delay = 0.0
    """When it begins."""
    rise: Width = 20e-9
    """Rise time."""


class _Column(Section):
    dimension: ClassVar[str]
    name: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""
    unit: str
    """Unit of the numbers in the file; required, never guessed."""

    @field_validator("unit")
    @classmethod
    def _unit(cls, unit: str) -> str:
        convert(1.0, unit, cls.dimension)
        return unit


class TimeOfRecord(_Column):
    """Column of times; the unit is required."""

    dimension = "s"


class PressureOfRecord(_Column):
    """Column of pressures; the unit is required."""

    dimension = "Pa"


class Columns(Section):
    """Which columns of the file hold time and pressure, and their units."""

    time: TimeOfRecord
    """Column of times."""
    pressure: PressureOfRecord
    """Column of pressures."""


class Tabulated(_Kind):
    """A measured p(t) from a CSV or ``.mat`` file."""

    kind: Literal["tabulated"] = "tabulated"
    """A measured p(t)."""
    file: str
    """CSV or .mat file, relative to the configuration's folder."""
    columns: Columns
    """Which columns hold time and pressure, and their units."""
    format: Literal["csv", "mat"] | None = None
    """Format of the file; default: by its suffix."""
    delay: Time = 0.0
    """Added to the times of the record."""
    scale: Annotated[float, Field()] = 1.0
    """Factor on the pressures."""

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


class _AsWritten:
    """The JSON schema of what :func:`with_kind` accepts."""

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        kinds = [
            kind if Histotripsy.__name__ in kind["$ref"] else {"allOf": [kind], "required": ["kind"]}
            for kind in handler(core_schema)["oneOf"]
        ]
        return {"anyOf": [{"const": "none", "description": "No driving."}, *kinds]}


DrivingSettings = Annotated[
    NoDriving | Histotripsy | Sine | Gaussian | Step | Tabulated,
    Field(discriminator="kind"),
    _AsWritten(),
]


def with_kind(value: Any) -> Any:
    """``none`` for ``{kind: none}``; a section without ``kind`` is a histotripsy pulse."""
    if isinstance(value, str):
        return {"kind": value}
    if isinstance(value, dict) and "kind" not in value:
        return {"kind": "histotripsy", **value}
    return value
