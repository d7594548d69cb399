"""Constants of the liquid, the gas, the vapour and their interface, each with its source; named sets of them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

_PHYSICS = "water at 25 °C, 1 atm (customary value of the cavitation literature)"
_PROSPERETTI = "Prosperetti, J. Fluid Mech. 222, 587 (1991): linear fit for air"
_TAIT = "Tait equation of water, p + B ∝ ρⁿ (Gilmore 1952; Prosperetti & Lezzi 1986)"
_IMR_V2 = "IMRv2 src/forward_solver/default_case.m, commit 788a54d"
_FIXED = f"{_IMR_V2}: a constant diffusivity"
_VAPOUR = "(vapour: transport)"
_CONDUCTING = "(medium_heat: conducting)"


def _constant(value: float, unit: str, description: str, source: str, **bounds: float) -> Any:
    """A constant of :class:`Medium`; ``bounds`` as pydantic names them."""
    return field(default=value, metadata={"unit": unit, "description": description, "source": source, "bounds": bounds})


@dataclass(frozen=True)
class Medium:
    """SI values; the defaults are water and air at 25 °C (``water-25C``).

    Gas and vapour conduct heat with K(T) = A T + B (Prosperetti 1991), whatever their mixture; vapour diffuses in the
    gas with D_v (p_inf/p)^D_p (T/T_inf)^D_T (0 and 0: the constant of the rheometry codes; 1 and 1.75: Fuller et al.
    1966). The liquid of the enthalpy form and Gilmore's equation is Tait's,
    (p + tait_B)/(p_inf + tait_B) = (ρ/rho)^tait_n. ``p_v`` is a constant vapour pressure in Pa that adds to the gas
    pressure (0: none). ``sources`` says where each constant comes from.
    """

    rho: float = _constant(998.0, "kg/m^3", "Density of the medium.", _PHYSICS, gt=0)
    c: float = _constant(1484.0, "m/s", "Speed of sound in the medium.", _PHYSICS, gt=0)
    p_inf: float = _constant(101325.0, "Pa", "Far-field pressure.", "standard atmosphere", gt=0)
    S: float = _constant(0.072, "N/m", "Surface tension.", _PHYSICS, ge=0)
    T_inf: float = _constant(298.15, "K", "Far-field temperature.", "25 °C", gt=0)
    kappa: float = _constant(1.4, "1", "Ratio of specific heats of the gas.", "diatomic ideal gas", gt=1)
    A: float = _constant(5.28e-5, "W/(m K^2)", "Conductivity of the gas, K(T) = A T + B.", _PROSPERETTI, ge=0)
    B: float = _constant(1.165e-2, "W/(m K)", "Conductivity of the gas, K(T) = A T + B.", _PROSPERETTI, ge=0)
    p_v: float = 0.0
    tait_B: float = _constant(
        304.913e6, "Pa", "Tait equation of the medium: pressure B (enthalpy form and Gilmore).", _TAIT, gt=0
    )
    tait_n: float = _constant(
        7.15, "1", "Tait equation of the medium: exponent n (enthalpy form and Gilmore).", _TAIT, gt=1
    )
    K_m: float = _constant(
        0.55, "W/(m K)", f"Thermal conductivity of the medium {_CONDUCTING}.", f"{_IMR_V2} (Km)", gt=0
    )
    c_m: float = _constant(4181.0, "J/(kg K)", f"Specific heat of the medium {_CONDUCTING}.", f"{_IMR_V2} (Cp)", gt=0)
    D_v: float = _constant(
        24.2e-6, "m^2/s", f"Diffusivity of vapour in the gas at p_inf and T_inf {_VAPOUR}.", f"{_IMR_V2} (D0)", gt=0
    )
    D_p: float = _constant(
        0.0,
        "1",
        f"Diffusivity ∝ (p_inf/p)^D_p: 0 constant, as in the rheometry codes; 1 kinetic theory {_VAPOUR}.",
        _FIXED,
        ge=0,
        le=2,
    )
    D_T: float = _constant(
        0.0,
        "1",
        f"Diffusivity ∝ (T/T_inf)^D_T: 0 constant, as in the rheometry codes; 1.75 kinetic theory {_VAPOUR}.",
        _FIXED,
        ge=0,
        le=3,
    )
    L_v: float = _constant(2264.76e3, "J/kg", f"Latent heat of evaporation {_VAPOUR}.", f"{_IMR_V2} (L_heat)", gt=0)
    M_g: float = _constant(28.966e-3, "kg/mol", f"Molar mass of the gas {_VAPOUR}.", "molar mass of dry air", gt=0)
    M_v: float = _constant(18.01528e-3, "kg/mol", f"Molar mass of the vapour {_VAPOUR}.", "molar mass of water", gt=0)
    sources: Mapping[str, str] = field(default_factory=lambda: dict(_SOURCES), compare=False, repr=False)

    @property
    def K_inf(self) -> float:
        """Conductivity of the gas at T_inf, W/(m K)."""
        return self.A * self.T_inf + self.B

    @property
    def conduction_slope(self) -> float:
        """a in the gas's conductivity over K_inf, a θ + (1−a), θ = T/T_inf."""
        return self.A * self.T_inf / self.K_inf

    @property
    def constants(self) -> dict[str, float]:
        """Name → SI value of every constant that has a source (:data:`UNITS` has the units)."""
        return {name: float(getattr(self, name)) for name in UNITS}

    @cached_property
    def json(self) -> str:
        """The :attr:`constants` with unit and source, as JSON."""
        told = {
            name: {"value": value, "unit": UNITS[name], "source": self.sources.get(name, "")}
            for name, value in self.constants.items()
        }
        return json.dumps(told, ensure_ascii=False)

    def with_constants(self, source: str, **values: float) -> "Medium":
        """The medium with some constants replaced, all from ``source``."""
        changed: dict[str, Any] = dict(values)
        return replace(self, **changed, sources={**self.sources, **dict.fromkeys(values, source)})


