"""What a file holds of the readings of each series: data, errors, predictions, residuals, and what each does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from en4dvar.analysis import Analysis
from en4dvar.diagnostics import active_members
from en4dvar.influence import prior_distance
from en4dvar.noise import BlockNoise
from en4dvar.observations import Observations
from en4dvar.series import Part, Places
from en4dvar.state import Array
from en4dvar.storage.axes import Axis, axes_of
from en4dvar.storage.netcdf import Variable
from en4dvar.storage.netcdf import variable as _variable

MEMBER = ("chain", "draw")
SCALAR = "scalar_"  # begins the attribute of a number found beside the data
Variables = dict[str, Variable]


def time_variable(a: Analysis, dim: str, values: Array, long_name: str) -> Variable:
    model = a.problem.model
    shown = model.time_display_unit
    return _variable(dim, values, model.time_unit, long_name, fill=False, display_units=shown, axis="T")


def series_of(a: Analysis) -> list[tuple[Axis, Part]]:
    """Each series with the names that its variables have."""
    parts = a.problem.parts
    return list(zip(axes_of([part.name for part in parts]), parts, strict=True))


def observable_variable(part: Part, dims: tuple[str, ...], values: Array, what: str) -> Variable:
    o = part.observable
    return _variable(dims, values, o.unit, f"{o.label}, {what}", display_units=o.display_unit, symbol=o.symbol)


def predictive(a: Analysis, predictions: Array) -> Variables:
    words = "noise-free prediction at the observations"
    return {
        part.name: observable_variable(part, (*MEMBER, axis.time), predictions[None, :, part.where], words)
        for axis, part in series_of(a)
    }


def paths(a: Analysis, members: Array) -> Variables:
    """Of each series that has one; they stand side by side in ``members``."""
    width, words = len(a.trajectory_times), "noise-free prediction along the path"
    parts = [part for _, part in series_of(a) if part.has_path]
    return {
        f"{part.name}_path": observable_variable(
            part, (*MEMBER, "path_time"), members[None, :, i * width : (i + 1) * width], words
        )
        for i, part in enumerate(parts)
    }


def log_likelihood(a: Analysis) -> Variables:
    return {
        part.name: _variable(
            (*MEMBER, axis.time),
            a.log_likelihood[None, :, part.where],
            "1",
            f"{part.observable.label}, log-likelihood of each observation",
        )
        for axis, part in series_of(a)
    }


def observed(a: Analysis) -> tuple[Variables, dict[str, Any]]:
    """The readings, and attributes of the data and of what is stated about their errors.

    Nothing else: tools take every variable of this group for one that the model predicts.
    """
    given = a.observations
    variables = {
        part.name: observable_variable(part, (axis.time,), given.values[part.where], "observed")
        for axis, part in series_of(a)
    }
    scalars = {f"{SCALAR}{key}": value for key, value in given.scalars.items()}
    numbers = _thresholds(given) if given.parts else given.noise.attributes()
    return variables, {"name": given.name, "data_source": given.source, **scalars, **numbers}


def stated(a: Analysis) -> Variables:
    """What is stated about the readings: their errors, weights and places."""
    given = a.observations
    variables: Variables = {}
    for axis, part in series_of(a):
        variables |= _stated_of_series(a, axis, part)
    dims = ("reading", "reading_column") if given.parts else ("time", "time_column")
    for key, (matrix, words) in given.noise.matrices().items():
        name = key if given.parts else f"{a.problem.observable.name}_{key}"
        variables[name] = _variable(dims if matrix.ndim == 2 else "correlated_pair", matrix, "1", words)
    return variables


def _stated_of_series(a: Analysis, axis: Axis, part: Part) -> Variables:
    name, stated, own = part.name, a.observations, part.where
    dims = (axis.time,)
    variables = {
        f"{name}_std": observable_variable(
            part, dims, a.error_std[own], "observation-error std, timing error included"
        ),
        f"{name}_reading_std": observable_variable(
            part, dims, stated.std[own], "observation-error std of the reading alone"
        ),
        axis.own("time_std"): time_variable(a, axis.time, stated.noise.time_std[own], "std of the observation times"),
        axis.own("weights"): _variable(dims, stated.weights[own], "1", "weight of the observation in the cost"),
    }
    if part.places is not None:
        variables |= _places(name, axis, part.places)
    if a.down_weights is not None:
        words = "weight of the observation in the robust cost at its minimum"
        variables[f"{name}_huber_weight"] = _variable(dims, a.down_weights[own], "1", words)
    return variables


def _places(name: str, axis: Axis, places: Places) -> Variables:
    """Where on a field the readings were taken, and between which of its components they are interpolated."""
    corners = (axis.time, f"{name}_corner")
    index, share = places.indices.astype(float), places.shares
    return {
        f"{name}_place": _variable(axis.time, places.positions, places.unit, "where on the field it was read"),
        f"{name}_place_index": _variable(corners, index, "1", "components of the field that make up the reading"),
        f"{name}_place_share": _variable(corners, share, "1", "their shares"),
    }


def _thresholds(stated: Observations) -> dict[str, float]:
    """Beyond how many std the cost of each series is robust, of those where it is."""
    noise = stated.noise
    each = noise.thresholds if isinstance(noise, BlockNoise) else np.full(len(stated), noise.counts_within)
    found = {f"{part.name}_huber_threshold": float(each[part.begin]) for part in stated.parts}
    return {name: threshold for name, threshold in found.items() if math.isfinite(threshold)}


def _of_readings(a: Analysis, name: str, values: Array, words: str, above: tuple[str, ...] = ()) -> Variables:
    """Numbers (…, K) of the readings: a variable ``<series>_<name>`` for each series."""
    return {
        f"{part.name}_{name}": _variable((*above, axis.time), values[..., part.where], "1", words)
        for axis, part in series_of(a)
    }


def residuals(a: Analysis) -> Variables:
    """Whitened residuals and leverages (time), NaN where a reading does not count."""
    found = a.residuals
    if found is None:
        return {}
    white, leverage, studentised = np.full((3, len(a.observations)), np.nan)
    white[found.which], leverage[found.which], studentised[found.which] = found.white, found.leverage, found.studentised
    return {
        **_of_readings(a, "whitened_residual", white, "whitened residual at the minimum of J"),
        **_of_readings(a, "studentised", studentised, "whitened residual over its own expected std"),
        **_of_readings(a, "leverage", leverage, "share of the reading in its own prediction"),
    }


def readings(a: Analysis) -> Variables:
    """What each reading does to the posterior (parameter, time), and how far it lies from the prior (time)."""
    living = a.prior_predictions[active_members(a.prior_failures)]
    distance = prior_distance(a.observations.values, living, a.error_std)
    words = "distance of the reading from the prior's prediction, in the std of both"
    found = _of_readings(a, "prior_distance", distance, words)
    if a.influence is None:
        return found
    what = "change of the posterior mean if the reading is left out"
    how = "0 by importance weights, 1 by linear response, 2: only another fit tells"
    i = a.influence
    in_std = f"{what}, in posterior standard deviations"
    for axis, part in series_of(a):
        dims, own = ("parameter", axis.time), part.where
        words = f"{what}, each in the unit of its parameter"
        found |= {
            axis.own("influence_change"): _variable(dims, i.change[:, own], "1", words),
            axis.own("influence_in_std"): _variable(dims, i.in_std[:, own], "1", in_std),
            axis.own("influence_pareto_shape"): _variable(
                axis.time, i.pareto_shape[own], "1", "Pareto shape of the weights"
            ),
            axis.own("influence_how"): _variable(axis.time, i.how[own].astype(float), "1", how),
        }
    return found
