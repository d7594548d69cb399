"""The kind of run that estimates data sets: configuration → inverse problems → analyses → netCDF → page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from en4dvar.assembly.build import estimated_files
from en4dvar.config import Config, load_config, loaded
from en4dvar.diagnosis.analysis import Progress
from en4dvar.executor import Executor
from en4dvar.inputs.parts import DataFile
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.results.campaign_file import DamagedError, save_campaign
from en4dvar.results.pack import PACK
from en4dvar.results.together import GROUPS, group_folders
from en4dvar.runs.campaign import Campaign
from en4dvar.runs.checks import checked_problem, require_together
from en4dvar.runs.engine import FIGURES, REPORT, RunKind, Session, conduct_run
from en4dvar.runs.together import JointKind, PopulationKind, SetGroup, groups_of
from en4dvar.runs.worklist import ENDED, ITERATIONS, SUMMARY, Worklist, datasets

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
) -> "Result":
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
    config = loaded(config, load_config, overrides)
    count = len(estimated_files(config))
    if count != 1:
        raise ConfigError(f"data.path names {count} data sets; use run_campaign, or name one")
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
    """As :func:`run`, for any number of data sets, each estimated by itself; other arguments and errors are those of
    :func:`run`.

    A data set that cannot be read or loses its ensemble does not end the campaign: it is named with its reason in
    ``Campaign.failures``, in ``summary.csv`` and in the log. Where the configuration shares parameters, all that have a
    posterior are then estimated together (``joint.nc``), and with ``population:`` the population behind them
    (``population.nc``), or with its ``by:`` one of each group.

    ``report_workers``: processes that draw the report. They import the main script, which must guard what it does then.

    Raises :class:`ConfigError`, :class:`DataError` also where no data set can be used. One data set alone raises what
    it failed with; of several, that all failed is no error.
    """
    kind = EstimateKind(loaded(config, load_config, overrides), resume, progress, report_workers)
    return conduct_run(kind, force, resume, command)


@dataclass
class EstimateKind(RunKind[Campaign]):
    """A configuration whose data sets are estimated, each by itself, and then perhaps together."""

    name = "estimate"
    result = "posterior.nc"
    readers = ("report", "rerun", "compare", "export", "joint", "population")
    files = (
        result, PACK, ENDED, ITERATIONS, JointKind.result, PopulationKind.result, *JointKind.records,
        *PopulationKind.records, f"{GROUPS}/*/{PopulationKind.result}",
    )  # fmt: skip
    pages = (
        REPORT, SUMMARY, "what_if.csv", "ledger.csv", "varying.csv", "withheld.csv", *JointKind.pages,
        *PopulationKind.pages, *(f"{GROUPS}/*/{page}" for page in PopulationKind.pages), "differences.csv", "lines.csv",
        *FIGURES, "pages/*.html",
    )  # fmt: skip

    config: Config
    resume: bool = False
    progress: Progress | None = None
    report_workers: int = 1
    work: Worklist | None = field(default=None, init=False)

    @cached_property
    def data(self) -> Mapping[str, DataFile]:
        return estimated_files(self.config)

    def check(self) -> None:
        """Raise what is wrong with the data files where none can be used, one is in no group, or one counts twice."""
        config, files = self.config, self.data
        refused: list[ConfigError | DataError] = []
        for name, file in files.items():
            try:
                problem = checked_problem(config, name, file)
            except (ConfigError, DataError) as error:
                refused.append(error)
            else:
                require_together(config, problem, files)
                return
        if len(refused) == 1:
            raise refused[0]
        if faults := [fault for error in refused if isinstance(error, ConfigError) for fault in error.problems]:
            raise ConfigError(list(dict.fromkeys(faults)))
        raise DataError("\n".join(map(str, refused)))

    def kept(self) -> str:
        ended = self.work.ended if self.work else {}
        if self.resume and not ended:  # stopped, perhaps, before it was read what had been done
            return f"what {self.config.directory} holds is kept"
        return f"{len(ended)} of {len(self.data)} data sets are done and kept in {self.config.directory}"

    def opened(self, run: Session) -> frozenset[str]:
        self.work = Worklist(self.config, run, datasets(self.data), self.progress)
        return self.work.failed_earlier()

    def conduct(self, run: Session, executor: Executor) -> Campaign:
        work = self.work
        assert work is not None
        if run.directory.resumed:
            work.recall()
        _estimate(work, executor)
        if self.config.sharing.kinds:
            JointKind().within(work, executor)
        if asked := self.config.population:
            groups: Sequence[SetGroup | None] = groups_of(self.config, self.data) or [None]
            for group in groups:
                PopulationKind(asked.of).within(work, executor, group)
        if work.good() and self.config.report:
            self.page(run.directory.work, workers=self.report_workers, figures=self.config.figures)
        else:
            work.summarise()
        return work.campaign()

    @classmethod
    def page(cls, folder: Path, datasets: Sequence[str] = (), workers: int = 1, figures: bool = False) -> Path:
        from en4dvar.report import write_pages  # what draws pages is slow to import

        for kind in (JointKind, PopulationKind):
            if (folder / kind.result).exists():
                kind.page(folder)
        for of_group in group_folders(folder):
            PopulationKind.page(of_group)
        return write_pages(folder, datasets, workers, figures)


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
        try:
            path, sources = work.run.directory.at("posterior.nc"), {d.name: d.stem for d in good}
            save_campaign(path, work.pack, sources, work.run.attributes, work.failures())
            return
        except DamagedError as error:
            if not repeated.isdisjoint(error.names):
                raise
            repeated.update(error.names)
            work.estimate_again(error.names)
