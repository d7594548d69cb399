"""Assimilation schemes, one a file: what is computed, nothing else. A new one is a file and a line below."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, cast

from en4dvar.schemes.base import Scheme
from en4dvar.schemes.denkf import DEnKF
from en4dvar.schemes.en4dvar import En4DVar
from en4dvar.schemes.enkf_n import EnKFN
from en4dvar.schemes.esmda import ESMDA
from en4dvar.schemes.etkf import ETKF
from en4dvar.schemes.ienks import IEnKS

# name in a configuration → class; its fields are keys of the section ``assimilation:``
ON_A_WINDOW: dict[str, Callable[..., Scheme]] = {
    "en4dvar": En4DVar,
    "es-mda": ESMDA,
    "etkf": ETKF,
    "denkf": DEnKF,
    "enkf-n": EnKFN,
}
ON_A_SERIES: dict[str, Callable[..., Scheme]] = {"etkf": ETKF, "ienks": IEnKS, "denkf": DEnKF, "enkf-n": EnKFN}


def window_scheme(settings: Any) -> Scheme:
    """The scheme that the settings of an estimate name, with those of their values that are its fields."""
    kind = ON_A_WINDOW[settings.scheme]
    return kind(**{f.name: getattr(settings, f.name) for f in fields(cast(Any, kind))})
