"""The files of a sequence: ``sequence.nc`` and ``summary.csv``, and what ``twin.nc`` has in common with the first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from en4dvar.cycling.moments import Moments
from en4dvar.cycling.outcome import SequentialResult
from en4dvar.cycling.problem import SeriesProblem, SeriesResult, normalised_innovations
from en4dvar.cycling.series import CycleSeries
from en4dvar.forward import ForwardModel, Observable, StateField
from en4dvar.state import Array
from en4dvar.tables import csv_text

if TYPE_CHECKING:
    import xarray as xr


def state_names(model: ForwardModel) -> tuple[list[str], list[str]]:
    """Names and units of the variables of the state."""
    names = [f"{f.name}_{j}" if f.size > 1 else f.name for f in model.layout for j in range(f.size)]
    return names, [f.unit for f in model.layout for _ in range(f.size)]


def moment_variables(kinds: Mapping[str, Moments]) -> dict[str, Any]:
    """Mean and standard deviation of the ensembles, by kind of estimate."""
    along = ("time", "state")
    found: dict[str, Any] = {}
    for kind, moments in kinds.items():
        found[f"{kind}_mean"] = (along, moments.mean, {"long_name": f"mean of the {kind} ensemble"})
        found[f"{kind}_std"] = (along, moments.std, {"long_name": f"standard deviation of the {kind} ensemble"})
    return found


def series_variables(series: CycleSeries) -> dict[str, Any]:
    """What was observed, and how well."""
    along = ("time", "observation") if series.std.ndim == 2 else "observation"
    found: dict[str, Any] = {
        "observations": (("time", "observation"), series.values, {"long_name": "observations"}),
        "observation_std": (along, series.std, {"long_name": "std of the observation errors"}),
    }
    if series.correlation is not None:
        text = {"long_name": "correlation of the observation errors", "units": "1"}
        matrix = series.correlation.matrix
        found["observation_correlation"] = (("observation", "observation_column"), matrix, text)
    return found


def innovation_variables(series: CycleSeries, run: SequentialResult) -> dict[str, Any]:
    """Forecasts of the observations, and what the observations said of them."""
    along = ("time", "observation")
    rank = {"long_name": "share of forecast members, observation errors added, below the observation", "units": "1"}
    words = "innovation over its expected standard deviation"
    return {
        "predicted_mean": (along, run.predicted.mean, {"long_name": "forecast of the observation"}),
        "predicted_std": (along, run.predicted.std, {"long_name": "standard deviation of that forecast"}),
        "normalised_innovation": (along, normalised_innovations(series, run), {"long_name": words, "units": "1"}),
        "rank": (along, run.ranks, rank),
    }


def run_variables(run: SequentialResult) -> dict[str, Any]:
    """How the cycles went."""
    found = {"iterations": ("time", run.iterations, {"long_name": "forecasts of the window", "units": "1"})}
    if np.isfinite(run.effective).any():
        text = {"long_name": "members that the weights leave, 1 / sum of their squares", "units": "1"}
        found["effective"] = ("time", run.effective, text)
    return found


def run_attributes(run: SequentialResult) -> dict[str, Any]:
    """What became of the members."""
    return {
        "forward_runs": run.forward_runs,
        "members_lost": len(run.failures),
        "members_lost_why": "\n".join(run.failures),
    }


def dataset(result: SeriesResult, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Estimates over (time, state), observations and innovations over (time, observation), members, with units."""
    import xarray as xr

    problem, run, series = result.problem, result.run, result.problem.series
    model = problem.start.model
    names, units = state_names(model)
    kinds = {"forecast": run.forecast, "analysis": run.analysis}
    if problem.settings.smooths:
        kinds["smoothed"] = run.smoothed
    of_members = ("member_time", "member", "state")
    variables = {
        **series_variables(series),
        **moment_variables(kinds),
        **innovation_variables(series, run),
        **run_variables(run),
        "evidence": ("time", run.evidence, {"long_name": "log density of the observations given those before"}),
        "members": (of_members, _members(run, problem.members), {"long_name": "analysis ensemble"}),
    }
    of_columns = {observable.name: observable for observable in problem.observables}
    columns = [of_columns[name.split(" at ")[0]] for name in series.names]  # of a field the place stands behind
    of_state = [_field_read(column, model) for column in columns]
    shown = {p.name: p.display_unit for p in model.parameters}
    shown |= {name: o.display_unit for name, o in zip(of_state, columns, strict=True) if name}
    along = {"units": model.time_unit, "display_units": model.time_display_unit, "long_name": "observation time"}
    coordinates = {
        "time": ("time", series.times, along),
        "state": ("state", names, {"long_name": "variable of the state"}),
        "units": ("state", units, {"long_name": "unit of the variable"}),
        "display_units": (
            "state",
            [shown.get(name, unit) for name, unit in zip(names, units, strict=True)],
            {"long_name": "unit of the variable in reports"},
        ),
        "positive": ("state", _positive(problem), {"long_name": "1: the ensemble holds its logarithm"}),
        "observation": ("observation", list(series.names), {"long_name": "what was observed"}),
        "observation_units": ("observation", [o.unit for o in columns], {"long_name": "unit of the observation"}),
        "observation_display_units": (
            "observation",
            [o.display_unit for o in columns],
            {"long_name": "unit of the observation in reports"},
        ),
        "observation_state": ("observation", of_state, {"long_name": "variable of the state that was observed"}),
        "member_time": ("member_time", series.times[[k for k, _ in run.kept]], {"units": model.time_unit}),
    }
    root = {
        "Conventions": "CF-1.10, ACDD-1.3",
        "title": "Sequential assimilation of a series",
        "data_set": problem.name,
        "parameters": ", ".join(problem.start.prior.names if problem.start.prior else ()),
        "seed": result.seed,
        "members": problem.members,
        "log_evidence": result.log_evidence,
        "without_evidence": problem.without_evidence,
        "warnings": "\n".join(result.warnings),
        **run_attributes(run),
        **attributes,
    }
    return xr.Dataset(variables, coordinates, root)


