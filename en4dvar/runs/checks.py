"""What can be told before a run: every fault of configuration and data at once, the prior's forecast, the cost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.config import Config, TwinConfig, load_any, schema
from en4dvar.config.data import DataPlan, read_data
from en4dvar.config.document import Document, override, read_document
from en4dvar.config.models import read_model
from en4dvar.config.validate import check
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.ensemble.forecast import Forecast, forecast
from en4dvar.errors import ConfigError, DataError, Fault
from en4dvar.executor import Executor, SerialExecutor, one_blas_thread
from en4dvar.inputs.build import build_one, data_files, find_files, inverse_plan, read_observations
from en4dvar.problem import AssimilationSettings, InverseProblem
from en4dvar.state import Array

GRID_POINTS = 200  # of the prior predictive
ENOUGH = 0.3  # seconds of forward runs that the time of one is taken from
LONGEST = 20.0  # seconds that the forecast of the prior ensemble may take unasked
ITERATIONS = 5  # of a descent, typically
SEARCH = 3  # runs of a step control, typically


def validate(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Config | TwinConfig:
    """Load a configuration and read its data files; nothing is computed or written.

    Parameters
    ----------
    path: the YAML file; paths inside it are relative to its folder.
    overrides: values for dotted keys such as ``"assimilation.members"``; text is read as YAML.

    Raises
    ------
    ConfigError: every fault of the file *and* of the data files it names, each with file, line and column.
    """
    try:
        config = load_any(path, overrides)
    except ConfigError as error:
        raise ConfigError(_ordered([*error.problems, *_data_faults(Path(path), overrides)])) from None
    if isinstance(config, Config):
        faults = list(_problem_faults(config))
        if faults:
            raise ConfigError(_ordered(faults))
    return config


def _problem_faults(config: Config) -> Iterator[Fault]:
    """What keeps the inverse problems of a valid configuration from being built."""
    try:
        files = data_files(inverse_plan(config))
    except ConfigError as error:
        yield from error.problems
        return
    except DataError as error:
        yield _located(config.document, error)
        return
    for name, file in files.items():
        try:
            build_one(config, name, file)
        except ConfigError as error:
            yield from error.problems
        except DataError as error:
            yield _located(config.document, error)


def _data_faults(path: Path, overrides: Mapping[str, Any] | None) -> Iterator[Fault]:
    """Faults of the data section and its files, for a configuration that has faults elsewhere."""
    try:
        document = override(read_document(path), overrides or {})
    except ConfigError:
        return
    faults: list[Fault] = []
    plan = _plan(document, path.resolve().parent, faults)
    yield from faults
    if plan is None:
        return
    try:
        files = find_files(plan.base, plan.paths)
    except DataError as error:
        yield _located(document, error)
        return
    for name, file in files.items():
        try:
            read_observations(plan, file, name)
        except ConfigError as error:
            yield from error.problems
        except DataError as error:
            yield _located(document, error)


def _plan(document: Document, base: Path, faults: list[Fault]) -> DataPlan | None:
    """How the data would be read, with the model's default settings where those given are at fault."""
    model_section, section = document.data.get("model"), document.data.get("data")
    if not isinstance(model_section, dict) or not isinstance(section, dict):
        return None
    found = read_model(model_section, base, document, []) or read_model(
        {"name": model_section.get("name")}, base, document, []
    )
    data = check(schema.Data, section, ("data",), document, faults)
    return read_data(data, base, found[0], document, faults) if found and data else None


def _located(document: Document, error: DataError) -> Fault:
    """A data file's fault at the place that names the file."""
    return document.fault(("data", "path"), str(error))


def _ordered(faults: Sequence[Fault]) -> list[Fault]:
    return sorted(dict.fromkeys(faults), key=lambda fault: (fault.file, fault.line, fault.column))


@dataclass(frozen=True)
class Preview:
    """The prior ensemble of one data set before any assimilation.

    ``run`` is its forecast: predictions (N, K) and, along ``grid`` (M,), paths (N, M); of the first members only where
    all would take long. ``seconds`` is the time of one forward run on one thread, ``runs`` how many an estimate takes,
    typically.
    """

    problem: InverseProblem
    grid: Array
    run: Forecast
    seconds: float
    runs: int

    @property
    def outside(self) -> float:
        """Share of the observations that no member's prediction comes near: outside the ensemble's range by > 2 std."""
        observations = self.problem.observations
        alive = self.run.predictions[self.run.active]
        if not len(alive):
            return 1.0
        low, high = alive.min(axis=0) - 2 * observations.std, alive.max(axis=0) + 2 * observations.std
        return float(np.mean((observations.values < low) | (observations.values > high)))


def preview(problem: InverseProblem, settings: AssimilationSettings, seed: int, whole: bool = False) -> Preview:
    """Run the prior ensemble of a data set on one thread and take the time.

    The first run is not counted: it may compile the model. ``whole``: every member, however long it takes. Members
    that fail are told by ``run.failures``, not raised.
    """
    y = problem.observations
    grid = np.linspace(y.times[0], y.times[-1], GRID_POINTS)
    executor = SerialExecutor()
    with one_blas_thread():
        space = WeightSpace(problem, settings, seed, executor)
        forecast(problem, space.members[:1], executor, grid)
        seconds, count = _seconds_per_run(problem, space.members, executor)
        members = space.members if whole or seconds * len(space.members) < LONGEST else space.members[:count]
        run = forecast(problem, members, executor, grid)
    return Preview(problem, grid, run, seconds, expected_runs(space))


def _seconds_per_run(problem: InverseProblem, members: Array, executor: Executor) -> tuple[float, int]:
    """Seconds of one run, from as many members as take a third of a second, at most all; and how many these are."""
    count = min(len(members), max(1, problem.model.batch))
    while True:
        begin = time.perf_counter()
        forecast(problem, members[:count], executor)
        elapsed = time.perf_counter() - begin
        if elapsed > ENOUGH or count == len(members):
            return elapsed / count, count
        count = min(len(members), 2 * count)


def expected_runs(space: WeightSpace) -> int:
    """Forward runs of an estimate with typical numbers of iterations and trials; without a Markov chain.

    Prior and posterior forecast of N members, their mean and mode; ES-MDA: N and the mean for each assimilation and
    the end; En4D-Var: for each iteration a tangent (of n runs, or N) and a search, ``starts`` descents side by side.
    """
    settings, n_members = space.settings, len(space.members)
    ends = 2 * (n_members + 1)
    if settings.scheme == "es-mda":
        return ends + (len(settings.mda_coefficients) + 1) * (n_members + 1)
    tangent = 1 + (space.basis.shape[1] if space.economical else n_members)
    starts = settings.starts if settings.start == "best-member" and space.economical else 1
    return ends + starts * min(ITERATIONS, settings.max_iterations) * (tangent + SEARCH)
