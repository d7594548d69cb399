"""Tables with a row a bubble, R_max, R_max/R_eq and collapse time, which are no radius histories."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from en4dvar.model.state import Array
from en4dvar_bubble.collapse import RAYLEIGH
from en4dvar_bubble.medium import Medium

RADII = (1e-6, 0.1)  # m
STRETCHES = (1.5, 50.0)  # R_max/R_eq
RATIOS = (0.3, 3.0)  # of the collapse time to Rayleigh's


def summary_rows(columns: Mapping[str, Array]) -> str:
    """In words what three neighbouring columns are, where the numbers leave no doubt; "" where there are none."""
    names = list(columns)
    for trio in zip(names, names[1:], names[2:], strict=False):
        radius, stretch, time = (columns[name] for name in trio)
        if not len(radius) == len(stretch) == len(time) > 1:
            continue
        medium = Medium()
        with np.errstate(all="ignore"):
            ratio = time / (RAYLEIGH * radius * np.sqrt(medium.rho / medium.p_inf))
        if all(
            _between(values, span)
            for values, span in zip((radius, stretch, ratio), (RADII, STRETCHES, RATIOS), strict=True)
        ):
            return (
                f"{', '.join(trio)} are {len(radius)} rows of R_max, R_max/R_eq and collapse time in SI units, one a "
                "bubble; init proposes from radius histories, a radius at each of many times"
            )
    return ""


def _between(values: Array, span: tuple[float, float]) -> bool:
    return bool(np.all((values > span[0]) & (values < span[1])))
