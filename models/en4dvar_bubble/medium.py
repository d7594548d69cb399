"""Constants of the liquid, the gas and their interface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Medium:
    """SI values; the defaults are water and air at 25 °C (``water-25C``).

    rho kg/m³, c m/s, p_inf Pa, S N/m (surface tension), T_inf K, kappa (ratio of specific heats of the gas), and the
    gas's conductivity K(T) = A T + B with A in W/(m K²) and B in W/(m K) (Prosperetti 1991). ``p_v`` is a constant
    vapour pressure in Pa that adds to the gas pressure (0: none).
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

    @property
    def K_inf(self) -> float:
        """Conductivity of the gas at T_inf, W/(m K)."""
        return self.A * self.T_inf + self.B


WATER_25C = Medium()


def saturated_vapour_pressure(temperature: float) -> float:
    """p_sat(T) = 1.17e11 exp(−5200/T) Pa, the fit of the rheometry codes (Estrada 2018); 3.1 kPa at 25 °C."""
    return float(1.17e11 * np.exp(-5200.0 / temperature))
