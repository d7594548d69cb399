"""A sequence from YAML to a run directory: ``sequence.nc``, ``summary.csv``, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.config import SequenceConfig, load_sequence
from en4dvar.config.build_sequence import build_sequence, sequence_data
from en4dvar.cycling.outcome import SequentialState
from en4dvar.cycling.problem import SeriesProblem, SeriesResult, assimilate_series
from en4dvar.errors import ConfigError
from en4dvar.executor import Executor
from en4dvar.runs.cycles import Keep, Work, run_cycles
from en4dvar.storage.sequence_file import dataset, estimates, summary_csv
from en4dvar.tables import table


def run_sequence(
    config: SequenceConfig | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> SeriesResult:
    """Assimilate a series of data and write its run directory; arguments and errors as of :func:`en4dvar.run`.

    ``on_cycle`` is called with the index of the last observation time of each cycle, from 0.

    Raises :class:`ConfigError` for ``overrides`` of a configuration that is loaded already.
    """
    if not isinstance(config, SequenceConfig):
        config = load_sequence(config, overrides)
    elif overrides:
        raise ConfigError("overrides apply to a file or dict; give them to load_sequence instead")
    return run_cycles(config, sequence_work(config, on_cycle), force, resume, command)


def sequence_work(config: SequenceConfig, on_cycle: Callable[[int], None] | None = None) -> Work[SeriesResult]:
    """The work of a sequence; its data are read. Raises :class:`ConfigError`, :class:`DataError`."""
    problem = build_sequence(config)

    def conduct(executor: Executor, resume: SequentialState | None, keep: Keep | None) -> SeriesResult:
        return assimilate_series(problem, config.seed, executor, on_cycle, resume, keep)

    cycles, scheme = len(problem.series.times), config.assimilation.scheme
    return Work("sequence", config.model, scheme, cycles, sequence_data(config), conduct, dataset, summary_csv)


def estimates_table(result: SeriesResult) -> str:
    """State and parameters at the last time as an aligned table."""
    rows = [(name, f"{mean:.5g}", f"{std:.3g}", unit) for name, mean, std, unit in estimates(result)]
    return table([("at the end", "mean", "std", "unit"), *rows])


def sequence_summary(config: SequenceConfig, problem: SeriesProblem) -> str:
    """What ``validate`` prints of a sequence."""
    series, start = problem.series, problem.start
    unit = "" if config.model.time_unit == "1" else f" {config.model.time_unit}"
    drawn = f" and {', '.join(start.prior.names)}" if start.prior else ""
    observed = ", ".join(observable.name for observable in problem.observables)
    return (
        f"{config.name}: sequence of {problem.name}, state{drawn} estimated with {config.assimilation.scheme}, "
        f"{problem.members} members, seed {config.seed}\n"
        f"{np.isfinite(series.values).sum()} readings of {observed} at {len(series.times)} times from "
        f"{series.times[0]:g} to {series.times[-1]:g}{unit}\nrun directory: {config.directory}"
    )
