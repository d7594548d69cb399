"""The data sets of a run: which are done, what is left to do, what came of it; and each of them as a unit of work: what
a worker gets, what it does, what it hands back.
"""

import math
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

from en4dvar.assembly.build import build_one
from en4dvar.config import Config
from en4dvar.data.observations import SEVERAL
from en4dvar.diagnosis.analysis import IterationRecord, Progress, Record, StartRecord
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.summary import brief, dataset_rows, remarks, summary_rows
from en4dvar.executor import Executor, ExecutorError, SerialExecutor
from en4dvar.executor.base import CommonValue
from en4dvar.inputs.parts import DataFile
from en4dvar.plumbing.errors import En4dvarError, OutputError
from en4dvar.plumbing.files import atomic_path, open_plain, path_from, readable, remove_file
from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.tables import csv_text
from en4dvar.priors.prior import own_seed
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import FOLDER, Journal, Keeper, KnownRuns, decode, digest, encode, file_digest
from en4dvar.results.netcdf import SealedBytes, to_bytes
from en4dvar.results.pack import PACK, Entry, Pack, file_names, packed, read_outcome
from en4dvar.results.store import StoredResult
from en4dvar.runs.campaign import Campaign, DatasetOutcome, Outcomes
from en4dvar.runs.engine import Session
from en4dvar.runs.progress import LiveProgress, describe, intervals

SUMMARY = "summary.csv"
ENDED = f"{FOLDER}/ended"  # how a single data set ended
ITERATIONS = f"{FOLDER}/*.iteration"  # checkpoints of data sets at work
SEND_EVERY = 0.1  # s; a worker sends the records of its iterations no more often, whatever data sets they are of
Told = tuple[str, Record, str]  # name of a data set, one of its records, and what the log says of it
Common = tuple[Config, Mapping[str, Any]]  # of the data sets of a run: its configuration, attributes of their files


@dataclass(frozen=True)
class Job:
    """The estimate of one data set; picklable, so that it can be done anywhere: what it has in common with the others
    is pickled once.

    ``source``: its data file; ``attributes``, beside the common ones, go into the file of its result. For the
    forward runs ``before`` and their ``keeper`` see :class:`Journal`. ``alone``: the result is a file of its own,
    not one of a pack.
    """

    common: CommonValue[Common]
    name: str
    source: DataFile
    attributes: Mapping[str, Any] = field(default_factory=dict)
    before: KnownRuns = field(default_factory=KnownRuns)
    keeper: Keeper | None = None
    alone: bool = False

    @cached_property
    def problem(self) -> InverseProblem:
        """From the data file, read where this is first asked for: it goes with the job. Raises as :func:`build_one`."""
        return build_one(self.common.value[0], self.name, self.source)


@dataclass(frozen=True)
class Estimate:
    """``content`` is the netCDF file, or what goes into a pack, with its ``digest``; ``outcome`` is the record of a
    :class:`~en4dvar.runs.campaign.DatasetOutcome`; ``told`` are lines of the log. ``records`` have not been told yet.
    """

    content: SealedBytes | bytes
    digest: str
    outcome: bytes
    told: tuple[str, ...]
    records: tuple[Told, ...] = ()


def estimate(job: Job, executor: Executor | None = None, progress: Progress | None = None) -> Estimate:
    """Assimilate one data set; members run on ``executor``, by default in this process.

    Raises ConfigError, DataError: the data file cannot be used. TooFewMembersError: the ensemble is lost. OutputError:
    a checkpoint cannot be written.
    """
    config, attributes = job.common.value
    seed = own_seed(config.seed, job.name)
    journal = Journal(executor or SerialExecutor(), job.before, job.keeper)
    analysis = assimilate(job.problem, config.assimilation, seed, journal, journal.untold(progress))
    result = StoredResult.from_analysis(analysis, {**attributes, **job.attributes})
    content: SealedBytes | bytes = to_bytes(result.groups) if job.alone else packed(result.groups)
    sha256 = content.sha256 if isinstance(content, SealedBytes) else digest(content)
    summary = result.rows
    outcome = DatasetOutcome(
        analysis.name,
        warnings=analysis.cautions,
        summary=summary,
        n_observations=len(analysis.observations),
        sha256=sha256,
        remarks=remarks(analysis),
        lines=csv_text(dataset_rows(analysis.name, summary, analysis.cautions)),
    )
    converged = "converged" if analysis.converged else "not converged"
    ending = f"{converged}: {analysis.stop_reason}; {counted(analysis.forward_runs, 'forward run')}"
    warnings = (f"{warning.severity}: {warning}" for warning in analysis.cautions)
    told = (f"estimate: {brief(summary) or '; '.join(outcome.remarks)}", ending, *warnings)
    return Estimate(content, sha256, encode(outcome), told)


