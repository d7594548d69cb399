"""A twin experiment from YAML to a run directory: ``twin.nc``, ``summary.csv``, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from en4dvar.config import TwinConfig, load_twin
from en4dvar.cycling.outcome import SequentialState
from en4dvar.cycling.twin import TwinResult, conduct
from en4dvar.executor import Executor
from en4dvar.runs.cycles import Keep, Work, run_cycles
from en4dvar.storage.twin_file import dataset, summary_csv
from en4dvar.tables import table


def run_twin(
    config: TwinConfig | str | Path | Mapping[str, Any],
    *,
    overrides: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    on_cycle: Callable[[int], None] | None = None,
    command: str = "",
) -> TwinResult:
    """Conduct a twin experiment and write its run directory; arguments and errors as of :func:`en4dvar.run`.

    ``on_cycle`` is called with the number of each cycle, from 0.
    """
    if not isinstance(config, TwinConfig):
        config = load_twin(config, overrides)
    return run_cycles(config, twin_work(config, on_cycle), force, resume, command)


def twin_work(config: TwinConfig, on_cycle: Callable[[int], None] | None = None) -> Work[TwinResult]:
    """The work of a twin experiment."""
    experiment = config.experiment

    def conducted(executor: Executor, resume: SequentialState | None, keep: Keep | None) -> TwinResult:
        return conduct(experiment, config.seed, executor, on_cycle, resume, keep)

    return Work("twin", experiment.model, config.scheme, experiment.cycles, {}, conducted, dataset, summary_csv)


def scores_table(result: TwinResult) -> str:
    """RMSE and spread after the burn-in as an aligned table."""
    rows = [(name, f"{s.mean_rmse:.4g}", f"{s.mean_spread:.4g}") for name, s in result.scores.items()]
    return table([("estimate", "RMSE", "spread"), *rows])


def twin_summary(config: TwinConfig) -> str:
    """What ``validate`` prints of a twin experiment."""
    experiment = config.experiment
    unit = "" if experiment.model.time_unit == "1" else f" {experiment.model.time_unit}"
    observed = ", ".join(
        f"{o.name} (std {experiment.error_std[o.name]:.4g}{'' if o.unit == '1' else ' ' + o.unit})"
        for o in experiment.observables
    )
    drawn = f" and {', '.join(experiment.prior.names)}" if experiment.prior else ""
    return (
        f"{config.name}: twin experiment, state{drawn} estimated with {config.scheme}, {experiment.members} members, "
        f"seed {config.seed}\n"
        f"{experiment.cycles} cycles every {experiment.interval:g}{unit} ({experiment.burn_in} not counted), "
        f"observed: {observed}\nrun directory: {config.directory}"
    )
