"""From what is stated about the errors to their kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np

from en4dvar.noise.correlated import CorrelatedNoise, Correlation
from en4dvar.noise.discrepancy import DiscrepancyNoise
from en4dvar.noise.gaussian import Noise
from en4dvar.noise.huber import HuberNoise
from en4dvar.noise.kernel import Kernel
from en4dvar.noise.robust_discrepancy import RobustDiscrepancyNoise
from en4dvar.state import Array


def noise_of_record(
    times: Array, std: Array, time_std: Array, matrices: Mapping[str, Array], attributes: Mapping[str, object]
) -> Noise:
    """The errors whose :meth:`Noise.matrices` and :meth:`Noise.attributes` are among what a file holds."""
    held = {key: float(cast(float, attributes[key])) for key in _NUMBERS if key in attributes}
    kernel = None
    if "discrepancy_smoothness" in held:
        kernel = Kernel(times, held["discrepancy_smoothness"], held["discrepancy_grows_beyond"])
    return noise_of(std, time_std, matrices.get("correlation"), held.get("huber_threshold"), kernel)


_NUMBERS = ("huber_threshold", "discrepancy_smoothness", "discrepancy_grows_beyond")


def noise_of(
    std: Array,
    time_std: Array | None = None,
    correlation: Array | None = None,
    huber: float | None = None,
    discrepancy: Kernel | None = None,
) -> Noise:
    """Errors of the kind that is given: independent, correlated by a matrix (K, K), or robust beyond ``huber`` std.

    Any of them may stand beside a ``discrepancy`` of the model; its amplitude and length are then parameters
    (:data:`~en4dvar.state.DISCREPANCY`).

    Raises
    ------
    ValueError: both a correlation and a robust cost, or a matrix that is no correlation.
    """
    time_std = np.zeros_like(std) if time_std is None else time_std
    if correlation is not None and huber is not None:
        raise ValueError("a robust cost needs independent observation errors")
    given = None if correlation is None else Correlation(correlation)
    if discrepancy is not None and huber is not None:
        return RobustDiscrepancyNoise(std, time_std, discrepancy, None, huber)
    if discrepancy is not None:
        return DiscrepancyNoise(std, time_std, discrepancy, given)
    if given is not None:
        return CorrelatedNoise(std, time_std, given)
    return Noise(std, time_std) if huber is None else HuberNoise(std, time_std, huber)
