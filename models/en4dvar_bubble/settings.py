"""The ``model:`` section of a YAML file for the bubble; of its ``driving:`` one model per ``kind``."""

from collections.abc import Callable
from dataclasses import Field as FieldOfMedium
from dataclasses import fields, replace
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_type_hints

from pydantic import (
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    create_model,
    field_serializer,
    field_validator,
    model_validator,
)

from en4dvar.inputs.formats import Format
from en4dvar.model.state import Parameter
from en4dvar.plumbing.described import Described, text_for
from en4dvar.plumbing.errors import ConfigError, En4dvarError, retold
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.units import Quantity, convert, parse_quantity
from en4dvar_bubble.driving import Reading
from en4dvar_bubble.driving.base import MOST_KNOTS, Driving, with_knots
from en4dvar_bubble.driving.pulses import PULSES, from_file
from en4dvar_bubble.dynamics import R0, R_EQ, R_MAX, Gas, Heat, Start, Vapour
from en4dvar_bubble.laws import REGISTRY
from en4dvar_bubble.laws.loading import qualified
from en4dvar_bubble.medium import (
    CONSTANT_SETS,
    CONSTANTS,
    UNITS,
    WATER_25C,
    KnownMedium,
    Medium,
    known_medium,
)
from en4dvar_bubble.numbers import ALL
from en4dvar_bubble.solver.driver import Accuracy, AccuracyName, Radial, preset


class _Kind(Described):
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
        keys[name] = (hints[name], ... if argument.default is argument.empty else argument.default)
    section = create_model(kind.capitalize(), __base__=_Kind, __doc__=words, **keys)
    section.pulse = staticmethod(function)
    return section


class _Column(Described):
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


class Columns(Described):
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


SetName = Literal["water-25C", "imr-v1", "imr-v2"]
MediumName = Literal["water", "polyacrylamide", "polyacrylamide-alginate", "agarose", "gelatin", "peg"]

UNUSED = {"A_v", "B_v"}  # recorded by earlier versions, in no equation
_GIVEN = "given in the configuration"
_VAPOUR_PRESSURE = {"anyOf": [{"const": "saturated"}, {"const": 0}, {"type": "string", "pattern": r"^\s*[\d.]"}]}


class _NamedSet(Described):
    """A named set of constants, any of them replaced."""

    set: SetName = "water-25C"
    """The set that fills what is not given."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        names = {"enum": list(get_args(SetName)), "description": "Name of a set of constants."}
        return {"anyOf": [names, super().__get_pydantic_json_schema__(core_schema, handler)]}

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, value: Any) -> Any:
        """A name stands for its set; what a set leaves open comes from it, with its source."""
        section = {"set": value} if isinstance(value, str) else value
        if not isinstance(section, dict):
            return section
        section = {name: value for name, value in section.items() if name not in UNUSED}
        chosen = CONSTANT_SETS.get(str(section.get("set", "water-25C")))
        if chosen is None:
            return {"set": section["set"]}  # the only fault worth telling
        sources = section.get("sources", {})
        if not isinstance(sources, dict):
            return section
        sources = {name: words for name, words in sources.items() if name not in UNUSED}
        inherited = {
            name: f"{number!r} {UNITS[name]}" if UNITS[name] != "1" else number
            for name, number in chosen.constants.items()
        }
        told = {**chosen.sources, **{name: _GIVEN for name in section if name in UNITS}, **sources}
        return {**inherited, **section, "sources": told}

    @field_validator("sources", check_fields=False)
    @classmethod
    def _known(cls, value: dict[str, str]) -> dict[str, str]:
        for name in value:
            if name not in UNITS:
                raise ValueError(f"source of an unknown constant {name!r}{suggest(name, UNITS)}")
        return value

    @property
    def medium(self) -> Medium:
        return Medium(**self.model_dump(exclude={"set"}))


def _key(constant: FieldOfMedium[Any]) -> tuple[Any, Any]:
    """Type and default of a constant as a key of the section."""
    about = constant.metadata
    quantity = (Quantity(about["unit"]),) if about["unit"] != "1" else ()
    return Annotated[(float, *quantity, Field(**about["bounds"]), about["description"])], constant.default


_SOURCES = Field(
    default_factory=lambda: dict(WATER_25C.sources),
    description="Where replaced values come from, by constant; recorded with the result.",
)
_CONSTANTS: dict[str, Any] = {**{f.name: _key(f) for f in CONSTANTS}, "sources": (dict[str, str], _SOURCES)}
ConstantsSettings = create_model("ConstantsSettings", __base__=_NamedSet, __doc__=_NamedSet.__doc__, **_CONSTANTS)


class MediumSettings(Described):
    """A medium by name."""

    name: MediumName
    """Gels by their polymer; peg is poly(ethylene glycol) in water."""
    concentration: Annotated[float, Quantity("1"), Field(ge=0, le=0.5)] | None = None
    """Mass of polymer over that of the whole; default: the usual one."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        names = {"enum": list(get_args(MediumName)), "description": "Name of a medium at its usual concentration."}
        return {"anyOf": [names, super().__get_pydantic_json_schema__(core_schema, handler)]}

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @property
    def known(self) -> KnownMedium:
        return known_medium(self.name, self.concentration)


