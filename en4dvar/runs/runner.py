"""The straight line: configuration → inverse problems → analyses → netCDF → report. Resumable at any moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from en4dvar.analysis import Progress
from en4dvar.config import Config, load_config
from en4dvar.config.build import build_one, data_files, inverse_plan
from en4dvar.errors import ConfigError, DataError, Fault, OutputError
from en4dvar.executor import ExecutorError, choose_executor, one_blas_thread
from en4dvar.files import write_text
from en4dvar.report import write_pages
from en4dvar.report.result import Result
from en4dvar.runs.campaign import Campaign
from en4dvar.runs.interrupt import Interrupted, tell_interrupt, terminate_as_interrupt
from en4dvar.runs.progress import RunLog
from en4dvar.runs.rundir import Mode, RunDirectory
from en4dvar.runs.worklist import Dataset, Done, Worklist, datasets
from en4dvar.storage.campaign_file import save_campaign
from en4dvar.storage.checkpoint import FOLDER, CheckpointError, read_checkpoint, write_checkpoint
from en4dvar.storage.fingerprint import Identity, identity
from en4dvar.storage.provenance import provenance
from en4dvar.summary import summary_csv

IDENTITY = f"{FOLDER}/run"


def run(
    config: Config | str | Path,
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
    config: a loaded configuration, or the path of a YAML file.
    overrides: of dotted keys, when ``config`` is a path; e.g. ``{"data.path": "/data/gel.csv"}``.
    force: replace the files of an earlier run in the same directory, once this run is complete.
    resume: continue an interrupted run in the same directory, to the same bits.
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
    (result,) = execute(config, force=force, resume=resume, progress=progress, command=command)
    return result


def run_campaign(
    config: Config | str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    command: str = "",
) -> Campaign:
    """As :func:`run`, for any number of data sets, each estimated by itself.

    A data set that cannot be read or loses its ensemble does not end the campaign: it is named with its reason in
    ``Campaign.failures``, in ``summary.csv`` and in the log.
    """
    config = _loaded(config, overrides)
    return execute(config, force=force, resume=resume, progress=progress, command=command)


def execute(
    config: Config,
    *,
    force: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    command: str = "",
    report_workers: int = 1,
) -> Campaign:
    """Assimilate the data sets of ``config`` and write its run directory; arguments and errors as in :func:`run`.

    ``report_workers``: processes that draw the report. They import the main script, which must guard what it does then.
    """
    if force and resume:
        raise ConfigError("force replaces a run, resume continues it; give one of them")
    files = data_files(inverse_plan(config))
    _require_one_usable(config, files)
    execution = config.execution
    mode: Mode = "force" if force else "resume" if resume else "new"
    ended: Mapping[str, Done] = {}
    with (
        one_blas_thread(),
        terminate_as_interrupt(),
        choose_executor(
            config.model, execution.executor, execution.workers, execution.address, execution.limits
        ) as executor,
        RunDirectory.open(config.directory, mode) as directory,
        tell_interrupt(lambda: _kept(directory, ended, len(files), resume)),
    ):
        who = identity(config.resolved, config.model, files)
        attributes = {
            **provenance(config.text, config.document.file, command),
            "configuration_resolved": config.resolved,
            "identity": who.settings,
        }
        with RunLog(directory.work / "run.log", append=resume) as log:
            log.write(attributes["history"])
            work = Worklist(config, who, datasets(files), directory, log, attributes, progress)
            ended, prepared = work.ended, False
            try:
                _prepare(work, resume)
                prepared = True
                work.work(executor)
                _finish(work, report_workers)
                log.write("done")
            except (KeyboardInterrupt, ExecutorError, OutputError) as error:
                if isinstance(error, OutputError) and not prepared:
                    raise
                work.stop.set()
                with suppress(KeyboardInterrupt):  # of an impatient user: on to the next step
                    executor.kill()
                raise _interrupted(error, directory, _kept(directory, ended, len(files), resume)) from error
        directory.publish()
        return Campaign(directory.path, work.outcomes(), tuple(work.notices))


def write_report(path: str | Path, datasets: Sequence[str] = (), workers: int = 1) -> Path:
    """Write (again) the report of a run from its netCDF; ``datasets`` of a campaign get a page in any case.

    ``workers``: processes that draw it.

    Raises :class:`OutputError`.
    """
    with RunDirectory.open(path, "report") as directory:
        if (directory.work / "twin.nc").exists():
            from en4dvar.runs.twin_run import report_twin

            return report_twin(directory)
        return _report(directory, datasets, workers)


def _require_one_usable(config: Config, files: Mapping[str, Path]) -> None:
    """Raise what is wrong with the data files where none of them can be used, before anything is written."""
    faults: list[Fault] = []
    unusable: list[DataError] = []
    for name, path in files.items():
        try:
            build_one(config, name, path)
        except ConfigError as error:
            faults += error.problems
        except DataError as error:
            unusable.append(error)
        else:
            return
    if faults:
        raise ConfigError(list(dict.fromkeys(faults)))
    raise DataError("\n".join(map(str, unusable)))


def _prepare(work: Worklist, resume: bool) -> None:
    """Write what the run is, or check that it is the one to be resumed."""
    directory, config = work.directory, work.config
    for folder in (FOLDER, *(["datasets"] if len(work.sets) > 1 else [])):
        directory.folder(folder)
    earlier = read_checkpoint(directory.work / IDENTITY, "run", Identity) if resume else None
    if earlier is not None:
        failed = {d.name: d for d in work.sets if _has_failed(work, d, earlier)}
        difference = work.identity.difference(earlier, frozenset(failed))
        if difference:
            raise OutputError(
                f"{directory.path}: the run cannot be resumed to the same result, for this has changed:\n{difference}\n"
                "give --force to estimate everything again, or another --out"
            )
        for d in failed.values():  # tried again, on what the data file holds now
            directory.remove(d.done)
    directory.claim(
        "run.log", "config.yaml", "config.resolved.yaml", "posterior.nc", IDENTITY,
        *(name for d in work.sets for name in (d.file, d.iteration, d.done)),
    )  # fmt: skip
    write_text(directory.work / "config.yaml", config.text)
    write_text(directory.work / "config.resolved.yaml", config.resolved)
    write_checkpoint(directory.work / IDENTITY, "run", work.identity)
    if earlier is not None:
        work.recall()
        work.log.write(f"resumed: {len(work.ended)} of {len(work.sets)} data sets are done")


def _kept(directory: RunDirectory, ended: Mapping[str, Done], n_sets: int, resume: bool) -> str:
    """What the user has of a run that was stopped."""
    if resume and not ended:  # stopped, perhaps, before it was read what had been done
        return f"what {directory.path} holds is kept"
    return f"{len(ended)} of {n_sets} data sets are done and kept in {directory.path}"


def _interrupted(error: BaseException, directory: RunDirectory, kept: str) -> BaseException:
    """The error as the user should see it: with what was kept, and what to do."""
    if gone := not directory.work.is_dir():
        kept = f"the run directory {directory.path} was removed or renamed while the run was at work"
    if isinstance(error, KeyboardInterrupt):
        return Interrupted(f"interrupted; {kept}")
    advice = "" if gone else "; give --resume to continue"
    kind = ExecutorError if isinstance(error, ExecutorError) else OutputError
    return kind(f"{error}; {kept}{advice}")


def _has_failed(work: Worklist, d: Dataset, earlier: Identity) -> bool:
    if d.name not in earlier.content:
        return False
    try:
        record = read_checkpoint(work.directory.work / d.done, earlier.of_dataset(d.name), Done)
    except CheckpointError:
        return False
    return record is not None and bool(record.failure)


def _finish(work: Worklist, report_workers: int) -> None:
    """The campaign's file and the report."""
    directory = work.directory
    good = {d.name: directory.work / d.file for d in work.sets if not work.ended[d.name].failure}
    failures = {name: record.failure for name, record in work.ended.items() if record.failure}
    if good and len(work.sets) > 1:
        longest = max(work.ended[name].n_observations for name in good)
        save_campaign(directory.work / "posterior.nc", good, longest, work.attributes, failures)
    if good and work.config.report:
        _report(directory, workers=report_workers)
    else:
        write_text(
            directory.claim("summary.csv"),
            summary_csv(((name, work.ended[name].summary, work.ended[name].warnings) for name in good), failures),
        )


def _report(directory: RunDirectory, datasets: Sequence[str] = (), workers: int = 1) -> Path:
    directory.claim("report.html", "summary.csv")
    before = {folder: directory.listing(folder) for folder in ("figures", "pages")}
    try:
        return write_pages(directory.work, datasets, workers)
    finally:
        for folder, files in before.items():
            directory.claim_folder(folder, files)


def _loaded(config: Config | str | Path, overrides: Mapping[str, Any] | None) -> Config:
    if not isinstance(config, Config):
        return load_config(config, overrides)
    if overrides:
        raise ConfigError("overrides apply to a file; give them to load_config instead")
    return config
