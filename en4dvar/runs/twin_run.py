"""A twin experiment from YAML to a run directory: ``twin.nc``, ``summary.csv``, report. Resumable at any moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from en4dvar.config import TwinConfig, load_twin
from en4dvar.cycling.sequential import SequentialState
from en4dvar.cycling.twin import TwinResult, conduct
from en4dvar.errors import ConfigError, OutputError
from en4dvar.executor import make_executor
from en4dvar.files import atomic_path, write_text
from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
from en4dvar.runs.progress import RunLog
from en4dvar.runs.rundir import Mode, RunDirectory
from en4dvar.storage.checkpoint import FOLDER, CheckpointError, Keeper, digest, read_checkpoint, write_checkpoint
from en4dvar.storage.fingerprint import Identity, identity
from en4dvar.storage.provenance import provenance
from en4dvar.storage.seal import seal_file
from en4dvar.storage.twin_file import dataset, summary_csv
from en4dvar.tables import table

IDENTITY, STATE = f"{FOLDER}/run", f"{FOLDER}/twin.cycle"


def run_twin(
    config: TwinConfig | str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> TwinResult:
    """Conduct a twin experiment and write its run directory.

    Parameters
    ----------
    config: a loaded configuration, or the path of a YAML file. overrides: of dotted keys, when it is a path.
    force: replace the files of an earlier run in the same directory.
    resume: continue an interrupted run in the same directory, to the same bits.
    on_cycle: called with the number of each cycle, from 0.
    command: what the user typed, for the file's history.

    Raises
    ------
    ConfigError, OutputError: before anything is computed; also where a changed run cannot be resumed.
    TooFewMembersError: the ensemble is lost. Interrupted: Ctrl-C or SIGTERM.
    """
    if not isinstance(config, TwinConfig):
        config = load_twin(config, overrides)
    if force and resume:
        raise ConfigError("force replaces a run, resume continues it; give one of them")
    mode: Mode = "force" if force else "resume" if resume else "new"
    with (
        terminate_as_interrupt(),
        RunDirectory.open(config.directory, mode) as directory,
        tell_interrupt(lambda: f"the cycles up to the last checkpoint are kept in {directory.path}"),
        RunLog(directory.work / "run.log", append=resume) as log,
    ):
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
            "name": config.name,
            "scheme": config.scheme,
        }
        log.write(attributes["history"])
        run = identity(config.resolved, config.experiment.model, {})
        _prepare(config, run, directory, resume)
        result = _conduct(config, digest(run.settings.encode()), directory, log, resume, on_cycle)
        log.write("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        with atomic_path(directory.work / "twin.nc") as partial:
            dataset(result, attributes).to_netcdf(partial, engine="netcdf4", format="NETCDF4")
            seal_file(partial)
        write_text(directory.work / "summary.csv", summary_csv(result))
        if config.report:
            report_twin(directory)
        log.write("done")
        directory.publish()
    return result


def report_twin(directory: RunDirectory) -> Path:
    """Write the figures and the page of a finished twin experiment. Raises :class:`OutputError`."""
    from en4dvar.report.twin import write_twin_report

    directory.claim("report.html")
    before = directory.listing("figures")
    try:
        return write_twin_report(directory.work)
    finally:
        directory.claim_folder("figures", before)


def _prepare(config: TwinConfig, run: Identity, directory: RunDirectory, resume: bool) -> None:
    """Write what the run is, or check that it is the one to be resumed. Raises :class:`OutputError`."""
    directory.folder(FOLDER)
    earlier = read_checkpoint(directory.work / IDENTITY, "run", Identity) if resume else None
    if earlier is not None and (difference := run.difference(earlier, frozenset())):
        raise OutputError(
            f"{directory.path}: the run cannot be resumed to the same result, for this has changed:\n{difference}\n"
            "give --force to conduct the experiment again, or another --out"
        )
    directory.claim("run.log", "config.yaml", "config.resolved.yaml", "twin.nc", "summary.csv", IDENTITY, STATE)
    write_text(directory.work / "config.yaml", config.text)
    write_text(directory.work / "config.resolved.yaml", config.resolved)
    write_checkpoint(directory.work / IDENTITY, "run", run)


def _conduct(
    config: TwinConfig,
    fingerprint: str,
    directory: RunDirectory,
    log: RunLog,
    resume: bool,
    on_cycle: Callable[[int], None] | None,
) -> TwinResult:
    """The experiment, from its latest checkpoint on; what it ends with is kept, too, so that it is never repeated."""
    path, experiment = directory.work / STATE, config.experiment
    state = None
    if resume:
        try:
            state = read_checkpoint(path, fingerprint, SequentialState)
        except CheckpointError as error:
            log.write(f"warning: {error}; the experiment is conducted from the start")
    if state is not None:
        log.write(f"continued after {state.cycle} of {experiment.cycles} cycles")
    keeper = Keeper(path, fingerprint, config.execution.checkpoint_every)
    latest: list[Callable[[], SequentialState]] = []

    def keep(now: Callable[[], SequentialState]) -> None:
        latest[:] = [now]
        keeper.keep(now)

    with make_executor(experiment.model, config.execution.workers) as executor:
        result = conduct(experiment, config.seed, executor, on_cycle, state, keep)
    for last in latest:
        keeper.write(last())
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
