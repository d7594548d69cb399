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
MU_P = Parameter(
    "mu_p",
    unit="Pa s",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="viscosity of the relaxing part",
    symbol=r"$\mu_p$",
    source="Warnez & Johnsen (2015)",
)
RELAXATION_TIME = Parameter(
    "relaxation_time",
    unit="s",
    transform="lognormal",
    bounds=(1e-12, np.inf),
    label="relaxation time",
    symbol=r"$\theta$",
    display_unit="us",
    source="Warnez & Johnsen (2015)",
)
MU_0 = Parameter(
    "mu_0",
    unit="Pa s",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="viscosity at rest",
    symbol=r"$\mu_0$",
    source="Carreau (1972); Cross (1965)",
)
MU_INF = Parameter(
    "mu_inf",
    unit="Pa s",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="viscosity at high shear rate",
    symbol=r"$\mu_\infty$",
    source="Carreau (1972); Cross (1965)",
)
SHEAR_TIME = Parameter(
    "shear_time",
    unit="s",
    transform="lognormal",
    bounds=(0.0, np.inf),
    label="time constant of shear thinning",
    symbol=r"$\lambda_c$",
    display_unit="us",
    source="Carreau (1972); Cross (1965)",
)
