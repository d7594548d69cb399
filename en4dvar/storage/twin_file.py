"""The files of a twin experiment: ``twin.nc`` and ``summary.csv``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from en4dvar.cycling.twin import TwinResult
from en4dvar.storage.sequence_file import (
    innovation_variables,
    moment_variables,
    run_attributes,
    run_variables,
    series_variables,
    state_names,
)
from en4dvar.tables import csv_text

if TYPE_CHECKING:
    import xarray as xr

MEAN = "mean_after_burn_in"  # attribute of the scores


def summary_csv(result: TwinResult) -> str:
    """RMSE, spread and iterations, averaged after the burn-in, as CSV."""
    counted = slice(result.experiment.burn_in, None)
    forecasts = f"{np.mean(result.run.iterations[counted]):.4g}"
    lines = [["estimate", "rmse", "spread", "cycles", "forecasts_per_cycle"]]
    for name, score in result.scores.items():
        cycles = str(np.isfinite(score.rmse[counted]).sum())
        lines.append([name, f"{score.mean_rmse:.6g}", f"{score.mean_spread:.6g}", cycles, forecasts])
    return csv_text(lines)


def dataset(result: TwinResult, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Truth, observations, moments and scores over (time, state), with units."""
    import xarray as xr

    experiment, model = result.experiment, result.experiment.model
    names, units = state_names(model)
    unit = units[int(np.argmax(experiment.dynamic))]
    along = ("time", "state")
    variables: dict[str, Any] = {
        "truth": (along, result.truth, {"long_name": "state of the truth"}),
        **series_variables(result.series),
        **innovation_variables(result.series, result.run),
        **run_variables(result.run),
    }
    run = result.run
    for kind, moments in (("forecast", run.forecast), ("analysis", run.analysis), ("smoothed", run.smoothed)):
        if (score := result.scores.get(kind)) is None:
            continue
        rmse = {"long_name": f"RMSE of the {kind} mean", "units": unit, MEAN: score.mean_rmse}
        spread = {"long_name": f"spread of the {kind}", "units": unit, MEAN: score.mean_spread}
        variables |= {
            **moment_variables({kind: moments}),
            f"{kind}_rank": (along, moments.rank, {"long_name": f"share of the {kind} members below the truth"}),
            f"{kind}_rmse": ("time", score.rmse, rmse),
            f"{kind}_spread": ("time", score.spread, spread),
        }
    coordinates = {
        "time": ("time", result.series.times, {"units": model.time_unit, "long_name": "observation time"}),
        "state": ("state", names, {"long_name": "variable of the state"}),
        "units": ("state", units, {"long_name": "unit of the variable"}),
        "dynamic": ("state", experiment.dynamic.astype(np.int8), {"long_name": "1: counts in RMSE and spread"}),
    }
    root = {
        "Conventions": "CF-1.10, ACDD-1.3",
        "title": "Twin experiment",
        "seed": result.seed,
        "members": experiment.members,
        "burn_in": experiment.burn_in,
        **run_attributes(run),
        "warnings": "\n".join(result.warnings),
        **attributes,
    }
    return xr.Dataset(variables, coordinates, root)
