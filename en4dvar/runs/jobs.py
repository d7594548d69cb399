"""One data set as a unit of work: what a worker gets, what it does, what it hands back."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from en4dvar.analysis import IterationRecord, Progress, Record
from en4dvar.assimilate import LoopState, assimilate
from en4dvar.caution import Caution
from en4dvar.executor import Executor
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.storage.checkpoint import Keeper
from en4dvar.storage.groups import build_groups
from en4dvar.storage.netcdf import to_bytes
from en4dvar.summary import ParameterSummary, summarise

TELL_EVERY = 0.1  # s; a worker sends no more often what its iterations have to tell
News = tuple[tuple[str, Record], ...]


@dataclass(frozen=True)
class Job:
    """Everything that the estimate of one data set needs; picklable, so that it can be made anywhere.

    ``attributes`` go into the file. ``checkpoint`` is where the state of the iterations is kept, at most every
    ``checkpoint_every`` seconds; a worker that does not see that folder keeps none. ``resume`` is where to start.
    ``stop`` gives the job up after the iteration under way (within one process only).
    """

    problem: InverseProblem
    settings: AssimilationSettings
    seed: int
    attributes: Mapping[str, Any]
    fingerprint: str = ""
    checkpoint: Path | None = None
    checkpoint_every: float = 0.0
    resume: LoopState | None = None
    stop: threading.Event | None = None


@dataclass(frozen=True)
class Estimate:
    """``content`` is the netCDF file; ``ending`` how the iterations ended."""

    content: bytes
    ending: str
    summary: tuple[ParameterSummary, ...]
    warnings: tuple[Caution, ...]
    n_observations: int


class StoppedError(Exception):
    """The job was given up."""


def estimate(job: Job, executor: Executor | None = None, progress: Progress | None = None) -> Estimate:
    """Assimilate one data set; members run on ``executor``, by default in this process.

    Raises
    ------
    TooFewMembersError: the ensemble is lost. OutputError: a checkpoint cannot be written.
    """
    analysis = assimilate(job.problem, job.settings, job.seed, executor, progress, job.resume, keep=_checkpoints(job))
    outcome = "converged" if analysis.converged else "not converged"
    return Estimate(
        content=to_bytes(build_groups(analysis, job.attributes)),
        summary=summarise(analysis),
        ending=f"{outcome}: {analysis.stop_reason}; {analysis.forward_runs} forward runs",
        warnings=analysis.cautions,
        n_observations=len(analysis.observations),
    )


def estimate_and_tell(job: Job, tell: Callable[[News], None]) -> Estimate:
    """As :func:`estimate`, on a worker: ``tell`` gets the iterations, without their members, as they end."""
    teller = _Teller(tell)
    try:
        return estimate(job, None, teller)
    finally:
        teller.close()


class _Teller:
    """Passes iterations on at once, or, where the last message is too young, as soon as it is old enough."""

    def __init__(self, tell: Callable[[News], None]):
        self._tell, self._lock = tell, threading.Lock()
        self._waiting: list[tuple[str, Record]] = []
        self._sent = -math.inf
        self._timer: threading.Timer | None = None

    def __call__(self, name: str, record: Record) -> None:
        if isinstance(record, IterationRecord):
            record = replace(record, members=record.members[:0])
        with self._lock:
            self._waiting.append((name, record))
            rest = self._sent + TELL_EVERY - time.monotonic()
            if rest <= 0:
                self._send()
            elif self._timer is None:
                self._timer = threading.Timer(rest, self._later)
                self._timer.daemon = True
                self._timer.start()

    def close(self) -> None:
        with self._lock:
            self._send()

    def _later(self) -> None:
        with self._lock, suppress(OSError):  # nobody is there to hear it: the call's own thread will notice
            self._send()

    def _send(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._waiting:
            self._tell(tuple(self._waiting))
            self._waiting.clear()
            self._sent = time.monotonic()


def _checkpoints(job: Job) -> Callable[[Callable[[], LoopState]], None]:
    path = job.checkpoint if job.checkpoint is not None and job.checkpoint.parent.is_dir() else None
    keeper = None if path is None else Keeper(path, job.fingerprint, job.checkpoint_every)

    def keep(now: Callable[[], LoopState]) -> None:
        if job.stop is not None and job.stop.is_set():
            raise StoppedError
        if keeper is not None:
            keeper.keep(now)

    return keep
