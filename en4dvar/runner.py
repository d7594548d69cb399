"""The straight line: configuration → inverse problems → analyses → netCDF → report."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from en4dvar.assimilate import assimilate
from en4dvar.build import build
from en4dvar.config import Config, load_config
from en4dvar.errors import ConfigError
from en4dvar.executor import Executor, ProcessesExecutor, SerialExecutor, ThreadsExecutor, make_executor
from en4dvar.files import write_text
from en4dvar.problem import InverseProblem, IterationRecord
from en4dvar.progress import Progress, RunLog, describe
from en4dvar.provenance import provenance
from en4dvar.report import write_report
from en4dvar.rundir import RunDirectory
from en4dvar.store import Result, save


def run(
    config: Config | str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    progress: Progress | None = None,
    command: str = "",
) -> Result:
    """Estimate the parameters of one data set and write the run directory.

    Parameters
    ----------
    config: a loaded configuration, or the path of a YAML file.
    overrides: of dotted keys, when ``config`` is a path; e.g. ``{"data.path": "/data/gel.csv"}``.
    force: replace the files of an earlier run in the same directory.
    progress: called with the data set's name and the record of each iteration.
    command: what the user typed, for the file's history.

    Raises
    ------
    ConfigError, DataError, OutputError: before anything is computed. TooFewMembersError: the ensemble is lost.
    """
    config = _loaded(config, overrides)
    problems = build(config)
    if len(problems) != 1:
        raise ConfigError(f"data.path names {len(problems)} data sets; use run_campaign, or name one")
    return execute(config, problems, force=force, progress=progress, command=command)[0]


def run_campaign(
    config: Config | str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    progress: Progress | None = None,
    command: str = "",
) -> tuple[Result, ...]:
    """As :func:`run`, for any number of data sets, each estimated by itself; results in the order of the data."""
    config = _loaded(config, overrides)
    return execute(config, build(config), force=force, progress=progress, command=command)


def execute(
    config: Config,
    problems: tuple[InverseProblem, ...],
    *,
    force: bool = False,
    progress: Progress | None = None,
    command: str = "",
) -> tuple[Result, ...]:
    """Assimilate ``problems`` and write the run directory of ``config``."""
    directory = RunDirectory.create(config.directory, force)
    with RunLog(directory.claim("run.log")) as log, _executor(config) as executor:
        write_text(directory.claim("config.yaml"), config.text)
        write_text(directory.claim("config.resolved.yaml"), config.resolved)
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
        }
        log.write(attributes["history"])

        def tell(name: str, record: IterationRecord) -> None:
            log.write(describe(name, record))
            if progress is not None:
                progress(name, record)

        results = []
        for problem in problems:
            analysis = assimilate(problem, config.assimilation, config.seed, executor, tell)
            outcome = "converged" if analysis.converged else "not converged"
            log.write(f"{analysis.name}: {outcome}: {analysis.stop_reason}; {analysis.forward_runs} forward runs")
            log.write("\n".join(f"{analysis.name}: warning: {warning}" for warning in analysis.warnings))
            result = Result.from_analysis(analysis, attributes)
            save(result, _place(directory, analysis.name, len(problems)))
            results.append(result)
        report(directory)
        log.write("done")
    return tuple(results)


def report(directory: RunDirectory) -> Path:
    """Write (again) the report of a run from its netCDF, and list the files as the run's own."""
    directory.claim("report.html", "summary.csv")
    before = directory.listing("figures")
    try:
        return write_report(directory.path)
    finally:
        directory.claim_folder("figures", before)


def _place(directory: RunDirectory, name: str, n_datasets: int) -> Path:
    if n_datasets == 1:
        return directory.claim("posterior.nc")
    directory.folder("datasets")
    return directory.claim(f"datasets/{name}.nc")


def _executor(config: Config) -> Executor:
    """As configured; by default threads on every core for compiled models, else this process alone."""
    kind, workers = config.execution.executor, config.execution.workers
    if kind == "serial":
        return SerialExecutor()
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = workers if kind or config.model.compiled else 1
    if kind is None:
        return make_executor(config.model, workers)
    return ThreadsExecutor(workers) if kind == "threads" else ProcessesExecutor(workers)


def _loaded(config: Config | str | Path, overrides: Mapping[str, Any] | None) -> Config:
    if not isinstance(config, Config):
        return load_config(config, overrides)
    if overrides:
        raise ConfigError("overrides apply to a file; give them to load_config instead")
    return config
