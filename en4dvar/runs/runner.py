"""The straight line: configuration → inverse problems → analyses → netCDF → report. Resumable at any moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from en4dvar.analysis import Progress
from en4dvar.config import Config, load_config
from en4dvar.config.build import build_one, data_files, inverse_plan
from en4dvar.errors import ConfigError, DataError, Fault
from en4dvar.executor import Executor, choose_executor, one_blas_thread
from en4dvar.files import atomic_path
from en4dvar.inputs.asked import DataFile
from en4dvar.runs.campaign import Campaign
from en4dvar.runs.interrupt import terminate_as_interrupt
from en4dvar.runs.joint_run import join_within
from en4dvar.runs.population_run import population_within, require_population
from en4dvar.runs.rundir import RunDirectory
from en4dvar.runs.session import directory_mode, session
from en4dvar.runs.together import checkpoint_of
from en4dvar.runs.worklist import ITERATIONS, SUMMARY, Worklist, datasets
from en4dvar.storage.campaign_file import DamagedError, save_campaign
from en4dvar.storage.joint_file import FILE, load_joint
from en4dvar.storage.population_file import FILE as POPULATION
from en4dvar.storage.population_file import load_population
from en4dvar.summary import summary_rows
from en4dvar.tables import csv_text

if TYPE_CHECKING:
    from en4dvar.report.result import Result


def run(
    config: Config | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    command: str = "",
) -> Result:
    """Estimate the parameters of one data set and write the run directory.

    Parameters
    ----------
    config: a loaded configuration, the path of a YAML file, or a dict of what would be in it.
    overrides: of dotted keys, where ``config`` is not loaded yet; e.g. ``{"data.path": "/data/gel.csv"}``.
    force: replace the files of an earlier run in the same directory, once this run is complete.
    resume: continue an interrupted run in the same directory, to the same bits; where none has begun, begin.
    progress: called with the data set's name and the record of each iteration as it ends, in the calling thread; its
        ``members`` are empty where data sets are estimated side by side.
    command: what the user typed, for the file's history.

    Raises
    ------
    ConfigError, DataError, OutputError: before anything is computed; also where a changed run cannot be resumed.
    TooFewMembersError: the ensemble is lost. ExecutorError: the workers are gone. Interrupted: Ctrl-C or SIGTERM.
    """
    config = _loaded(config, overrides)
    found = len(data_files(inverse_plan(config)))
    if found != 1:
        raise ConfigError(f"data.path names {found} data sets; use run_campaign, or name one")
    (result,) = run_campaign(config, force=force, resume=resume, progress=progress, command=command)
    return result


def run_campaign(
    config: Config | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    command: str = "",
    report_workers: int = 1,
) -> Campaign:
    """As :func:`run`, for any number of data sets, each estimated by itself.

    A data set that cannot be read or loses its ensemble does not end the campaign: it is named with its reason in
    ``Campaign.failures``, in ``summary.csv`` and in the log. Where the configuration shares parameters, all that have a
    posterior are then estimated together (``joint.nc``), and with ``population:`` the population behind them
    (``population.nc``).

    ``report_workers``: processes that draw the report. They import the main script, which must guard what it does then.
    """
    config = _loaded(config, overrides)
    mode = directory_mode(force, resume)
    files = data_files(inverse_plan(config))
    ended: dict[str, str] = {}

    def kept() -> str:
        if resume and not ended:  # stopped, perhaps, before it was read what had been done
            return f"what {config.directory} holds is kept"
        return f"{len(ended)} of {len(files)} data sets are done and kept in {config.directory}"

    with (
        one_blas_thread(),
        terminate_as_interrupt(),
        RunDirectory.open(config.directory, mode) as directory,  # first: what follows may compile the model
    ):
        _require_one_usable(config, files)
        with _executor(config) as executor, session(config, files, directory, command, kept) as run:
            work = Worklist(config, run, datasets(files), progress, ended)
            try:
                _begin(work)
                _estimate(work, executor)
                if config.sharing:
                    join_within(work, executor)
                population_within(work, executor)
                _finish(work, report_workers)
            except BaseException:  # no worker writes once the directory is free for others
                work.stop.set()
                with suppress(KeyboardInterrupt):  # of an impatient user: on to the next step
                    executor.kill()
                raise
    return work.campaign()


def write_report(path: str | Path, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path:
    """Write (again) the report of a run from its netCDF; ``datasets`` of a campaign get a page in any case.

    ``workers``: processes that draw it. ``figures``: also keep those of ``datasets``, or of all pages, as PDF and PNG.

    Raises :class:`OutputError`.
    """
    from en4dvar.runs.cycles import report_cycles

    with RunDirectory.open(path, "report") as directory:
        return report_cycles(directory, figures) or _report(directory, datasets, workers, figures)


def _require_one_usable(config: Config, files: Mapping[str, DataFile]) -> None:
    """Raise what is wrong with the data files where none of them can be used, or one is in no group, before anything is
    written.
    """
    for name in files:
        config.sharing.of_dataset(name)  # before anything is computed
    faults: list[Fault] = []
    unusable: list[DataError] = []
    for name, file in files.items():
        try:
            require_population(config, build_one(config, name, file), len(files))
        except ConfigError as error:
            faults += error.problems
        except DataError as error:
            unusable.append(error)
        else:
            return
    if faults:
        raise ConfigError(list(dict.fromkeys(faults)))
    raise DataError("\n".join(map(str, unusable)))


def _executor(config: Config) -> Executor:
    asked = config.execution
    return choose_executor(config.model, asked.executor, asked.workers, asked.address, asked.limits)


def _begin(work: Worklist) -> None:
    """Write what the run is; of one that is resumed, take over what is done. What has failed is tried again."""
    run = work.run
    together = [FILE] * bool(work.config.sharing) + [POPULATION] * (work.config.population is not None)
    files = (*together, *map(checkpoint_of, together), ITERATIONS)
    run.begin("posterior.nc", work.record, *files, retried=work.failed_earlier())
    if run.resumed:
        work.recall()


def _estimate(work: Worklist, executor: Executor) -> None:
    """Every data set, and the campaign's file; a result that was damaged since it was written is estimated again, once.

    Raises what :meth:`Worklist.work` does; :class:`DamagedError` where that was of no use, as on a disk that fails.
    """
    repeated: set[str] = set()
    while True:
        work.work(executor)
        work.pack.flush()
        good = work.good()
        if work.alone or not good:
            return
        attributes = {**work.run.attributes, "identity": work.run.identity.settings}
        try:
            path, sources = work.run.directory.at("posterior.nc"), {d.name: d.stem for d in good}
            save_campaign(path, work.pack, sources, attributes, work.failures())
            return
        except DamagedError as error:
            if not repeated.isdisjoint(error.names):
                raise
            repeated.update(error.names)
            work.estimate_again(error.names)


def _finish(work: Worklist, report_workers: int) -> None:
    """The report, or the table alone, which is there already where there was nothing left to estimate."""
    directory = work.run.directory
    if work.good() and work.config.report:
        _report(directory, workers=report_workers, figures=work.config.figures)
    elif not (path := directory.claim(SUMMARY)).exists():
        header, *failures = summary_rows((), work.failures())
        with atomic_path(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
            file.write(csv_text([header]))
            file.writelines(work.outcomes(directory.work).lines())
            file.write(csv_text(failures))


def _report(directory: RunDirectory, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path:
    from en4dvar.report import JOINT_FILES, POPULATION_FILES, TABLES, write_pages  # what draws pages is slow to import

    directory.claim("report.html", SUMMARY, *TABLES)
    if (directory.work / FILE).exists():
        from en4dvar.report.joint import write_joint  # with matplotlib, whose import takes longer than a page

        directory.claim(*JOINT_FILES)
        write_joint(load_joint(directory.work / FILE), directory.work)
    if (directory.work / POPULATION).exists():
        from en4dvar.report.population import write_population

        directory.claim(*POPULATION_FILES)
        write_population(load_population(directory.work / POPULATION), directory.work)
    with directory.claiming("figures", "pages"):
        return write_pages(directory.work, datasets, workers, figures)


def _loaded(config: Config | str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None) -> Config:
    if not isinstance(config, Config):
        return load_config(config, overrides)
    if overrides:
        raise ConfigError("overrides apply to a file or dict; give them to load_config instead")
    return config