class WallSettings(Described):
    """A plane near the bubble."""

    distance: Annotated[float, Quantity("m"), Field(gt=0)]
    """From the centre of the bubble."""
    kind: Literal["rigid", "free", "slit"] = "rigid"
    """A rigid wall, the free surface of the medium, or a rigid wall on either side."""


class BubbleSettings(Described):
    """What the forward model is; every default is recorded in the resolved configuration."""

    law: str = "quadratic-kelvin-voigt"
    """Constitutive law: a name of ``en4dvar laws``, or a class in a file: ./my_law.py:MyLaw."""
    radial: Radial = "keller-miksis"
    """Radial dynamics: how the compressibility of the medium enters."""
    gas: Gas = "heat"
    """Gas in the bubble: energy equation (heat), or a polytropic law."""
    vapour: Vapour = "none"
    """Vapour: none, that of time zero as if it were gas, or diffusion with evaporation at the wall."""
    medium_heat: Heat = "cold"
    """Wall at the far-field temperature, or heat conduction in the medium."""
    start: Start = "acoustic"
    """acoustic: at rest at R0, then driven; laser: released from R_max with the gas of R_eq."""
    driving: DrivingSettings = PULSE_SECTIONS["histotripsy"]()
    """Pressure far away; default: the histotripsy pulse (acoustic start) or none (laser start)."""
    driving_read: Reading = "instantaneous"
    """When p_f is evaluated: at t, at t + R/c without its derivative (retarded), or both (as-printed)."""
    vapour_pressure: Annotated[float | Literal["saturated"], WithJsonSchema(_VAPOUR_PRESSURE)] = 0.0
    """Constant vapour pressure in the bubble: a pressure, or saturated at the far-field temperature."""
    medium: MediumSettings | None = None
    """Density and speed of sound by the name of the medium, where ``constants`` does not give them."""
    constants: ConstantsSettings = ConstantsSettings()
    """Constants of medium and gas: the name of a set, or a section that replaces some of them."""
    wall: WallSettings | None = None
    """A plane near the bubble; with ``wall_distance`` under ``parameters`` its distance is estimated."""
    gas_change: Annotated[float, Field(ge=0, le=3)] = 0.0
    """How far the amount of gas may change unforeseen, std of its ln: for what is expected after the window."""
    viscosity_change: Annotated[float, Field(ge=0, le=3)] = 0.0
    """How far the viscosity may change unforeseen, std of its ln: it is not all that damps the first collapses."""
    hydrophone: Annotated[float, Quantity("m"), Field(gt=0)] = 1.0
    """How far from the bubble acoustic_pressure is read."""
    accuracy: AccuracyName = "standard"
    """Nodes and tolerance together; errors of each in docs/solver.md."""
    nodes: Annotated[int, Field(ge=1, le=128)] | None = None
    """Collocation nodes in the gas; default: those of ``accuracy``."""
    medium_nodes: Annotated[int, Field(ge=4, le=128)] | None = None
    """Nodes in the conducting medium; default: those of ``accuracy``."""
    rtol: Annotated[float, Field(ge=1e-11, le=1e-2)] | None = None
    """Relative tolerance of a time step; default: that of ``accuracy``."""
    step_limit: Annotated[int, Field(ge=100)] | None = None
    """A member that needs more time steps, or three tenths of them for a hundredth of the span, has failed."""
    time_limit: Annotated[float, Quantity("s"), Field(gt=0)] = Accuracy.time_limit
    """A member that computes for longer has failed."""
    mach_limit: Annotated[float, Field(gt=0)] = Accuracy.mach_limit
    """A member whose wall is faster, relative to the speed of sound, has failed."""

    @model_validator(mode="before")
    @classmethod
    def _driving_of_the_start(cls, value: Any) -> Any:
        """By default the acoustic start is driven by the histotripsy pulse, the laser start by nothing."""
        if isinstance(value, dict):
            default = {"kind": "none" if value.get("start") == "laser" else "histotripsy"}
            return {**value, "driving": with_kind(value.get("driving", default))}
        return value

    @model_validator(mode="before")
    @classmethod
    def _constants_of_the_medium(cls, value: Any) -> Any:
        """What a named medium is known by becomes constants, with their source, where the section gives none."""
        constants = value.get("constants", {}) if isinstance(value, dict) and value.get("medium") is not None else None
        constants = {"set": constants} if isinstance(constants, str) else constants
        if not isinstance(constants, dict) or not isinstance(constants.get("sources", {}), dict):
            return value
        try:
            known = MediumSettings.model_validate(value["medium"]).known
        except ValidationError:
            return value  # told by the key itself
        own = {"rho": f"{known.rho!r} kg/m^3", "c": f"{known.c!r} m/s"}
        own = {name: words for name, words in own.items() if name not in constants}
        sources = {**dict.fromkeys(own, known.source), **constants.get("sources", {})}
        return {**value, "constants": {**own, **constants, "sources": sources}}

    @field_validator("law")
    @classmethod
    def _known_law(cls, value: str, info: ValidationInfo) -> str:
        """A law from a file: its path is relative to the configuration's folder, and absolute from here on."""
        with retold(ConfigError, ValueError):
            return qualified(value, (info.context or {}).get("base"))

    @field_validator("vapour_pressure", mode="before")
    @classmethod
    def _read_vapour(cls, value: Any) -> Any:
        return value if value == "saturated" else 0.0 if value in (0, 0.0) else parse_quantity(value, "Pa")

    @field_serializer("vapour_pressure", when_used="json")
    def _write_vapour(self, value: float | str) -> str:
        return value if isinstance(value, str) else f"{value!r} Pa"

    @classmethod
    def possible_parameters(cls) -> tuple[Parameter, ...]:
        """The parameters of every built-in law and start, for editors; a configuration has those of its own."""
        of_laws = [p for law in REGISTRY.values() for p in law.parameters]
        return tuple({p.name: p for p in (*of_laws, R0, R_EQ, R_MAX, *ALL)}.values())

    @property
    def liquid(self) -> Medium:
        """All constants, with the vapour pressure."""
        medium = self.constants.medium
        saturated = self.vapour_pressure == "saturated"
        return medium.saturated if saturated else replace(medium, p_v=float(self.vapour_pressure))

    @property
    def solver_accuracy(self) -> Accuracy:
        said = {f.name: getattr(self, f.name) for f in fields(Accuracy)}
        own = {name: value for name, value in said.items() if value is not None}
        return replace(preset(self.accuracy, self.start), **own)
