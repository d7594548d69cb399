"""A twin experiment from YAML to a run directory: ``twin.nc`` and ``summary.csv``."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from en4dvar.config import TwinConfig, load_twin
from en4dvar.describe import table
from en4dvar.executor import make_executor
from en4dvar.files import atomic_path, write_text
from en4dvar.progress import RunLog
from en4dvar.provenance import provenance
from en4dvar.rundir import RunDirectory
from en4dvar.twin import TwinResult, conduct


def run_twin(
    config: TwinConfig | str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> TwinResult:
    """Conduct a twin experiment and write its run directory.

    Parameters
    ----------
    config: a loaded configuration, or the path of a YAML file. overrides: of dotted keys, when it is a path.
    force: replace the files of an earlier run in the same directory.
    on_cycle: called with the number of each cycle, from 0.
    command: what the user typed, for the file's history.

    Raises
    ------
    ConfigError, OutputError: before anything is computed. TooFewMembersError: the ensemble is lost.
    """
    if not isinstance(config, TwinConfig):
        config = load_twin(config, overrides)
    with (
        RunDirectory.open(config.directory, "force" if force else "new") as directory,
        RunLog(directory.claim("run.log")) as log,
    ):
        write_text(directory.claim("config.yaml"), config.text)
        write_text(directory.claim("config.resolved.yaml"), config.resolved)
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
        }
        log.write(attributes["history"])
        with make_executor(config.experiment.model, config.execution.workers) as executor:
            result = conduct(config.experiment, config.seed, executor, on_cycle)
        log.write("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        with atomic_path(directory.claim("twin.nc")) as partial:
            dataset(result, attributes).to_netcdf(partial, engine="netcdf4", format="NETCDF4")
        write_text(directory.claim("summary.csv"), summary_csv(result))
        log.write("done")
        directory.publish()
    return result


def scores_table(result: TwinResult) -> str:
    """RMSE and spread after the burn-in as an aligned table."""
    rows = [(name, f"{s.mean_rmse:.4g}", f"{s.mean_spread:.4g}") for name, s in result.scores.items()]
    return table([("estimate", "RMSE", "spread"), *rows])


def twin_summary(config: TwinConfig) -> str:
    """What ``validate`` prints of a twin experiment."""
    experiment = config.experiment
    unit = "" if experiment.model.time_unit == "1" else f" {experiment.model.time_unit}"
    observed = ", ".join(
        f"{o.name} (std {experiment.error_std[o.name]:.4g}{'' if o.unit == '1' else ' ' + o.unit})"
        for o in experiment.observables
    )
    drawn = f" and {', '.join(experiment.prior.names)}" if experiment.prior else ""
    return (
        f"{config.name}: twin experiment, state{drawn} estimated with {config.scheme}, {experiment.members} members, "
        f"seed {config.seed}\n"
        f"{experiment.cycles} cycles every {experiment.interval:g}{unit} ({experiment.burn_in} not counted), "
        f"observed: {observed}\nrun directory: {config.directory}"
    )


def summary_csv(result: TwinResult) -> str:
    """RMSE, spread and iterations, averaged after the burn-in, as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["estimate", "rmse", "spread", "cycles", "forecasts_per_cycle"])
    counted = slice(result.experiment.burn_in, None)
    forecasts = float(np.mean(result.run.iterations[counted]))
    for name, score in result.scores.items():
        cycles = int(np.isfinite(score.rmse[counted]).sum())
        writer.writerow([name, f"{score.mean_rmse:.6g}", f"{score.mean_spread:.6g}", cycles, f"{forecasts:.4g}"])
    return text.getvalue()


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
    for kind, moments in (("forecast", run.forecast), ("analysis", run.analysis), ("smoothed", run.smoothed)):
        if kind in result.scores:
            score = result.scores[kind]
            variables |= {
                f"{kind}_mean": (along, moments.mean, {"long_name": f"mean of the {kind} ensemble"}),
                f"{kind}_std": (along, moments.std, {"long_name": f"standard deviation of the {kind} ensemble"}),
                f"{kind}_rmse": ("time", score.rmse, {"long_name": f"RMSE of the {kind} mean", "units": unit}),
                f"{kind}_spread": ("time", score.spread, {"long_name": f"spread of the {kind}", "units": unit}),
            }
    coordinates = {
        "time": ("time", result.series.times, {"units": model.time_unit, "long_name": "observation time"}),
        "state": ("state", names, {"long_name": "variable of the state"}),
        "units": ("state", units, {"long_name": "unit of the variable"}),
    }
    root = {"Conventions": "CF-1.10, ACDD-1.3", "title": "Twin experiment", "seed": result.seed, **attributes}
    return xr.Dataset(variables, coordinates, root)
