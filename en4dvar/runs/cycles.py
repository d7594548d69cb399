"""The kinds of run that are cycles, one after the other: twin experiments, and sequences, which follow readings.

Each writes a netCDF file, ``summary.csv`` and a page. After a kill it goes on from the latest checkpoint.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from en4dvar.assembly.build import build_sequence, sequence_data
from en4dvar.config import SequenceConfig, TwinConfig, load_sequence, load_twin, loaded
from en4dvar.executor import Executor, choose_executor
from en4dvar.inputs.parts import DataFile
from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.units import unit_after
from en4dvar.report.sequence import SequenceOutcome, TwinOutcome
from en4dvar.results.checkpoint import FOLDER
from en4dvar.results.netcdf import Group, to_bytes
from en4dvar.results.series_file import sequence_csv, series_group, twin_csv
from en4dvar.runs.engine import FIGURES, REPORT, RunKind, Session, conduct_run
from en4dvar.series.moments import SequentialState
from en4dvar.series.problem import SeriesProblem, assimilate_series
from en4dvar.series.twin import conduct

Keep = Callable[[Callable[[], SequentialState]], None]
R = TypeVar("R", SequenceOutcome, TwinOutcome)


def run_twin(
    config: TwinConfig | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> TwinOutcome:
    """Conduct a twin experiment and write its run directory; arguments and errors as of :func:`en4dvar.run`.
    ``on_cycle`` is called with the number of each cycle, from 0.

    Raises :class:`ConfigError` for ``overrides`` of a configuration that is loaded already.
    """
    return conduct_run(TwinKind(loaded(config, load_twin, overrides), on_cycle), force, resume, command)


def run_sequence(
    config: SequenceConfig | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> SequenceOutcome:
    """Assimilate a series of data and write its run directory; arguments and errors as of :func:`en4dvar.run`.

    ``on_cycle`` is called with the index of the last observation time of each cycle, from 0.

    Raises :class:`ConfigError` for ``overrides`` of a configuration that is loaded already.
    """
    return conduct_run(SequenceKind(loaded(config, load_sequence, overrides), on_cycle), force, resume, command)


@dataclass(frozen=True)
class Cycles(RunKind[R]):
    """A run of cycles; its files are called after the kind.

    ``on_cycle`` is called with the number of each cycle, or the index of its last observation time, from 0.
    ``summary``: result → ``summary.csv``.
    """

    units = "cycles up to the last checkpoint"
    pages = (REPORT, *FIGURES)
    readers = ("report", "rerun", "compare", "export")
    writer = "en4dvar.report.sequence:write_cycles_report"
    summary: ClassVar["staticmethod[[Any], str]"]
    config: Any
    on_cycle: Callable[[int], None] | None = None

    @property
    @abstractmethod
    def cycles(self) -> int:
        """How many there are."""

    @abstractmethod
    def assimilated(self, executor: Executor, resume: SequentialState | None, keep: Keep | None) -> R:
        """The result, from where to ``resume`` on; ``keep`` is given the state after each cycle."""

    @abstractmethod
    def _described(self) -> tuple[str, Any, int, str]:
        """What it is, the prior of its parameters, its members, and its observations in words."""

    def __str__(self) -> str:
        """What ``validate`` prints of it."""
        what, prior, members, observed = self._described()
        drawn = f" and {', '.join(prior.names)}" if prior else ""
        config = self.config
        return (
            f"{config.name}: {what}, state{drawn} estimated with {config.scheme}, {counted(members, 'member')}, "
            f"seed {config.seed}\n{observed}\nrun directory: {config.directory}"
        )

    def again(self, executor: Executor) -> Group:
        """What its file holds, computed again, without attributes of the making."""
        return series_group(self.assimilated(executor, None, None), {})

    def executor(self) -> Executor:
        return choose_executor(self.config.model, workers=self.config.execution.workers)

    def conduct(self, run: Session, executor: Executor) -> R:
        file = f"{FOLDER}/{self.name}.cycle"
        before, keeper = run.kept(file, run.fingerprint, SequentialState, "it is assimilated from the start")
        if before is not None:
            run.log(f"continued after {before.cycle} of {self.cycles} cycles")
        latest: list[Callable[[], SequentialState]] = []

        def keep(state: Callable[[], SequentialState]) -> None:
            latest[:] = [state]
            keeper.keep(state)

        result = self.assimilated(executor, before, keep)
        for state in latest:  # what it ends with is kept, too, so that it is never repeated
            keeper.write(state())
        run.log("\n".join(f"member lost: {reason}" for reason in result.run.failures))
        own = {"name": self.config.name, "scheme": self.config.scheme}
        to_bytes({"/": series_group(result, {**run.attributes, **own})}).write(run.directory.at(self.result))
        write_text(run.directory.at("summary.csv"), self.summary(result))
        return result


class TwinKind(Cycles[TwinOutcome]):
    """A configuration with a ``twin:`` section."""

    name = "twin"
    result = "twin.nc"
    files = (result, "summary.csv", f"{FOLDER}/twin.cycle")
    summary = staticmethod(twin_csv)

    @property
    def cycles(self) -> int:
        return int(self.config.experiment.cycles)

    def assimilated(self, executor: Executor, resume: SequentialState | None, keep: Keep | None) -> TwinOutcome:
        result = conduct(self.config.experiment, self.config.seed, executor, self.on_cycle, resume, keep)
        return TwinOutcome(**vars(result))

    def _described(self) -> tuple[str, Any, int, str]:
        twin = self.config.experiment
        observed = ", ".join(
            f"{o.name} (std {twin.error_std[o.name]:.4g}{unit_after(o.unit)})" for o in twin.observables
        )
        every = f"{counted(twin.cycles, 'cycle')} every {twin.interval:g}{unit_after(self.config.model.time_unit)}"
        told = f"{every} ({twin.burn_in} not counted), observed: {observed}"
        return "twin experiment", twin.start.prior, twin.members, told


class SequenceKind(Cycles[SequenceOutcome]):
    """A configuration with a ``sequence:`` section."""

    name = "sequence"
    result = "sequence.nc"
    files = (result, "summary.csv", f"{FOLDER}/sequence.cycle")
    summary = staticmethod(sequence_csv)

    @cached_property
    def problem(self) -> SeriesProblem:
        """With the data read. Raises :class:`ConfigError`, :class:`DataError`."""
        return build_sequence(self.config)

    @cached_property
    def data(self) -> Mapping[str, DataFile]:
        return sequence_data(self.config)

    def check(self) -> None:
        _ = self.problem

    @property
    def cycles(self) -> int:
        return len(self.problem.series.times)

    def assimilated(self, executor: Executor, resume: SequentialState | None, keep: Keep | None) -> SequenceOutcome:
        result = assimilate_series(self.problem, self.config.seed, executor, self.on_cycle, resume, keep)
        return SequenceOutcome(**vars(result))

    def _described(self) -> tuple[str, Any, int, str]:
        problem, times = self.problem, self.problem.series.times
        observed = ", ".join(observable.name for observable in problem.observables)
        span = f"from {times[0]:g} to {times[-1]:g}{unit_after(self.config.model.time_unit)}"
        readings = counted(np.isfinite(problem.series.values).sum(), "reading")
        told = f"{readings} of {observed} at {counted(len(times), 'time')} {span}"
        return f"sequence of {problem.name}", problem.start.prior, problem.members, told


def cycles_of(config: TwinConfig | SequenceConfig, on_cycle: Callable[[int], None] | None = None) -> Cycles[Any]:
    """The run that a configuration is of."""
    return (TwinKind if isinstance(config, TwinConfig) else SequenceKind)(config, on_cycle)