def _field_read(observable: Observable, model: ForwardModel) -> str:
    """The variable of the state that an observable reads as it is; "" where it is more than that."""
    name = observable.operator.name if isinstance(observable.operator, StateField) else ""
    one = name in model.layout.names and model.layout[name].stop - model.layout[name].start == 1
    return name if one else ""


def _positive(problem: SeriesProblem) -> npt.NDArray[np.int8]:
    """(n,) 1 where the ensemble holds the logarithm of a variable."""
    coordinates = problem.settings.coordinates
    found = np.zeros(problem.start.model.layout.size, dtype=np.int8)
    found[list(coordinates.logarithms)] = 1
    found[[column for column, term in coordinates.terms if term.transform == "lognormal"]] = 1
    return found


def _members(run: SequentialResult, n_members: int) -> Array:
    """(T, N, n), those that were lost NaN at the end."""
    found = np.full((len(run.kept), n_members, run.analysis.mean.shape[1]), np.nan)
    for row, (_, members) in zip(found, run.kept, strict=True):
        row[: len(members)] = members
    return found


def estimates(result: SeriesResult) -> list[tuple[str, float, float, str]]:
    """(name, mean, std, unit) of what is uncertain in the analysis at the last time."""
    names, units = state_names(result.problem.start.model)
    last = result.run.analysis
    rows = zip(names, last.mean[-1], last.std[-1], units, strict=True)
    return [(name, float(mean), float(std), unit) for name, mean, std, unit in rows if std > 1e-12 * abs(mean)]


def summary_csv(result: SeriesResult) -> str:
    """State and parameters at the last time as CSV."""
    rows = [[name, f"{mean:.8g}", f"{std:.6g}", unit] for name, mean, std, unit in estimates(result)]
    return csv_text([["variable", "mean", "std", "unit"], *rows])
