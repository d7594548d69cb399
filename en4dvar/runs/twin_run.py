"""A twin experiment from YAML to a run directory: ``twin.nc``, ``summary.csv``, report. Resumable at any moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from en4dvar.config import TwinConfig, load_twin
from en4dvar.cycling.twin import TwinResult, conduct
from en4dvar.executor import make_executor
from en4dvar.files import write_text
from en4dvar.runs.cycles import kept_cycles
from en4dvar.runs.interrupt import terminate_as_interrupt
from en4dvar.runs.rundir import RunDirectory
from en4dvar.runs.session import Session, directory_mode, session
from en4dvar.storage.checkpoint import FOLDER
from en4dvar.storage.netcdf import netcdf_file
from en4dvar.storage.twin_file import dataset, summary_csv
from en4dvar.tables import table

STATE = f"{FOLDER}/twin.cycle"


def run_twin(
    config: TwinConfig | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> TwinResult:
    """Conduct a twin experiment and write its run directory; arguments and errors as of :func:`en4dvar.run`.

    ``on_cycle`` is called with the number of each cycle, from 0.
    """
    if not isinstance(config, TwinConfig):
        config = load_twin(config, overrides)
    kept = f"the cycles up to the last checkpoint are kept in {config.directory}"
    with (
        terminate_as_interrupt(),
        RunDirectory.open(config.directory, directory_mode(force, resume)) as directory,
        session(config, {}, directory, command, lambda: kept) as run,
    ):
        run.begin("twin.nc", "summary.csv", STATE)
        result = _conduct(config, run, on_cycle)
        run.log.write("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        attributes = {**run.attributes, "name": config.name, "scheme": config.scheme}
        with netcdf_file(directory.at("twin.nc")) as partial:
            dataset(result, attributes).to_netcdf(partial, engine="netcdf4", format="NETCDF4")
        write_text(directory.at("summary.csv"), summary_csv(result))
        if config.report:
            report_twin(directory, config.figures)
    return result


def report_twin(directory: RunDirectory, figures: bool = False) -> Path:
    """Write the page of a finished twin experiment, on demand its figures as files too. Raises :class:`OutputError`."""
    from en4dvar.report.twin import write_twin_report

    directory.claim("report.html")
    with directory.claiming("figures"):
        return write_twin_report(directory.work, figures)


def _conduct(config: TwinConfig, run: Session, on_cycle: Callable[[int], None] | None) -> TwinResult:
    experiment = config.experiment
    with (
        make_executor(experiment.model, config.execution.workers) as executor,
        kept_cycles(run, STATE, config.execution.checkpoint_every, experiment.cycles) as (resume, keep),
    ):
        return conduct(experiment, config.seed, executor, on_cycle, resume, keep)


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
