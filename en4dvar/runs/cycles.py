"""Runs of cycles, twin experiments and sequences: a netCDF file, ``summary.csv``, page. Resumable at any moment.

After a kill they go on from the latest checkpoint.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from en4dvar.executor import Executor, choose_executor
from en4dvar.plumbing.files import write_text
from en4dvar.results.checkpoint import FOLDER, Keeper, digest
from en4dvar.results.netcdf import Group, to_bytes
from en4dvar.results.series_file import series_group
from en4dvar.runs.kind import FIGURES, REPORT, RunKind
from en4dvar.runs.session import Session
from en4dvar.series.moments import SequentialState
from en4dvar.series.problem import SeriesResult
from en4dvar.series.twin import TwinResult

Keep = Callable[[Callable[[], SequentialState]], None]
R = TypeVar("R", SeriesResult, TwinResult)


@dataclass(frozen=True)
class Cycles(RunKind[R]):
    """A run of cycles, one after the other; its files are called after the kind.

    ``on_cycle`` is called with the number of each cycle, or the index of its last observation time, from 0.
    ``summary``: result → ``summary.csv``.
    """

    pages = (REPORT, *FIGURES)
    summary: ClassVar[staticmethod[[Any], str]]
    config: Any
    on_cycle: Callable[[int], None] | None = None

    @property
    @abstractmethod
    def cycles(self) -> int:
        """How many there are."""

    @abstractmethod
    def assimilated(self, executor: Executor, resume: SequentialState | None, keep: Keep | None) -> R:
        """The result, from where to ``resume`` on; ``keep`` is given the state after each cycle."""

    def again(self, executor: Executor) -> Group:
        """What its file holds, computed again, without attributes of the making."""
        return series_group(self.assimilated(executor, None, None), {})

    def executor(self) -> Executor:
        return choose_executor(self.model, workers=self.config.execution.workers)

    def kept(self) -> str:
        return f"the cycles up to the last checkpoint are kept in {self.directory}"

    def conduct(self, run: Session, executor: Executor) -> R:
        file = f"{FOLDER}/{self.name}.cycle"
        fingerprint = digest("\n".join([run.identity.settings, *map(str, run.identity.data)]).encode())
        before = run.restore(file, fingerprint, SequentialState, "it is assimilated from the start")
        if before is not None:
            run.log.write(f"continued after {before.cycle} of {self.cycles} cycles")
        keeper = Keeper(run.directory.at(file), fingerprint, self.config.execution.checkpoint_every)
        latest: list[Callable[[], SequentialState]] = []

        def keep(state: Callable[[], SequentialState]) -> None:
            latest[:] = [state]
            keeper.keep(state)

        result = self.assimilated(executor, before, keep)
        for state in latest:  # what it ends with is kept, too, so that it is never repeated
            keeper.write(state())
        run.log.write("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        own = {"identity": run.identity.settings, "name": self.config.name, "scheme": self.config.scheme}
        to_bytes({"/": series_group(result, {**run.attributes, **own})}).write(run.directory.at(self.result))
        write_text(run.directory.at("summary.csv"), self.summary(result))
        if self.config.report:
            self.page(run.directory.work, figures=self.config.figures)
        return result
