"""A sequence from YAML to a run directory: ``sequence.nc``, ``summary.csv``, report. Resumable at any moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.config import SequenceConfig, load_sequence
from en4dvar.config.build_sequence import build_sequence, sequence_data
from en4dvar.cycling.problem import SeriesProblem, SeriesResult, assimilate_series
from en4dvar.errors import ConfigError
from en4dvar.executor import make_executor
from en4dvar.files import write_text
from en4dvar.runs.cycles import kept_cycles
from en4dvar.runs.interrupt import terminate_as_interrupt
from en4dvar.runs.rundir import RunDirectory
from en4dvar.runs.session import directory_mode, session
from en4dvar.storage.checkpoint import FOLDER
from en4dvar.storage.netcdf import netcdf_file
from en4dvar.storage.sequence_file import dataset, estimates, summary_csv
from en4dvar.tables import table

STATE = f"{FOLDER}/sequence.cycle"


def run_sequence(
    config: SequenceConfig | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> SeriesResult:
    """Assimilate a series of data and write its run directory; arguments and errors as of :func:`en4dvar.run`.

    ``on_cycle`` is called with the index of the last observation time of each cycle, from 0.

    Raises :class:`ConfigError` for ``overrides`` of a configuration that is loaded already.
    """
    if not isinstance(config, SequenceConfig):
        config = load_sequence(config, overrides)
    elif overrides:
        raise ConfigError("overrides apply to a file or dict; give them to load_sequence instead")
    problem, files = build_sequence(config), sequence_data(config)
    kept = f"the cycles up to the last checkpoint are kept in {config.directory}"
    with (
        terminate_as_interrupt(),
        RunDirectory.open(config.directory, directory_mode(force, resume)) as directory,
        session(config, files, directory, command, lambda: kept) as run,
    ):
        run.begin("sequence.nc", "summary.csv", STATE)
        cycles = len(problem.series.times)
        with (
            make_executor(config.model, config.execution.workers) as executor,
            kept_cycles(run, STATE, config.execution.checkpoint_every, cycles) as (before, keep),
        ):
            result = assimilate_series(problem, config.seed, executor, on_cycle, before, keep)
        run.log.write("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        attributes = {**run.attributes, "name": config.name, "scheme": config.assimilation.scheme}
        with netcdf_file(directory.at("sequence.nc")) as partial:
            dataset(result, attributes).to_netcdf(partial, engine="netcdf4", format="NETCDF4")
        write_text(directory.at("summary.csv"), summary_csv(result))
        if config.report:
            report_sequence(directory, config.figures)
    return result


def report_sequence(directory: RunDirectory, figures: bool = False) -> Path:
    """Write the page of a finished sequence, on demand its figures as files too. Raises :class:`OutputError`."""
    from en4dvar.report.sequence import write_sequence_report

    directory.claim("report.html")
    with directory.claiming("figures"):
        return write_sequence_report(directory.work, figures)


def estimates_table(result: SeriesResult) -> str:
    """State and parameters at the last time as an aligned table."""
    rows = [(name, f"{mean:.5g}", f"{std:.3g}", unit) for name, mean, std, unit in estimates(result)]
    return table([("at the end", "mean", "std", "unit"), *rows])


def sequence_summary(config: SequenceConfig, problem: SeriesProblem) -> str:
    """What ``validate`` prints of a sequence."""
    series, start = problem.series, problem.start
    unit = "" if config.model.time_unit == "1" else f" {config.model.time_unit}"
    drawn = f" and {', '.join(start.prior.names)}" if start.prior else ""
    observed = ", ".join(observable.name for observable in problem.observables)
    return (
        f"{config.name}: sequence of {problem.name}, state{drawn} estimated with {config.assimilation.scheme}, "
        f"{problem.members} members, seed {config.seed}\n"
        f"{np.isfinite(series.values).sum()} readings of {observed} at {len(series.times)} times from "
        f"{series.times[0]:g} to {series.times[-1]:g}{unit}\nrun directory: {config.directory}"
    )
