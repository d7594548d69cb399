"""Parameters that several laws share; a law lists those it uses."""

from __future__ import annotations

import numpy as np

from en4dvar.state import Parameter

G = Parameter(
    "G",
    unit="Pa",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="shear modulus",
    symbol="$G$",
    display_unit="kPa",
    source="Mancia et al. (2021), eq. 2",
)
ALPHA = Parameter(
    "alpha",
    unit="1",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="stiffening parameter",
    symbol=r"$\alpha$",
    source="Yang et al. (2020)",
)
MU = Parameter(
    "mu",
    unit="Pa s",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="viscosity",
    symbol=r"$\mu$",
    source="Mancia et al. (2021), eq. 2",
)
R0 = Parameter(
    "R0",
    unit="m",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="stress-free radius",
    symbol="$R_0$",
    display_unit="um",
    source="Mancia et al. (2021), eq. 2",
)
R_EQ = Parameter(
    "R_eq",
    unit="m",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="equilibrium (and stress-free) radius",
    symbol=r"$R_{\mathrm{eq}}$",
    display_unit="um",
    source="Estrada et al. (2018)",
)
R_MAX = Parameter(
    "R_max",
    unit="m",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="maximum radius, where the bubble is released",
    symbol=r"$R_{\max}$",
    display_unit="um",
    source="Estrada et al. (2018)",
)
