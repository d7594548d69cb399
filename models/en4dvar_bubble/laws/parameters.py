"""Parameters that several laws share; a law lists those it uses."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Protocol, cast

import numpy as np

from en4dvar.model.state import Array
from en4dvar.model.state import Parameter as Parameter  # laws that take all names of this module have it, too
from en4dvar_bubble.numbers import positive as positive

MANCIA = "Mancia et al. (2021), eq. 2"
_WARNEZ = "Warnez & Johnsen (2015)"
_THINNING = "Carreau (1972); Cross (1965)"

G = positive("G", "Pa", "shear modulus", "$G$", MANCIA, "kPa")
ALPHA = positive("alpha", "1", "stiffening parameter", r"$\alpha$", "Yang et al. (2020)")
MU = positive("mu", "Pa s", "viscosity", r"$\mu$", MANCIA)
MU_P = positive("mu_p", "Pa s", "viscosity of the relaxing part", r"$\mu_p$", _WARNEZ)
RELAXATION_TIME = positive("relaxation_time", "s", "relaxation time", r"$\theta$", _WARNEZ, "us", least=1e-12)
MU_0 = positive("mu_0", "Pa s", "viscosity at rest", r"$\mu_0$", _THINNING)
MU_INF = positive("mu_inf", "Pa s", "viscosity at high shear rate", r"$\mu_\infty$", _THINNING)
SHEAR_TIME = positive("shear_time", "s", "time constant of shear thinning", r"$\lambda_c$", _THINNING, "us")


class Values(Protocol):
    """The parameters of a law, each a column (N, 1) under its name: ``p.G``."""

    def __getattr__(self, name: str) -> Array: ...


def columns(values: Mapping[str, Array]) -> Values:
    """The ``p`` of a law's methods: values as columns (N, 1), so that they broadcast against a row of stretches."""
    columns = {name: np.asarray(v, dtype=float)[:, None] for name, v in values.items()}
    return cast(Values, SimpleNamespace(**columns))
