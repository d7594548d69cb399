"""The files of a twin experiment: ``twin.nc`` and ``summary.csv``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from en4dvar.cycling.twin import TwinResult
from en4dvar.tables import csv_text

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
    experiment, model = result.experiment, result.experiment.model
    names = [f"{f.name}_{j}" if f.size > 1 else f.name for f in model.layout for j in range(f.size)]
    units = [f.unit for f in model.layout for _ in range(f.size)]
    unit = units[int(np.argmax(experiment.dynamic))]
    along = ("time", "state")
    variables: dict[str, Any] = {
        "truth": (along, result.truth, {"long_name": "state of the truth"}),
        "observations": (("time", "observation"), result.series.values, {"long_name": "observations of the truth"}),
        "observation_std": ("observation", result.series.std, {"long_name": "std of the observation errors"}),
        "iterations": ("time", result.run.iterations, {"long_name": "forecasts of the window", "units": "1"}),
    }
    run = result.run
    if np.isfinite(run.effective).any():
        text = {"long_name": "members that the weights leave, 1 / sum of their squares", "units": "1"}
        variables["effective"] = ("time", run.effective, text)
    for kind, moments in (("forecast", run.forecast), ("analysis", run.analysis), ("smoothed", run.smoothed)):
        if (score := result.scores.get(kind)) is None:
            continue
        rmse = {"long_name": f"RMSE of the {kind} mean", "units": unit, MEAN: score.mean_rmse}
        spread = {"long_name": f"spread of the {kind}", "units": unit, MEAN: score.mean_spread}
        variables |= {
            f"{kind}_mean": (along, moments.mean, {"long_name": f"mean of the {kind} ensemble"}),
            f"{kind}_std": (along, moments.std, {"long_name": f"standard deviation of the {kind} ensemble"}),
            f"{kind}_rank": (along, moments.rank, {"long_name": f"share of the {kind} members below the truth"}),
            f"{kind}_rmse": ("time", score.rmse, rmse),
            f"{kind}_spread": ("time", score.spread, spread),
        }
    if result.series.correlation is not None:
        text = {"long_name": "correlation of the observation errors", "units": "1"}
        variables["observation_correlation"] = (
            ("observation", "observation_column"),
            result.series.correlation.matrix,
            text,
        )
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
        "forward_runs": run.forward_runs,
        "members_lost": len(run.failures),
        "members_lost_why": "\n".join(run.failures),
        "warnings": "\n".join(result.warnings),
        **attributes,
    }
    return xr.Dataset(variables, coordinates, root)
