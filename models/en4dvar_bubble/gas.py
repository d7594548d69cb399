"""Gas and vapour in the bubble: saturation, fractions of a mixture, the variable in which heat conduction is linear."""

from typing import overload

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.medium import Medium

GAS_CONSTANT = 8.314462618
"""J/(mol K), CODATA 2018."""
CRITICAL_TEMPERATURE = 647.096
"""K, of water (IAPWS-95)."""


SATURATION, SATURATION_TEMPERATURE = 1.17e11, 5200.0
"""Pa and K: p_sat(T) = SATURATION · exp(−SATURATION_TEMPERATURE/T), fit of the rheometry codes (Estrada 2018)."""


@overload
def saturated_vapour_pressure(temperature: float) -> float: ...
@overload
def saturated_vapour_pressure(temperature: Array) -> Array: ...
def saturated_vapour_pressure(temperature: float | Array) -> float | Array:
    """p_sat(T) in Pa; 3.1 kPa at 25 °C."""
    pressure = SATURATION * np.exp(-SATURATION_TEMPERATURE / np.asarray(temperature))
    return np.asarray(pressure) if np.ndim(temperature) else float(pressure)


def mole_fraction(C: Array, medium: Medium) -> Array:
    """Mole fraction of vapour from its mass fraction."""
    return np.asarray(C / medium.M_v / (C / medium.M_v + (1 - C) / medium.M_g))


def mass_fraction(chi: Array | float, medium: Medium) -> Array:
    """Mass fraction of vapour from its mole fraction."""
    return np.asarray(chi * medium.M_v / (chi * medium.M_v + (1 - chi) * medium.M_g))


def kirchhoff(theta: Array | float, medium: Medium) -> Array:
    """Kirchhoff's transform of θ = T/T_∞: τ = ∫₁^θ k dθ for the conductivity k = K/K_∞ = a θ + (1−a)."""
    a = medium.conduction_slope
    return np.asarray(0.5 * a * (theta**2 - 1) + (1 - a) * (theta - 1))


def from_kirchhoff(tau: Array, medium: Medium) -> Array:
    """θ from τ."""
    return np.asarray(1 + 2 * tau / (np.sqrt(1 + 2 * medium.conduction_slope * tau) + 1))
