"""The kind of run that follows a series of readings: ``sequence.nc``, ``summary.csv``, page."""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.assembly.build_sequence import build_sequence, sequence_data
from en4dvar.config import SequenceConfig, load_sequence, loaded
from en4dvar.executor import Executor
from en4dvar.inputs.asked import DataFile
from en4dvar.report.sequence import SequenceOutcome
from en4dvar.results.checkpoint import FOLDER
from en4dvar.results.series_file import sequence_csv
from en4dvar.runs.cycles import Cycles, Keep
from en4dvar.runs.engine import conduct_run
from en4dvar.series.moments import SequentialState
from en4dvar.series.problem import SeriesProblem, SeriesResult, assimilate_series


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
    kind = SequenceKind(loaded(config, load_sequence, overrides), on_cycle)
    return SequenceOutcome(**vars(conduct_run(kind, force, resume, command)))


class SequenceKind(Cycles[SeriesResult]):
    """A configuration with a ``sequence:`` section."""

    name = "sequence"
    result = "sequence.nc"
    files = (result, "summary.csv", f"{FOLDER}/sequence.cycle")
    writer = "en4dvar.report.sequence:write_sequence_report"
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

    def assimilated(self, executor: Executor, resume: SequentialState | None, keep: Keep | None) -> SeriesResult:
        return assimilate_series(self.problem, self.config.seed, executor, self.on_cycle, resume, keep)


def sequence_summary(config: SequenceConfig, problem: SeriesProblem) -> str:
    """What ``validate`` prints of a sequence."""
    series, start = problem.series, problem.start
    unit = "" if config.model.time_unit == "1" else f" {config.model.time_unit}"
    drawn = f" and {', '.join(start.prior.names)}" if start.prior else ""
    observed = ", ".join(observable.name for observable in problem.observables)
    return (
        f"{config.name}: sequence of {problem.name}, state{drawn} estimated with {config.scheme}, "
        f"{problem.members} members, seed {config.seed}\n"
        f"{np.isfinite(series.values).sum()} readings of {observed} at {len(series.times)} times from "
        f"{series.times[0]:g} to {series.times[-1]:g}{unit}\nrun directory: {config.directory}"
    )