CONSTANTS = tuple(f for f in fields(Medium) if f.metadata)
"""The fields of :class:`Medium` that are constants; unit, description, source and bounds are their ``metadata``."""
UNITS: Mapping[str, str] = MappingProxyType({f.name: f.metadata["unit"] for f in CONSTANTS})
_SOURCES: dict[str, str] = {f.name: f.metadata["source"] for f in CONSTANTS}
WATER_25C = Medium()

# The public rheometry codes (GitHub: InertialMicrocavitationRheometry, comp-physics/IMR-archive) disagree.
_IMR_V1 = "IMR_v1 (IMR-vanilla) src/IMRcall_parameters.m, archive commit fb83ef1; IMRv2 src/data_assimilation, 26c6bf3"

_IMR = {
    "p_inf": 101325.0, "T_inf": 298.15, "K_m": 0.55, "D_v": 24.2e-6, "L_v": 2264.76e3, "M_g": 28.966e-3,
    "M_v": 18.01528e-3,
}  # fmt: skip
_IMR_1 = {"rho": 1060.0, "c": 1430.0, "S": 0.056, "A": 5.3e-5, "B": 1.17e-2, "c_m": 8.3144598 / 28.966e-3 * 1.4 / 0.4}
_IMR_2 = {"rho": 1064.0, "c": 1484.0, "S": 0.07, "A": 5.28e-5, "B": 1.165e-2, "c_m": 4181.0}

CONSTANT_SETS: Mapping[str, Medium] = MappingProxyType(
    {
        "water-25C": WATER_25C,
        "imr-v1": WATER_25C.with_constants(_IMR_V1, **_IMR, **_IMR_1, kappa=1.4),
        "imr-v2": WATER_25C.with_constants(_IMR_V2, **_IMR, **_IMR_2, kappa=1.47, tait_B=304.913e6, tait_n=7.15),
    }
)
