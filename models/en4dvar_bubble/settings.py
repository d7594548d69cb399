"""The ``model:`` section of a YAML file for the bubble."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from en4dvar.units import Quantity
from en4dvar_bubble.driving import Driving, Reading, histotripsy
from en4dvar_bubble.laws import get_law
from en4dvar_bubble.medium import WATER_25C, Medium, saturated_vapour_pressure
from en4dvar_bubble.solver.driver import ACCURACIES, Accuracy

Density = Annotated[float, Quantity("kg/m^3"), Field(gt=0)]
Speed = Annotated[float, Quantity("m/s"), Field(gt=0)]
Pressure = Annotated[float, Quantity("Pa")]
Tension = Annotated[float, Quantity("N/m"), Field(ge=0)]
Temperature = Annotated[float, Quantity("K"), Field(gt=0)]
Frequency = Annotated[float, Quantity("Hz"), Field(gt=0)]
Time = Annotated[float, Quantity("s")]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ConstantsSettings(_Section):
    """Constants of water and air at 25 °C unless given."""

    rho: Density = WATER_25C.rho
    c: Speed = WATER_25C.c
    p_inf: Annotated[Pressure, Field(gt=0)] = WATER_25C.p_inf
    S: Tension = WATER_25C.S
    T_inf: Temperature = WATER_25C.T_inf
    kappa: Annotated[float, Field(gt=1)] = WATER_25C.kappa
    A: Annotated[float, Quantity("W/(m K^2)"), Field(ge=0)] = WATER_25C.A
    B: Annotated[float, Quantity("W/(m K)"), Field(ge=0)] = WATER_25C.B


class HistotripsySettings(_Section):
    """The rarefactional half cycle of a histotripsy pulse."""

    kind: Literal["histotripsy"] = "histotripsy"
    amplitude: Pressure = -24e6
    frequency: Frequency = 1e6
    exponent: Annotated[float, Field(ge=1)] = 3.7
    delay: Time = 5e-6

    def build(self) -> Driving:
        return histotripsy(self.amplitude, self.frequency, self.exponent, self.delay)


class BubbleSettings(_Section):
    """What the forward model is; every default is recorded in the resolved configuration."""

    law: str = "quadratic-kelvin-voigt"
    radial: Literal["keller-miksis"] = "keller-miksis"
    gas: Literal["heat", "polytropic"] = "heat"
    start: Literal["acoustic", "laser"] = "acoustic"
    driving: HistotripsySettings = HistotripsySettings()
    driving_read: Reading = "instantaneous"
    vapour_pressure: float | Literal["saturated"] = 0.0
    constants: ConstantsSettings = ConstantsSettings()
    accuracy: Literal["fast", "standard", "reference"] = "standard"
    nodes: Annotated[int, Field(ge=1, le=128)] | None = None
    rtol: Annotated[float, Field(ge=1e-11, le=1e-2)] | None = None
    step_limit: Annotated[int, Field(ge=100)] = Accuracy.step_limit
    mach_limit: Annotated[float, Field(gt=0)] = Accuracy.mach_limit

    @field_validator("law")
    @classmethod
    def _known_law(cls, value: str) -> str:
        try:
            get_law(value)
        except Exception as error:
            raise ValueError(str(error)) from error
        return value

    @field_validator("vapour_pressure", mode="before")
    @classmethod
    def _vapour(cls, value: Any) -> Any:
        return value if value in ("saturated", 0, 0.0) else Quantity("Pa")._read(value)

    @property
    def medium(self) -> Medium:
        constants = self.constants.model_dump()
        if self.vapour_pressure == "saturated":
            return Medium(**constants, p_v=saturated_vapour_pressure(self.constants.T_inf))
        return Medium(**constants, p_v=float(self.vapour_pressure))

    @property
    def solver_accuracy(self) -> Accuracy:
        preset = ACCURACIES[self.accuracy]
        return Accuracy(
            nodes=preset.nodes if self.nodes is None else self.nodes,
            rtol=preset.rtol if self.rtol is None else self.rtol,
            step_limit=self.step_limit,
            mach_limit=self.mach_limit,
        )
