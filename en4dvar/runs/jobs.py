"""One data set as a unit of work: what a worker gets, what it does, what it hands back."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

from en4dvar.assembly.build import build_one
from en4dvar.config import Config
from en4dvar.diagnosis.analysis import IterationRecord, Progress, Record
from en4dvar.estimation.assimilate import assimilate
from en4dvar.estimation.summary import brief, dataset_rows, remarks, summarise
from en4dvar.executor import Executor, SerialExecutor
from en4dvar.executor.base import CommonValue
from en4dvar.inputs.parts import DataFile
from en4dvar.plumbing.tables import csv_text
from en4dvar.priors.prior import own_seed
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import Keeper, digest, encode_text
from en4dvar.results.journal import Journal, KnownRuns
from en4dvar.results.netcdf import SealedBytes, to_bytes
from en4dvar.results.pack import packed
from en4dvar.results.store import build_groups
from en4dvar.runs.campaign import DatasetOutcome
from en4dvar.runs.progress import describe

SEND_EVERY = 0.1  # s; a worker sends the records of its iterations no more often, whatever data sets they are of
Told = tuple[str, Record, str]  # name of a data set, one of its records, and what the log says of it
Common = tuple[Config, Mapping[str, Any]]  # of the data sets of a run: its configuration, attributes of their files


@dataclass(frozen=True)
class Job:
    """The estimate of one data set; picklable, so that it can be done anywhere: what it has in common with the others
    is pickled once.

    ``source``: its data file; ``attributes``, beside the common ones, go into the file of its result. For the
    forward runs ``before``, ``keeper`` and ``stop`` see :class:`Journal`. ``alone``: the result is a file of its own,
    not one of a pack.
    """

    common: CommonValue[Common]
    name: str
    source: DataFile
    attributes: Mapping[str, Any] = field(default_factory=dict)
    before: KnownRuns = field(default_factory=KnownRuns)
    keeper: Keeper | None = None
    stop: threading.Event | None = None
    alone: bool = False

    @cached_property
    def problem(self) -> InverseProblem:
        """From the data file, read where this is asked for first: it goes with the job then.

        Raises what :func:`~en4dvar.assembly.build.build_one` does.
        """
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
    journal = Journal(executor or SerialExecutor(), job.before, job.keeper, job.stop)
    analysis = assimilate(job.problem, config.assimilation, seed, journal, journal.untold(progress))
    groups = build_groups(analysis, {**attributes, **job.attributes})
    content: SealedBytes | bytes = to_bytes(groups) if job.alone else packed(groups)
    sha256 = content.sha256 if isinstance(content, SealedBytes) else digest(content)
    summary = summarise(analysis)
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
    ending = f"{converged}: {analysis.stop_reason}; {analysis.forward_runs} forward runs"
    warnings = (f"{warning.severity}: {warning}" for warning in analysis.cautions)
    told = (f"estimate: {brief(summary)}", ending, *warnings)
    return Estimate(content, sha256, encode_text(outcome), told)


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
    return replace(outcome, records=tuple(sender.waiting))


class _Sender:
    """Sends records at once, or, where the last message is too young, with the next one that comes late enough."""

    _sent: ClassVar[float] = -math.inf  # when this process sent the last message, of any data set

    def __init__(self, tell: Callable[[tuple[Told, ...]], None]):
        self._tell = tell
        self.waiting: list[Told] = []

    def __call__(self, name: str, record: Record) -> None:
        line = describe(name, record)  # here, for the process that hears it serves all workers
        if isinstance(record, IterationRecord):
            record = replace(record, members=record.members[:0])
        self.waiting.append((name, record, line))
        if time.monotonic() >= self._sent + SEND_EVERY:
            self.send()

    def send(self) -> None:
        if self.waiting:
            self._tell(tuple(self.waiting))
            self.waiting.clear()
            _Sender._sent = time.monotonic()
