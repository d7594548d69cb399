"""Runs of cycles, twin experiments and sequences: a netCDF file, ``summary.csv``, report. Resumable at any moment.

After a kill they go on from the latest checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from en4dvar.config import SequenceConfig, TwinConfig
from en4dvar.cycling.outcome import SequentialState
from en4dvar.cycling.problem import SeriesResult
from en4dvar.cycling.twin import TwinResult
from en4dvar.executor import Executor, make_executor
from en4dvar.files import write_text
from en4dvar.forward import ForwardModel
from en4dvar.inputs.asked import DataFile
from en4dvar.runs.interrupt import terminate_as_interrupt
from en4dvar.runs.rundir import RunDirectory
from en4dvar.runs.session import Session, directory_mode, session
from en4dvar.storage.checkpoint import FOLDER, Keeper, digest
from en4dvar.storage.cycles_file import cycles_file
from en4dvar.storage.netcdf import netcdf_file

if TYPE_CHECKING:
    import xarray as xr

Keep = Callable[[Callable[[], SequentialState]], None]
R = TypeVar("R", SeriesResult, TwinResult)


@dataclass(frozen=True)
class Work(Generic[R]):
    """What a run of ``cycles`` does with ``data`` (name of each data set → its file), and what it leaves.

    ``conduct`` takes the executor, where to resume from and what keeps the state after each cycle; ``dataset`` the
    result and attributes. The files are called after ``name``.
    """

    name: str
    model: ForwardModel
    scheme: str
    cycles: int
    data: Mapping[str, DataFile]
    conduct: Callable[[Executor, SequentialState | None, Keep | None], R]
    dataset: Callable[[R, Mapping[str, Any]], xr.Dataset]
    summary: Callable[[R], str]

    def again(self, executor: Executor) -> xr.Dataset:
        """What its file holds, without attributes of the making."""
        return self.dataset(self.conduct(executor, None, None), {})


def run_cycles(config: TwinConfig | SequenceConfig, work: Work[R], force: bool, resume: bool, command: str) -> R:
    """Do the work in its run directory; arguments and errors as of :func:`en4dvar.run`."""
    kept = f"the cycles up to the last checkpoint are kept in {config.directory}"
    file, state = f"{work.name}.nc", f"{FOLDER}/{work.name}.cycle"
    with (
        terminate_as_interrupt(),
        RunDirectory.open(config.directory, directory_mode(force, resume)) as directory,
        session(config, work.data, directory, command, lambda: kept) as run,
    ):
        run.begin(file, "summary.csv", state)
        with (
            make_executor(work.model, config.execution.workers) as executor,
            kept_cycles(run, state, config.execution.checkpoint_every, work.cycles) as (before, keep),
        ):
            result = work.conduct(executor, before, keep)
        run.log.write("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        attributes = {**run.attributes, "identity": run.identity.settings, "name": config.name, "scheme": work.scheme}
        with netcdf_file(directory.at(file)) as partial:
            work.dataset(result, attributes).to_netcdf(partial, engine="netcdf4", format="NETCDF4")
        write_text(directory.at("summary.csv"), work.summary(result))
        if config.report:
            report_cycles(directory, config.figures)
    return result


def report_cycles(directory: RunDirectory, figures: bool = False) -> Path | None:
    """Write the page of a finished run of cycles, on demand its figures as files too; None where there is none.

    Raises :class:`OutputError`.
    """
    file = cycles_file(directory.work)
    if file is None:
        return None
    from en4dvar.report.sequence import write_sequence_report  # with matplotlib, which no page of a data set needs
    from en4dvar.report.twin import write_twin_report

    directory.claim("report.html")
    with directory.claiming("figures"):
        return (write_twin_report if file.stem == "twin" else write_sequence_report)(directory.work, figures)


@contextmanager
def kept_cycles(run: Session, file: str, every: float, cycles: int) -> Iterator[tuple[SequentialState | None, Keep]]:
    """Where to resume from and what keeps the state after each cycle, in the checkpoint ``file``.

    What the block ends with is kept, too, so that it is never repeated.
    """
    fingerprint = digest("\n".join([run.identity.settings, *map(str, run.identity.data)]).encode())
    resume = None
    if run.resumed:
        resume = run.restore(file, fingerprint, SequentialState, "it is assimilated from the start")
    if resume is not None:
        run.log.write(f"continued after {resume.cycle} of {cycles} cycles")
    keeper = Keeper(run.directory.at(file), fingerprint, every)
    latest: list[Callable[[], SequentialState]] = []

    def keep(state: Callable[[], SequentialState]) -> None:
        latest[:] = [state]
        keeper.keep(state)

    yield resume, keep
    for state in latest:
        keeper.write(state())
