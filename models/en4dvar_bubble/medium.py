"""Constants of the liquid, the gas, the vapour and their interface, each with its source; named sets of them; the
saturation of vapour.

Media by name: density and speed of sound of water, gels and solutions, and how well each is known. The volumes of water
and polymer add, 1/ρ = (1−w)/ρ_w + w v, and the speed of sound rises in proportion to the mass fraction w,
c = c_w + s w. A gel made elsewhere differs from that by ``rho_error`` and ``c_error``, by what swelling or drying does
as well; where nobody says how much polymer there is, the usual amount and its spread count too, and what rheometry
codes take (``rho_codes``). At 25 °C; c_w changes by 0.18 % a kelvin.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from en4dvar.model.state import Array

GAS_CONSTANT = 8.314462618
"""J/(mol K), CODATA 2018."""
CRITICAL_TEMPERATURE = 647.096
"""K, of water (IAPWS-95)."""
SATURATION, SATURATION_TEMPERATURE = 1.17e11, 5200.0
"""Pa and K: p_sat(T) = SATURATION · exp(−SATURATION_TEMPERATURE/T), fit of the rheometry codes (Estrada 2018)."""

_PHYSICS = "water at 25 °C, 1 atm (customary value of the cavitation literature)"
_PROSPERETTI = "Prosperetti, J. Fluid Mech. 222, 587 (1991): linear fit for air"
_TAIT = "Tait equation of water, p + B ∝ ρⁿ (Gilmore 1952; Prosperetti & Lezzi 1986)"
_IMR_V2 = "IMRv2 src/forward_solver/default_case.m, commit 788a54d"
_FIXED = f"{_IMR_V2}: a constant diffusivity"
_VAPOUR = "(vapour: transport)"
_CODES, _KINETIC = "0 constant, as in the rheometry codes", f"kinetic theory {_VAPOUR}"
_OF_TAIT, _ENTHALPY = "Tait equation of the medium:", "(enthalpy form and Gilmore)"
_CONDUCTING = "(medium_heat: conducting)"


def saturated_vapour_pressure(temperature: float | Array) -> Any:
    """p_sat(T) in Pa, of a number or an array; 3.1 kPa at 25 °C."""
    return SATURATION * np.exp(-SATURATION_TEMPERATURE / temperature)


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
    tait_B: float = _constant(304.913e6, "Pa", f"{_OF_TAIT} pressure B {_ENTHALPY}.", _TAIT, gt=0)
    tait_n: float = _constant(7.15, "1", f"{_OF_TAIT} exponent n {_ENTHALPY}.", _TAIT, gt=1)
    K_m: float = _constant(
        0.55, "W/(m K)", f"Thermal conductivity of the medium {_CONDUCTING}.", f"{_IMR_V2} (Km)", gt=0
    )
    c_m: float = _constant(4181.0, "J/(kg K)", f"Specific heat of the medium {_CONDUCTING}.", f"{_IMR_V2} (Cp)", gt=0)
    D_v: float = _constant(
        24.2e-6, "m^2/s", f"Diffusivity of vapour in the gas at p_inf and T_inf {_VAPOUR}.", f"{_IMR_V2} (D0)", gt=0
    )
    D_p: float = _constant(0.0, "1", f"Diffusivity ∝ (p_inf/p)^D_p: {_CODES}; 1 {_KINETIC}.", _FIXED, ge=0, le=2)
    D_T: float = _constant(0.0, "1", f"Diffusivity ∝ (T/T_inf)^D_T: {_CODES}; 1.75 {_KINETIC}.", _FIXED, ge=0, le=3)
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

    def kirchhoff(self, theta: Array | float) -> Array:
        """τ = ∫₁^θ k dθ (Kirchhoff) of θ = T/T_∞ of any shape, for the conductivity k = K/K_∞ = a θ + (1−a)."""
        a = self.conduction_slope
        return np.asarray(0.5 * a * (theta**2 - 1) + (1 - a) * (theta - 1))

    def from_kirchhoff(self, tau: Array) -> Array:
        """θ from τ, of any shape."""
        return np.asarray(1 + 2 * tau / (np.sqrt(1 + 2 * self.conduction_slope * tau) + 1))

    def mole_fraction(self, C: Array) -> Array:
        """Mole fraction of vapour from its mass fraction, of any shape."""
        return np.asarray(C / self.M_v / (C / self.M_v + (1 - C) / self.M_g))

    def mass_fraction(self, chi: Array | float) -> Array:
        """Mass fraction of vapour from its mole fraction, of any shape."""
        return np.asarray(chi * self.M_v / (chi * self.M_v + (1 - chi) * self.M_g))

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

    @property
    def saturated(self) -> "Medium":
        """The medium with the saturated vapour pressure at T_inf as a constant one."""
        return replace(self, p_v=saturated_vapour_pressure(self.T_inf))

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


_WATER = 997.05, 1496.7  # kg/m³: IAPWS-95; m/s: Del Grosso & Mader (1972), both at 25 °C


@dataclass(frozen=True)
class KnownMedium:
    """Medians ``rho`` (kg/m³) and ``c`` (m/s), standard deviations of their logarithms, and where all that is from."""

    rho: float
    c: float
    rho_log_std: float
    c_log_std: float
    source: str


@dataclass(frozen=True)
class _Kind:
    """``volume`` v of the dissolved polymer in m³/kg, ``rise`` s of the speed in m/s; ``usual`` mass fraction and its
    standard deviation; relative errors of ρ and c beyond that of the concentration. ``rho_codes``: relative error of ρ
    where only the name is known, which reaches the density that codes take for such gels.
    """

    volume: float
    rise: float
    usual: tuple[float, float]
    rho_error: float
    c_error: float
    source: str
    rho_codes: float = 0.0

    def at(self, fraction: float) -> tuple[float, float]:
        """ρ and c at a mass fraction."""
        rho, c = _WATER
        return 1 / ((1 - fraction) / rho + fraction * self.volume), c + self.rise * fraction


_GEL = (
    "specific volumes of water and dry polymer added; speed: rise of the polyacrylamide–albumin phantom of Lafon et "
    "al. (2005), Ultrasound Med. Biol. 31, 1383"
)
_PEG = (
    "density: PEG 3000 in water at 298.15 K to 30 %, 1012.0 at 10 % and 1047.5 at 30 %, J. Korean Chem. Soc. 63 (2019)"
    ", supplement S12; speed: about 4.5 m/s for each percent"
)
_KINDS: Mapping[str, _Kind] = MappingProxyType(
    {
        "water": _Kind(1e-3, 0.0, (0.0, 0.0), 1e-3, 5e-3, "IAPWS-95; Del Grosso & Mader (1972), 25 °C, within 3 K"),
        "polyacrylamide": _Kind(0.70e-3, 300.0, (0.10, 0.04), 0.006, 0.01, _GEL, 0.015),
        "polyacrylamide-alginate": _Kind(0.68e-3, 300.0, (0.14, 0.05), 0.006, 0.01, _GEL, 0.015),
        "agarose": _Kind(0.63e-3, 300.0, (0.010, 0.007), 3e-3, 6e-3, _GEL),
        "gelatin": _Kind(0.69e-3, 300.0, (0.08, 0.04), 5e-3, 0.01, _GEL),
        "peg": _Kind(0.842e-3, 450.0, (0.20, 0.12), 3e-3, 0.015, _PEG),
    }
)
MEDIA: tuple[str, ...] = tuple(_KINDS)
"""The names: gels by their polymer, ``peg`` is poly(ethylene glycol) in water."""


def known_medium(name: str, concentration: float | None = None) -> KnownMedium:
    """A medium of :data:`MEDIA` at a ``concentration`` (mass of polymer over that of the whole), or at the usual one.

    Raises :class:`KeyError`: a name that is not in :data:`MEDIA`.
    """
    kind = _KINDS[name]
    fraction, spread = kind.usual if concentration is None else (concentration, 0.0)
    (rho, c), (rho_more, c_more) = kind.at(fraction), kind.at(fraction + spread)
    source, rho_error = f"{name}: {kind.source}", kind.rho_error
    if concentration is not None:
        source = f"{name} at {concentration:.3g} by mass: {kind.source}"
    elif kind.rho_codes:
        source, rho_error = f"{source} (rheometry codes: 1060 kg/m³)", kind.rho_codes
    return KnownMedium(
        rho, c, math.hypot(math.log(rho_more / rho), rho_error), math.hypot(math.log(c_more / c), kind.c_error), source
    )
