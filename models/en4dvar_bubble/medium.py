"""Constants of the liquid, the gas, the vapour and their interface, each with its source; named sets of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

UNITS: Mapping[str, str] = MappingProxyType(
    {
        "rho": "kg/m^3",
        "c": "m/s",
        "p_inf": "Pa",
        "S": "N/m",
        "T_inf": "K",
        "kappa": "1",
        "A": "W/(m K^2)",
        "B": "W/(m K)",
        "tait_B": "Pa",
        "tait_n": "1",
        "K_m": "W/(m K)",
        "c_m": "J/(kg K)",
        "A_v": "W/(m K^2)",
        "B_v": "W/(m K)",
        "D_v": "m^2/s",
        "D_p": "1",
        "D_T": "1",
        "L_v": "J/kg",
        "M_g": "kg/mol",
        "M_v": "kg/mol",
    }
)
_PHYSICS = "water at 25 °C, 1 atm (customary value of the cavitation literature)"
_PROSPERETTI = "Prosperetti, J. Fluid Mech. 222, 587 (1991): linear fit for air"
_WATER_SOURCES: Mapping[str, str] = {
    "rho": _PHYSICS,
    "c": _PHYSICS,
    "p_inf": "standard atmosphere",
    "S": _PHYSICS,
    "T_inf": "25 °C",
    "kappa": "diatomic ideal gas",
    "A": _PROSPERETTI,
    "B": _PROSPERETTI,
    "tait_B": "Tait equation of water, p + B ∝ ρⁿ (Gilmore 1952; Prosperetti & Lezzi 1986)",
    "tait_n": "Tait equation of water, p + B ∝ ρⁿ (Gilmore 1952; Prosperetti & Lezzi 1986)",
    "K_m": "IMRv2 src/forward_solver/default_case.m, commit 788a54d (Km)",
    "c_m": "IMRv2 src/forward_solver/default_case.m, commit 788a54d (Cp)",
    "A_v": "IMRv2 src/forward_solver/default_case.m, commit 788a54d (ATv)",
    "B_v": "IMRv2 src/forward_solver/default_case.m, commit 788a54d (BTv)",
    "D_v": "IMRv2 src/forward_solver/default_case.m, commit 788a54d (D0)",
    "D_p": "IMRv2 src/forward_solver/default_case.m, commit 788a54d: a constant diffusivity",
    "D_T": "IMRv2 src/forward_solver/default_case.m, commit 788a54d: a constant diffusivity",
    "L_v": "IMRv2 src/forward_solver/default_case.m, commit 788a54d (L_heat)",
    "M_g": "molar mass of dry air",
    "M_v": "molar mass of water",
}


@dataclass(frozen=True)
class Medium:
    """SI values; the defaults are water and air at 25 °C (``water-25C``).

    rho kg/m³, c m/s, p_inf Pa, S N/m (surface tension), T_inf K, kappa (ratio of specific heats of the gas), and the
    gas's conductivity K(T) = A T + B with A in W/(m K²) and B in W/(m K) (Prosperetti 1991). ``p_v`` is a constant
    vapour pressure in Pa that adds to the gas pressure (0: none).

    For the enthalpy form and Gilmore's equation: Tait's (p + tait_B)/(p_inf + tait_B) = (ρ/rho)^tait_n. For a
    conducting medium: conductivity K_m, specific heat c_m. For vapour transport: the vapour's conductivity
    A_v T + B_v, diffusivity D_v (p_inf/p)^D_p (T/T_inf)^D_T in the gas (0 and 0: the constant of the rheometry codes;
    1 and 1.75: Fuller, Schettler & Giddings 1966), latent heat L_v, molar masses M_g of the gas and M_v of the vapour.

    ``sources`` says where each constant comes from.
    """

    rho: float = 998.0
    c: float = 1484.0
    p_inf: float = 101325.0
    S: float = 0.072
    T_inf: float = 298.15
    kappa: float = 1.4
    A: float = 5.28e-5
    B: float = 1.165e-2
    p_v: float = 0.0
    tait_B: float = 304.913e6
    tait_n: float = 7.15
    K_m: float = 0.55
    c_m: float = 4181.0
    A_v: float = 3.30e-5
    B_v: float = 1.742e-2
    D_v: float = 24.2e-6
    D_p: float = 0.0
    D_T: float = 0.0
    L_v: float = 2264.76e3
    M_g: float = 28.966e-3
    M_v: float = 18.01528e-3
    sources: Mapping[str, str] = field(default_factory=lambda: dict(_WATER_SOURCES), compare=False, repr=False)

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
        return {f.name: float(getattr(self, f.name)) for f in fields(self) if f.name in UNITS}

    def with_constants(self, source: str, **values: float) -> Medium:
        """The medium with some constants replaced, all from ``source``."""
        changed: dict[str, Any] = dict(values)
        return replace(self, **changed, sources={**self.sources, **dict.fromkeys(values, source)})


WATER_25C = Medium()

# The public rheometry codes (GitHub: InertialMicrocavitationRheometry, comp-physics/IMR-archive) disagree.
_IMR_V1 = "IMR_v1 (IMR-vanilla) src/IMRcall_parameters.m, archive commit fb83ef1; IMRv2 src/data_assimilation, 26c6bf3"
_IMR_V2 = "IMRv2 src/forward_solver/default_case.m, commit 788a54d"

CONSTANT_SETS: Mapping[str, Medium] = MappingProxyType(
    {
        "water-25C": WATER_25C,
        "imr-v1": WATER_25C.with_constants(
            _IMR_V1,
            rho=1060.0,
            c=1430.0,
            p_inf=101325.0,
            S=0.056,
            T_inf=298.15,
            kappa=1.4,
            A=5.3e-5,
            B=1.17e-2,
            K_m=0.55,
            c_m=8.3144598 / 28.966e-3 * 1.4 / 0.4,
            D_v=24.2e-6,
            L_v=2264.76e3,
            M_g=28.966e-3,
            M_v=18.01528e-3,
        ),
        "imr-v2": WATER_25C.with_constants(
            _IMR_V2,
            rho=1064.0,
            c=1484.0,
            p_inf=101325.0,
            S=0.07,
            T_inf=298.15,
            kappa=1.47,
            A=5.28e-5,
            B=1.165e-2,
            tait_B=304.913e6,
            tait_n=7.15,
            K_m=0.55,
            c_m=4181.0,
            A_v=3.30e-5,
            B_v=1.742e-2,
            D_v=24.2e-6,
            L_v=2264.76e3,
            M_g=28.966e-3,
            M_v=18.01528e-3,
        ),
    }
)
