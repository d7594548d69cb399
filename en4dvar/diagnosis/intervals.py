"""Quantiles of a posterior that few members stand for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from en4dvar.model.state import Array

METHOD: Literal["normal_unbiased"] = "normal_unbiased"


def member_quantiles(values: Array, levels: Sequence[float], axis: int | None = None) -> Any:
    """Quantiles (L, …) of what the members along ``axis`` are draws of; NaN is no member.

    The p-quantile lies at the place p (N + 1/4) + 3/8 among N members in order, where a Gaussian's is on average (Blom
    1958, *Statistical Estimates and Transformed Beta-Variables*). Interpolation between the smallest and the largest,
    numpy's default, made 90 % intervals of 48 members that hold 86 to 88 % of truths (``en4dvar calibrate``).
    """
    if np.isnan(values).any():  # one instant after the other
        return np.nanquantile(values, levels, axis=axis, method=METHOD)
    return np.quantile(values, levels, axis=axis, method=METHOD)
