"""Assimilation schemes, one a file: what is computed, nothing else. A new one is a file and a line below."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from en4dvar.schemes.base import Scheme
from en4dvar.schemes.baselines import Climatology, OptimalInterpolation
from en4dvar.schemes.bootstrap_filter import BootstrapFilter
from en4dvar.schemes.denkf import DEnKF
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.schemes.enkf import EnKF
from en4dvar.schemes.enkf_n import EnKFN
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.esrf import ESRF
from en4dvar.schemes.etkf import ETKF
from en4dvar.schemes.ienks import IEnKS

# name in a configuration → class; its fields are keys of the section ``assimilation:``
SCHEMES: dict[str, Any] = {
    "en4dvar": En4DVar,
    "es-mda": ESMDA,
    "etkf": ETKF,
    "denkf": DEnKF,
    "enkf": EnKF,
    "esrf": ESRF,
    "enkf-n": EnKFN,
    "ienks": IEnKS,
    "particle-filter": BootstrapFilter,
    "optimal-interpolation": OptimalInterpolation,
    "climatology": Climatology,
}
ON_A_WINDOW, ON_A_SERIES = ({n: kind for n, kind in SCHEMES.items() if on in kind.on} for on in ("window", "series"))


def window_scheme(settings: Any) -> Scheme:
    """The scheme that the settings of an estimate name, with those of their values that are its fields."""
    kind = ON_A_WINDOW[settings.scheme]
    scheme: Scheme = kind(**{f.name: getattr(settings, f.name) for f in fields(kind)})
    return scheme
