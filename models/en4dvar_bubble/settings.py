"""The ``model:`` section of a YAML file for the bubble."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_serializer, field_validator, model_validator

from en4dvar.errors import ConfigError
from en4dvar.hints import suggest
from en4dvar.units import Quantity, parse_quantity
from en4dvar_bubble.driving import Reading
from en4dvar_bubble.driving.settings import DrivingSettings, Histotripsy, with_kind
from en4dvar_bubble.laws import ConstitutiveLaw, get_law
from en4dvar_bubble.laws.loading import qualified
from en4dvar_bubble.medium import CONSTANT_SETS, UNITS, WATER_25C, Medium, saturated_vapour_pressure
from en4dvar_bubble.solver.driver import Accuracy, Radial, preset

SetName = Literal["water-25C", "imr-v1", "imr-v2"]
Positive = Field(gt=0)
NonNegative = Field(ge=0)

_GIVEN = "given in the configuration"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ConstantsSettings(_Section):
    """A named set of constants, any of them replaced; ``sources`` says where replaced values come from."""

    set: SetName = "water-25C"
    rho: Annotated[float, Quantity(UNITS["rho"]), Positive] = WATER_25C.rho
    c: Annotated[float, Quantity(UNITS["c"]), Positive] = WATER_25C.c
    p_inf: Annotated[float, Quantity(UNITS["p_inf"]), Positive] = WATER_25C.p_inf
    S: Annotated[float, Quantity(UNITS["S"]), NonNegative] = WATER_25C.S
    T_inf: Annotated[float, Quantity(UNITS["T_inf"]), Positive] = WATER_25C.T_inf
    kappa: Annotated[float, Field(gt=1)] = WATER_25C.kappa
    A: Annotated[float, Quantity(UNITS["A"]), NonNegative] = WATER_25C.A
    B: Annotated[float, Quantity(UNITS["B"]), NonNegative] = WATER_25C.B
    tait_B: Annotated[float, Quantity(UNITS["tait_B"]), Positive] = WATER_25C.tait_B
    tait_n: Annotated[float, Field(gt=1)] = WATER_25C.tait_n
    K_m: Annotated[float, Quantity(UNITS["K_m"]), Positive] = WATER_25C.K_m
    c_m: Annotated[float, Quantity(UNITS["c_m"]), Positive] = WATER_25C.c_m
    A_v: Annotated[float, Quantity(UNITS["A_v"]), NonNegative] = WATER_25C.A_v
    B_v: Annotated[float, Quantity(UNITS["B_v"]), NonNegative] = WATER_25C.B_v
    D_v: Annotated[float, Quantity(UNITS["D_v"]), Positive] = WATER_25C.D_v
    L_v: Annotated[float, Quantity(UNITS["L_v"]), Positive] = WATER_25C.L_v
    M_g: Annotated[float, Quantity(UNITS["M_g"]), Positive] = WATER_25C.M_g
    M_v: Annotated[float, Quantity(UNITS["M_v"]), Positive] = WATER_25C.M_v
    sources: dict[str, str] = Field(default_factory=lambda: dict(WATER_25C.sources))

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, value: Any) -> Any:
        """A name stands for its set; what a set leaves open comes from it, with its source."""
        given = {"set": value} if isinstance(value, str) else value
        if not isinstance(given, dict):
            return given
        chosen = CONSTANT_SETS.get(str(given.get("set", "water-25C")))
        if chosen is None:
            return {"set": given["set"]}  # the only fault worth telling
        sources = given.get("sources", {})
        if not isinstance(sources, dict):
            return given
        inherited = {
            name: f"{number!r} {UNITS[name]}" if UNITS[name] != "1" else number
            for name, number in chosen.constants.items()
        }
        told = {**chosen.sources, **{name: _GIVEN for name in given if name in UNITS}, **sources}
        return {**inherited, **given, "sources": told}

    @field_validator("sources")
    @classmethod
    def _known(cls, value: dict[str, str]) -> dict[str, str]:
        for name in value:
            if name not in UNITS:
                raise ValueError(f"source of an unknown constant {name!r}{suggest(name, UNITS)}")
        return value

    @property
    def medium(self) -> Medium:
        values = self.model_dump(exclude={"set", "sources"})
        return Medium(**values, sources=dict(self.sources))


class BubbleSettings(_Section):
    """What the forward model is; every default is recorded in the resolved configuration."""

    law: str = "quadratic-kelvin-voigt"
    radial: Radial = "keller-miksis"
    gas: Literal["heat", "polytropic", "isothermal", "adiabatic"] = "heat"
    vapour: Literal["none", "frozen", "transport"] = "none"
    medium_heat: Literal["cold", "conducting"] = "cold"
    start: Literal["acoustic", "laser"] = "acoustic"
    driving: DrivingSettings = Histotripsy()
    driving_read: Reading = "instantaneous"
    vapour_pressure: float | Literal["saturated"] = 0.0
    constants: ConstantsSettings = ConstantsSettings()
    accuracy: Literal["fast", "standard", "reference"] = "standard"
    nodes: Annotated[int, Field(ge=1, le=128)] | None = None
    medium_nodes: Annotated[int, Field(ge=4, le=128)] | None = None
    rtol: Annotated[float, Field(ge=1e-11, le=1e-2)] | None = None
    step_limit: Annotated[int, Field(ge=100)] = Accuracy.step_limit
    time_limit: Annotated[float, Quantity("s"), Field(gt=0)] = Accuracy.time_limit
    mach_limit: Annotated[float, Field(gt=0)] = Accuracy.mach_limit

    @model_validator(mode="before")
    @classmethod
    def _driving_of_the_start(cls, value: Any) -> Any:
        """The acoustic start is driven by the histotripsy pulse unless told otherwise, the laser start by nothing."""
        if isinstance(value, dict):
            default = {"kind": "none" if value.get("start") == "laser" else "histotripsy"}
            return {**value, "driving": with_kind(value.get("driving", default))}
        return value

    @field_validator("law")
    @classmethod
    def _known_law(cls, value: str, info: ValidationInfo) -> str:
        """A law from a file: its path is relative to the configuration's folder, and absolute from here on."""
        try:
            return qualified(value, (info.context or {}).get("base"))
        except ConfigError as error:
            raise ValueError(str(error)) from error

    @field_validator("vapour_pressure", mode="before")
    @classmethod
    def _read_vapour(cls, value: Any) -> Any:
        return value if value == "saturated" else 0.0 if value in (0, 0.0) else parse_quantity(value, "Pa")

    @field_serializer("vapour_pressure", when_used="json")
    def _write_vapour(self, value: float | str) -> str:
        return value if isinstance(value, str) else f"{value!r} Pa"

    @property
    def constitutive_law(self) -> ConstitutiveLaw:
        return get_law(self.law)

    @property
    def medium(self) -> Medium:
        medium = self.constants.medium
        if self.vapour_pressure == "saturated":
            return replace(medium, p_v=saturated_vapour_pressure(medium.T_inf))
        return replace(medium, p_v=float(self.vapour_pressure))

    @property
    def solver_accuracy(self) -> Accuracy:
        base = preset(self.accuracy, self.start)
        return Accuracy(
            nodes=base.nodes if self.nodes is None else self.nodes,
            rtol=base.rtol if self.rtol is None else self.rtol,
            medium_nodes=base.medium_nodes if self.medium_nodes is None else self.medium_nodes,
            step_limit=self.step_limit,
            time_limit=self.time_limit,
            mach_limit=self.mach_limit,
        )
