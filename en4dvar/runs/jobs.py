"""One data set as a unit of work: what a worker gets, what it does, what it hands back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from en4dvar.assimilate import LoopState, assimilate
from en4dvar.executor import Executor
from en4dvar.honesty import Caution
from en4dvar.problem import AssimilationSettings, InverseProblem, IterationRecord
from en4dvar.runs.progress import Progress, describe
from en4dvar.storage.checkpoint import Keeper
from en4dvar.storage.groups import build_groups
from en4dvar.storage.netcdf import to_bytes
from en4dvar.storage.store import ParameterSummary, summarise


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
    """``content`` is the netCDF file; ``log`` what the iterations had to tell, ``last`` the last of them; ``ending``
    how they ended."""

    content: bytes
    log: tuple[str, ...]
    last: IterationRecord
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
    log: list[str] = []

    def tell(name: str, record: IterationRecord) -> None:
        log.append(describe(name, record))
        if progress is not None:
            progress(name, record)

    analysis = assimilate(
        job.problem, job.settings, job.seed, executor, tell, job.resume, on_iteration=_checkpoints(job)
    )
    outcome = "converged" if analysis.converged else "not converged"
    return Estimate(
        content=to_bytes(build_groups(analysis, job.attributes)),
        log=tuple(log),
        last=analysis.iterations[-1],
        summary=summarise(analysis),
        ending=f"{outcome}: {analysis.stop_reason}; {analysis.forward_runs} forward runs",
        warnings=analysis.cautions,
        n_observations=len(analysis.observations),
    )


def _checkpoints(job: Job) -> Callable[[LoopState], None]:
    path = job.checkpoint if job.checkpoint is not None and job.checkpoint.parent.is_dir() else None
    keeper = None if path is None else Keeper(path, job.fingerprint, job.checkpoint_every)

    def keep(state: LoopState) -> None:
        if job.stop is not None and job.stop.is_set():
            raise StoppedError
        if keeper is not None:
            keeper.keep(lambda: state)

    return keep