def estimate_and_tell(job: Job, tell: Callable[[tuple[Told, ...]], None]) -> Estimate:
    """As :func:`estimate`, on a worker: ``tell`` gets the records, without their members, as iterations end; the last
    ones come with the estimate.
    """
    sender = _Sender(tell)
    try:
        outcome = estimate(job, None, sender)
    except BaseException:
        sender.send()
        raise
    return replace(outcome, records=sender.rest())


class _Sender:
    """Sends records at once, or, where the last message is too young, as soon as it is old enough."""

    _sent: ClassVar[float] = -math.inf  # when this process sent the last message, of any data set

    def __init__(self, tell: Callable[[tuple[Told, ...]], None]):
        self._tell, self._lock = tell, threading.RLock()
        self._waiting: list[Told] = []

    def __call__(self, name: str, record: Record) -> None:
        line = describe(name, record)  # here, for the process that hears it serves all workers
        if isinstance(record, IterationRecord):
            record = replace(record, members=record.members[:0])
        with self._lock:
            self._waiting.append((name, record, line))
            rest = self._sent + SEND_EVERY - time.monotonic()
            if rest <= 0:
                self.send()
            elif len(self._waiting) == 1:  # others go with it
                timer = threading.Timer(rest, self._later)
                timer.daemon = True
                timer.start()

    def rest(self) -> tuple[Told, ...]:
        """What waits and is not sent any more."""
        with self._lock:
            records, self._waiting = tuple(self._waiting), []
            return records

    def send(self) -> None:
        with self._lock:
            if records := self.rest():
                self._tell(records)
                _Sender._sent = time.monotonic()

    def _later(self) -> None:
        with suppress(OSError):  # nobody is there to hear it: the call's own thread will notice
            self.send()


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set: its file, its name in a pack, where its results go in the run: an address in a pack, or a file."""

    name: str
    source: DataFile
    stem: str
    file: str

    @property
    def iteration(self) -> str:
        """The checkpoint of its iterations, relative to the run directory."""
        return ITERATIONS.replace("*", self.stem)


def datasets(files: Mapping[str, DataFile]) -> tuple[Dataset, ...]:
    """Where the results of each data set go: ``posterior.nc`` for a single one, else ``datasets.pack``."""
    stems = file_names(files)
    return tuple(
        Dataset(name, file, stems[name], f"{PACK}/{stems[name]}" if len(files) > 1 else "posterior.nc")
        for name, file in files.items()
    )


class Worklist:
    """Estimates what is left to do and keeps each data set's file and record as it ends.

    ``ended`` fills with what is done: name → how it failed, None where there is a posterior; everything else that is
    known of a data set stays on disk.
    """

    def __init__(self, config: Config, run: Session, sets: tuple[Dataset, ...], progress: Progress | None):
        self.config, self.run, self.sets, self.progress = config, run, sets, progress
        self.ended: dict[str, DatasetOutcome | None] = {}
        self.alone = len(sets) == 1
        self.pack = Pack(run.directory.at(self.record))
        self.common: CommonValue[Common] = CommonValue((config, run.attributes))
        self._reached: dict[str, tuple[int, int]] = {}  # data set at work → its last round, iteration

    def good(self) -> list[Dataset]:
        """The data sets that have a posterior."""
        return [d for d in self.sets if self.ended[d.name] is None]

    def failures(self) -> dict[str, str]:
        """Why a data set has no posterior, of those that have none."""
        return {name: failed.failure for name, failed in self.ended.items() if failed}

    def outcomes(self, folder: Path) -> Outcomes:
        """What came of each data set, in order; ``folder`` is where the files of the run are."""
        files = {d.stem: d.file for d in self.sets if d.name in self.ended}
        return Outcomes(folder, self.record, self.pack.entries, files)

    def campaign(self) -> Campaign:
        """What the run leaves behind. What has failed did so in this process, for a resumed run tries it again."""
        outcomes, failed = self.outcomes(self.run.directory.home), (self.ended.get(d.name) for d in self.sets)
        return Campaign(self.config.directory, outcomes, tuple(self.run.notices), tuple(filter(None, failed)))

    def summarise(self) -> None:
        """Write the table of all data sets, unless it is there as it should be. Raises :class:`OutputError`."""
        path = self.run.directory.at(SUMMARY)
        if not _consists_of(path, self._table()):
            with atomic_path(path) as partial, partial.open("wb") as file:
                file.writelines(self._table())

    def _table(self) -> Iterator[bytes]:
        header, *failures = summary_rows((), self.failures())
        yield csv_text([header]).encode()
        yield from map(str.encode, self.outcomes(self.run.directory.work).lines())
        yield csv_text(failures).encode()

    @property
    def record(self) -> str:
        """The file that records how data sets ended."""
        return ENDED if self.alone else PACK

    def failed_earlier(self) -> frozenset[str]:
        """The data sets that have failed in the run that is resumed."""
        if (earlier := self.run.earlier()) is None:
            return frozenset()
        entries = ((d.name, self.pack.entries.get(d.stem)) for d in self.sets if d.name in earlier.content)
        return frozenset(
            name
            for name, entry in entries
            if entry and entry.fingerprint == earlier.of_dataset(name) and self._failed(entry)
        )

    def recall(self) -> None:
        """Take over what an earlier run finished, by its checksums; what failed or cannot be trusted is done again."""
        finished = not self.alone and self.run.directory.at("posterior.nc").exists()
        for d in self.sets:
            entry = self.pack.entries.get(d.stem)
            if entry is None and finished:
                self.estimate_again([d.name])
            if entry is None or self._failed(entry):
                continue
            try:
                if entry.fingerprint != self._fingerprint(d):
                    raise OutputError(f"{self.pack.path / d.stem}: belongs to another run")
                read_outcome(self.pack.path, d.stem, entry)
                if not self.alone:
                    self.pack.content(d.stem)
            except OutputError as error:
                self.run.notice(f"{error}; {d.name} is estimated again")
                continue
            if self.alone and file_digest(self.run.directory.at(d.file)) != entry.content_digest:
                self.estimate_again([d.name])
                continue
            self.ended[d.name] = None
            remove_file(self._checkpoint(d))  # of a run killed between its last two steps
        self.run.log(f"resumed: {len(self.ended)} of {len(self.sets)} data sets are done")

    def estimate_again(self, names: Sequence[str]) -> None:
        """Forget that data sets are done, whose results cannot be read."""
        for d in self.sets:
            if d.name in names:
                self.ended.pop(d.name, None)
                path = self.run.directory.path / d.file
                self.run.notice(f"{path}: missing or changed since it was written; estimated again")

    def _failed(self, entry: Entry) -> bool:
        return not self.alone and not entry.content_size

    def work(self, executor: Executor) -> None:
        """Estimate every data set that is not done yet.

        Many data sets are spread over the workers, one each; of few, the members are.

        Raises :class:`OutputError`: results cannot be written. :class:`ExecutorError`: the workers are gone. Where the
        run has one data set only, also what its estimate raises.
        """
        if isinstance(self.progress, LiveProgress):
            self.progress.begin(len(self.ended), len(self.sets))
        todo = [d for d in self.sets if d.name not in self.ended]
        if todo:
            self.run.directory.remove(SUMMARY)  # of what was done before: where it is there, it is of every data set
        sent: list[Dataset] = []

        def jobs(reads: bool = False) -> Iterator[tuple[Job]]:
            for d in todo:
                try:
                    job = self._job(d)
                    if not reads:
                        _ = job.problem  # its file is read here
                except Exception as error:
                    self._fail(d, error)
                else:
                    sent.append(d)
                    yield (job,)

        if len(todo) > 1 and len(todo) >= executor.workers > 1:
            ends = executor.map(estimate_and_tell, jobs(executor.reads), lambda _, records: self._tell(records))
        else:
            alone = SerialExecutor()
            ends = alone.map(lambda job: estimate(job, executor, partial(self._hear_one, job.problem)), jobs())
        for i, value in ends:
            if isinstance(value, Exception):
                self._fail(sent[i], value)
            else:
                self._keep(sent[i], value)

    def _fingerprint(self, d: Dataset) -> str:
        return self.run.identity.of_dataset(d.name)

    def _job(self, d: Dataset) -> Job:
        fingerprint, path = self._fingerprint(d), self._checkpoint(d)
        again = f"{d.name} is estimated from the start"
        before = self.run.restore(d.iteration, fingerprint, KnownRuns, again) or KnownRuns()
        if before.forecasts:
            self.run.log(f"{d.name}: continued after {counted(sum(map(len, before.forecasts)), 'forward run')}")
        keeper = Keeper(path, fingerprint, self.config.execution.checkpoint_every)
        folder = Path(self.config.document.file).parent  # from which the configuration names the data; pages are shared
        source = readable(SEVERAL.join(path_from(folder, str(path)) for path in d.source.paths))
        own = {"data_sha256": self.run.identity.content[d.name], "data_source": source}
        return Job(self.common, d.name, d.source, own, before, keeper, self.alone)

    def _checkpoint(self, d: Dataset) -> Path:
        """Where its iterations are kept: in a folder that was looked at as the run began, where files are replaced or
        removed, never written in place. To look at each for a link is a tenth of what a data set costs this process.
        """
        return self.run.directory.work / d.iteration

    def _hear_one(self, problem: InverseProblem, name: str, record: Record) -> None:
        self._tell([(name, record, describe(name, record) + intervals(name, record, problem.prior.parameters))])

    def _tell(self, records: Sequence[Told], *lines: str) -> None:
        """Records, and further lines of the log: all of them at once, for each time it is written to takes as long."""
        self.run.log("\n".join([*(line for told in records for line in self._lines(*told)), *lines]))
        if self.progress is not None:
            for name, record, _ in records:
                self.progress(name, record)

    def _lines(self, name: str, record: Record, line: str) -> Iterator[str]:
        """What the log says of a record, which is its ``line`` unless it is told once more."""
        if isinstance(record, StartRecord | IterationRecord):
            reached = self._reached.get(name, (0, 0))
            place = (
                (2 * record.further, record.rounds)
                if isinstance(record, StartRecord)
                else (reached[0] | 1, record.iteration)
            )
            if place <= reached:
                yield f"{name}: its worker was lost; another one repeats it"
            self._reached[name] = place
        yield line

    def _keep(self, d: Dataset, value: Estimate) -> None:
        self._tell(value.records, *(f"{d.name}: {line}" for line in value.told))
        content = value.content
        if isinstance(content, SealedBytes):  # a file of its own
            content.write(self.run.directory.at(d.file))
            content = b""
        self._end(d, None, value.outcome, content, value.digest)

    def _fail(self, d: Dataset, error: Exception) -> None:
        if isinstance(error, OutputError | ExecutorError):
            raise error
        known = isinstance(error, En4dvarError)
        reason = readable(error if known else f"{type(error).__name__}: {error}")
        self.run.log(f"{d.name}: failed: {reason}")
        if not known:
            self.run.log("".join(traceback.format_exception(error)))
        if self.alone:
            raise error
        exit_code = error.exit_code if isinstance(error, En4dvarError) else 1
        failed = DatasetOutcome(d.name, failure=reason, exit_code=exit_code)
        self._end(d, failed, encode(failed))

    def _end(
        self, d: Dataset, failed: DatasetOutcome | None, outcome: bytes, content: bytes = b"", content_digest: str = ""
    ) -> None:
        self.pack.append(d.stem, self._fingerprint(d), outcome, content, content_digest)
        remove_file(self._checkpoint(d))
        self.ended[d.name] = failed
        self._reached.pop(d.name, None)
        if isinstance(self.progress, LiveProgress):
            self.progress.ended(d.name, len(self.ended), _in_one_line(decode(outcome, DatasetOutcome)))


def _consists_of(path: Path, parts: Iterable[bytes]) -> bool:
    """Whether a file is there and holds these parts, one after the other, and nothing else."""
    try:
        with open_plain(path) as file:
            return all(file.read(len(part)) == part for part in parts) and not file.read(1)
    except OSError:
        return False


def _in_one_line(outcome: DatasetOutcome) -> str:
    if outcome.failure:
        return f"failed: {outcome.failure.splitlines()[0]}"
    doubts = [c.code for c in outcome.warnings if c.kind == "warning"]
    return brief(outcome.summary) + (f"; {', '.join(dict.fromkeys(doubts))}" if doubts else "")
