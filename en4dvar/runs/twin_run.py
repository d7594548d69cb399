"""The kind of run that is a twin experiment: ``twin.nc``, ``summary.csv``, page."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from en4dvar.config import TwinConfig, load_twin, loaded
from en4dvar.executor import Executor
from en4dvar.report.twin import TwinOutcome
from en4dvar.results.checkpoint import FOLDER
from en4dvar.results.series_file import twin_csv
from en4dvar.runs.cycles import Cycles, Keep
from en4dvar.runs.engine import conduct_run
from en4dvar.series.moments import SequentialState
from en4dvar.series.twin import TwinResult, conduct


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
    """
    kind = TwinKind(loaded(config, load_twin, overrides), on_cycle)
    return TwinOutcome(**vars(conduct_run(kind, force, resume, command)))


class TwinKind(Cycles[TwinResult]):
    """A configuration with a ``twin:`` section."""

    name = "twin"
    result = "twin.nc"
    files = (result, "summary.csv", f"{FOLDER}/twin.cycle")
    writer = "en4dvar.report.twin:write_twin_report"
    summary = staticmethod(twin_csv)

    @property
    def cycles(self) -> int:
        return int(self.config.experiment.cycles)

    def assimilated(self, executor: Executor, resume: SequentialState | None, keep: Keep | None) -> TwinResult:
        return conduct(self.config.experiment, self.config.seed, executor, self.on_cycle, resume, keep)


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
