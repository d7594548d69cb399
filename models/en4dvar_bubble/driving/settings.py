"""The ``driving:`` section of a YAML file for the bubble: one model per ``kind``."""

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Union, get_type_hints

from pydantic import ConfigDict, Field, ValidationInfo, create_model, field_validator, model_validator

from en4dvar.inputs.parts import Format
from en4dvar.plumbing.described import Described, text_for
from en4dvar.plumbing.errors import En4dvarError, retold
from en4dvar.plumbing.units import Quantity, convert
from en4dvar_bubble.driving.base import MOST_KNOTS, Driving, with_knots
from en4dvar_bubble.driving.pulses import PULSES, from_file


class Section(Described):
    """A section of a YAML file: unknown keys are errors, the texts under its keys are their descriptions."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Kind(Section):
    model_config = ConfigDict(allow_inf_nan=False)
    pulse: ClassVar[Callable[..., Driving]]
    """The function whose arguments are the keys."""
    knots: Annotated[int, Field(ge=0, le=MOST_KNOTS)] = 0
    """So many numbers pulse_knot_1, … can be parameters: what the pulse has more at equally spaced instants."""

    def build(self) -> Driving:
        """The driving. Raises ValueError or :class:`En4dvarError`."""
        return with_knots(self.known(), self.knots) if self.knots else self.known()

    def known(self) -> Driving:
        """The driving without what the knots may change. Raises as :meth:`build`."""
        return type(self).pulse(**self.model_dump(exclude={"kind", "knots"}))

    @model_validator(mode="after")
    def _can_be_built(self) -> "_Kind":
        with retold(En4dvarError, ValueError):
            driving = self.build()
        if driving.end <= 0:
            raise ValueError(f"the driving has ended by time zero, at {driving.end:g} s")
        return self


def _section(kind: str, function: Callable[..., Driving]) -> type[_Kind]:
    """The section of a pulse; its keys are declared at the arguments of the function."""
    hints, words = get_type_hints(function, include_extras=True), (function.__doc__ or "").splitlines()[0]
    keys: dict[str, Any] = {"kind": (Literal[kind], Field(kind, description=words))}
    for name, argument in signature(function).parameters.items():
        described = " ".join(text for text in hints[name].__metadata__ if isinstance(text, str))
        default = ... if argument.default is argument.empty else argument.default
        keys[name] = (hints[name], Field(default, description=described))
    section = create_model(kind.capitalize(), __base__=_Kind, __doc__=words, **keys)
    section.pulse = staticmethod(function)
    return section


class _Column(Section):
    name: Annotated[str, Field(min_length=1)]
    """Header of the column (CSV) or name of the field (.mat)."""
    unit: str
    """Unit of the numbers in the file; required, never guessed."""


class TimeOfRecord(_Column):
    """Column of times; the unit is required."""

    unit: Annotated[str, text_for(lambda unit: convert(1.0, unit, "s"))]


class PressureOfRecord(_Column):
    """Column of pressures; the unit is required."""

    unit: Annotated[str, text_for(lambda unit: convert(1.0, unit, "Pa"))]


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
    format: Format | None = None
    """Format of the file; default: by its suffix."""
    delay: Annotated[float, Quantity("s")] = 0.0
    """Added to the times of the record."""
    scale: Annotated[float, Field()] = 1.0
    """Factor on the pressures."""

    @field_validator("file")
    @classmethod
    def _absolute(cls, value: str, info: ValidationInfo) -> str:
        base = (info.context or {}).get("base", Path())
        return str((Path(base) / value).resolve())

    def known(self) -> Driving:
        time, pressure = self.columns.time, self.columns.pressure
        return from_file(
            Path(self.file), (time.name, time.unit), (pressure.name, pressure.unit), self.delay, self.scale, self.format
        )


PULSE_SECTIONS = {kind: _section(kind, function) for kind, function in PULSES.items()}


class _AsWritten:
    """The JSON schema of what :func:`with_kind` accepts."""

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        kinds = [
            kind if "Histotripsy" in kind["$ref"] else {"allOf": [kind], "required": ["kind"]}
            for kind in handler(core_schema)["oneOf"]
        ]
        return {"anyOf": [{"const": "none", "description": "No driving."}, *kinds]}


DrivingSettings: Any = Annotated[
    Union[(*PULSE_SECTIONS.values(), Tabulated)], Field(discriminator="kind"), _AsWritten()
]


def with_kind(value: Any) -> Any:
    """``none`` for ``{kind: none}``; a section without ``kind`` is a histotripsy pulse."""
    if isinstance(value, str):
        return {"kind": value}
    if isinstance(value, dict) and "kind" not in value:
        return {"kind": "histotripsy", **value}
    return value
