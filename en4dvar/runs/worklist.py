"""The data sets of a run: which are done, what is left to do, and what came of it."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from en4dvar.analysis import ChainRecord, Progress, Record, StartRecord
from en4dvar.assimilate import LoopState
from en4dvar.caution import Caution
from en4dvar.config import Config
from en4dvar.config.build import build_one
from en4dvar.errors import En4dvarError, OutputError
from en4dvar.executor import Executor, ExecutorError, ThreadsExecutor
from en4dvar.files import readable, write_bytes
from en4dvar.runs.campaign import DatasetOutcome, file_names
from en4dvar.runs.jobs import Estimate, Job, News, estimate, estimate_and_tell
from en4dvar.runs.progress import LiveProgress, RunLog, describe
from en4dvar.runs.rundir import RunDirectory
from en4dvar.storage.checkpoint import FOLDER, CheckpointError, digest, file_digest, read_checkpoint, write_checkpoint
from en4dvar.storage.fingerprint import Identity
from en4dvar.summary import ParameterSummary


@dataclass(frozen=True)
class Dataset:
    """A data set of the run: its data file, and where its results go, relative to the run directory."""

    name: str
    source: Path
    file: str
    iteration: str
    done: str


@dataclass(frozen=True)
class Done:
    """How a data set ended: SHA-256 of its netCDF file, or the reason of its failure."""

    sha256: str
    failure: str = ""
    exit_code: int = 0
    warnings: tuple[Caution, ...] = ()
    n_observations: int = 0
    summary: tuple[ParameterSummary, ...] = ()


def datasets(files: Mapping[str, Path]) -> tuple[Dataset, ...]:
    """Where the results of each data set go: ``posterior.nc`` for a single one, else ``datasets/*.nc``."""
    stems = file_names(files)
    return tuple(
        Dataset(
            name,
            path,
            f"datasets/{stems[name]}.nc" if len(files) > 1 else "posterior.nc",
            f"{FOLDER}/{stems[name]}.iteration",
            f"{FOLDER}/{stems[name]}.done",
        )
        for name, path in files.items()
    )


@dataclass
class Worklist:
    """Estimates what is left to do and keeps each data set's file and record as it ends."""

    config: Config
    identity: Identity
    sets: tuple[Dataset, ...]
    directory: RunDirectory
    log: RunLog
    attributes: Mapping[str, Any]
    progress: Progress | None = None
    notices: list[str] = field(default_factory=list)
    ended: dict[str, Done] = field(default_factory=dict)
    stop: threading.Event = field(default_factory=threading.Event)
    told: dict[str, tuple[int, int]] = field(default_factory=dict)  # data set at work → its last round, iteration

    def outcomes(self) -> tuple[DatasetOutcome, ...]:
        """What came of each data set, in order."""
        return tuple(
            DatasetOutcome(
                d.name,
                None if r.failure else self.directory.path / d.file,
                r.failure,
                r.exit_code,
                r.warnings,
                r.summary,
            )
            for d in self.sets
            if (r := self.ended.get(d.name)) is not None
        )

    def recall(self) -> None:
        """Take over what an earlier run finished; what cannot be trusted is estimated again."""
        for d in self.sets:
            try:
                record = read_checkpoint(self.directory.work / d.done, self.identity.of_dataset(d.name), Done)
            except CheckpointError as error:
                self.notice(f"{error}; {d.name} is estimated again")
                continue
            if record is None:
                continue
            if file_digest(self.directory.work / d.file) == record.sha256:
                self.ended[d.name] = record
                self.directory.remove(d.iteration)  # of a run killed between its last two steps
            else:
                self.notice(f"{self.directory.path / d.file}: missing or changed since it was written; estimated again")

    def notice(self, message: str) -> None:
        """Something about the run itself that the user should know."""
        self.notices.append(message)
        self.log.write(f"warning: {message}")

    def work(self, executor: Executor) -> None:
        """Estimate every data set that is not done yet.

        Many data sets are spread over the workers, one each; of few, the members are.

        Raises
        ------
        OutputError: results cannot be written. ExecutorError: the workers are gone. Where the run has one data set
        only, also what its estimate raises.
        """
        if isinstance(self.progress, LiveProgress):
            self.progress.begin(len(self.ended))
        todo = [d for d in self.sets if d.name not in self.ended]
        side_by_side = len(todo) > 1 and len(todo) >= executor.workers > 1
        for d, value in self._side_by_side(todo, executor) if side_by_side else self._in_turn(todo, executor):
            if isinstance(value, OutputError | ExecutorError):
                raise value
            if isinstance(value, Exception):
                self._failed(d, value)
            else:
                self._keep(d, value)

    def _in_turn(self, todo: list[Dataset], executor: Executor) -> Iterator[tuple[Dataset, Estimate | Exception]]:
        for d in todo:
            try:
                value: Estimate | Exception = estimate(self._job(d), executor, self._tell)
            except Exception as error:
                value = error
            yield d, value

    def _side_by_side(self, todo: list[Dataset], executor: Executor) -> Iterator[tuple[Dataset, Estimate | Exception]]:
        sent: list[Dataset] = []
        unusable: list[tuple[Dataset, Exception]] = []
        stop = self.stop if isinstance(executor, ThreadsExecutor) else None

        def jobs() -> Iterator[tuple[Any, ...]]:
            for d in todo:
                try:
                    job = self._job(d, stop)
                except Exception as error:
                    unusable.append((d, error))
                    continue
                sent.append(d)
                yield (job,)

        def hear(_: int, news: News) -> None:
            for name, record in news:
                self._tell(name, record)

        for i, value in executor.map(estimate_and_tell, jobs(), hear):
            yield sent[i], value
        yield from unusable

    def _job(self, d: Dataset, stop: threading.Event | None = None) -> Job:
        fingerprint = self.identity.of_dataset(d.name)
        path = (self.directory.work / d.iteration).absolute()
        resume = None
        try:
            resume = read_checkpoint(path, fingerprint, LoopState)
        except CheckpointError as error:
            self.notice(f"{error}; {d.name} is estimated from the start")
        if resume is not None:
            self.log.write(f"{d.name}: continued {resume.reached}")
        return Job(
            problem=build_one(self.config, d.name, d.source),
            settings=self.config.assimilation,
            seed=self.config.seed,
            attributes={**self.attributes, "data_sha256": self.identity.content[d.name]},
            fingerprint=fingerprint,
            checkpoint=path,
            checkpoint_every=self.config.execution.checkpoint_every,
            resume=resume,
            stop=stop,
        )

    def _tell(self, name: str, record: Record) -> None:
        if not isinstance(record, ChainRecord):
            place = (0, record.rounds) if isinstance(record, StartRecord) else (1, record.iteration)
            if place <= self.told.get(name, (0, 0)):
                self.log.write(f"{name}: its worker was lost; another one repeats it")
            self.told[name] = place
        self.log.write(describe(name, record))
        if self.progress is not None:
            self.progress(name, record)

    def _keep(self, d: Dataset, value: Estimate) -> None:
        self.log.write(f"{d.name}: {value.ending}")
        self.log.write("\n".join(f"{d.name}: {warning.severity}: {warning}" for warning in value.warnings))
        write_bytes(self.directory.work / d.file, value.content)
        record = Done(
            digest(value.content),
            warnings=value.warnings,
            n_observations=value.n_observations,
            summary=value.summary,
        )
        self._end(d, record)

    def _failed(self, d: Dataset, error: Exception) -> None:
        known = isinstance(error, En4dvarError)
        reason = readable(error if known else f"{type(error).__name__}: {error}")
        self.log.write(f"{d.name}: failed: {reason}")
        if not known:
            self.log.write("".join(traceback.format_exception(error)))
        if len(self.sets) == 1:
            raise error
        self._end(d, Done("", reason, error.exit_code if isinstance(error, En4dvarError) else 1))

    def _end(self, d: Dataset, record: Done) -> None:
        write_checkpoint(self.directory.work / d.done, self.identity.of_dataset(d.name), record)
        self.directory.remove(d.iteration)
        self.ended[d.name] = record
        self.told.pop(d.name, None)
        if isinstance(self.progress, LiveProgress):
            self.progress.ended(d.name, len(self.ended))
