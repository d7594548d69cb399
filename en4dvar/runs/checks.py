"""What can be told before a run: every fault of configuration and data at once."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import create_model

from en4dvar.assembly.build import build_one, build_sequence, data_files, estimated_files, inverse_plan
from en4dvar.assembly.reading import read_observations
from en4dvar.config import AnyConfig, Config, SequenceConfig, resolve_any
from en4dvar.config.context import check
from en4dvar.config.data import DATA, DataPlan
from en4dvar.config.document import Document, document_from
from en4dvar.config.load import context_of, in_order
from en4dvar.config.schema import Section
from en4dvar.data.observations import Observations, require_distinct
from en4dvar.inputs.parts import DataFile
from en4dvar.plumbing.errors import ConfigError, DataError, Fault
from en4dvar.problem import InverseProblem
from en4dvar.results.variables import require_free_names
from en4dvar.runs.together import require_population

T = TypeVar("T")


def validate(source: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> AnyConfig:
    """Load a configuration, as :func:`load_config` does, and read its data files; nothing is computed or written.
    Raises :class:`ConfigError`: every fault of the file *and* of the data files it names, with file, line and column.
    """
    config, _, unusable = check_all(source, overrides)
    if unusable:
        raise ConfigError(unusable)
    return config


def check_all(
    source: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None
) -> tuple[AnyConfig, list[InverseProblem], list[Fault]]:
    """As :func:`validate`; the problems of the data sets, and the faults of those that a campaign goes on without."""
    document, base = document_from(source, overrides)
    try:
        config = resolve_any(document, base)
    except ConfigError as error:
        raise ConfigError(in_order([*error.problems, *_faults_of_data(document, base)])) from None
    faults, problems, unusable = list[Fault](), list[InverseProblem](), list[Fault]()
    with _collecting(faults, document):
        if isinstance(config, Config):
            files = estimated_files(config)
            problems, unusable = _read_files(document, inverse_plan(config), partial(checked_problem, config))
            for problem in problems[:1]:
                require_together(config, problem, files)
        if isinstance(config, SequenceConfig):
            build_sequence(config)
    if faults or (unusable and not problems):
        raise ConfigError(in_order([*faults, *unusable]))
    return config, problems, in_order(unusable)


def checked_problem(config: Config, name: str, file: DataFile) -> InverseProblem:
    """The inverse problem of one data set, whose result can be written. Raises :class:`ConfigError`, `DataError`."""
    problem = build_one(config, name, file)
    require_free_names(problem)
    return problem


def require_together(config: Config, problem: InverseProblem, files: Mapping[str, DataFile]) -> None:
    """Raise :class:`ConfigError` where data ``files``, such as that of ``problem``, are to be estimated together, and
    cannot be: some are in no group, they have no population, two hold the same readings.
    """
    faults: list[Fault] = []
    for name in files:
        with config.document.collecting(faults):
            config.sharing.of_dataset(name)
    if faults:
        raise ConfigError(faults)
    require_population(config, problem, files)
    if not (config.sharing.kinds or config.population):
        return
    usable: list[Observations] = []
    for name, file in files.items():
        with suppress(DataError):  # told of each in its turn
            usable.append(read_observations(inverse_plan(config), file, name))
    with config.document.placing("data", "path"):
        require_distinct(usable)


def _faults_of_data(document: Document, base: Path) -> list[Fault]:
    """Faults of the data files, for a configuration that has faults elsewhere than in its data section."""
    context = context_of(document, base, None)
    alone: Any = create_model("DataAlone", __base__=Section, data=(DATA, ...))
    section: Any = check(alone, {"data": document.data.get("data")}, (), document, [], context)
    if section is None or context.default is None:
        return []
    plan = section.data
    return _read_files(document, plan, lambda name, file: read_observations(plan, file, name))[1]


def _read_files(document: Document, plan: DataPlan, read: Callable[[str, DataFile], T]) -> tuple[list[T], list[Fault]]:
    """What is read of each data set, and what keeps others from being read."""
    results, faults = list[T](), list[Fault]()
    with _collecting(faults, document):
        for name, file in data_files(plan).items():
            with _collecting(faults, document):
                results.append(read(name, file))
    return results, faults


@contextmanager
def _collecting(faults: list[Fault], document: Document) -> Iterator[None]:
    """Within, errors of settings and data are told as ``faults``; a file's where it is named, by one series or all."""
    try:
        yield
    except ConfigError as error:
        faults += error.problems
    except DataError as error:
        own = ("data", "series", error.series)
        places = (place for place in ((*own, "path"), ("data", "path"), own) if document.has(place))
        faults.append(document.fault(next(places, ("data",)), str(error)))
