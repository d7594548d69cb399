"""Settings → inverse problems: reads the data files, cuts the windows, evaluates what refers to the data."""

from __future__ import annotations

import glob
import itertools
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.caution import Caution
from en4dvar.config import Config
from en4dvar.config.context import Spread
from en4dvar.config.data import Data
from en4dvar.config.parameters import Fixed, Uncertain
from en4dvar.ensemble.forecast import check_problem
from en4dvar.errors import ConfigError, DataError, Fault
from en4dvar.files import PathError, expanded, readable
from en4dvar.inputs.readers import (
    ANY,
    SUFFIXES,
    Column,
    DataFile,
    Layout,
    Readings,
    parts_of,
    read_covariance,
    read_series,
)
from en4dvar.inputs.steps import step_doubts
from en4dvar.inputs.window import select
from en4dvar.noise import Noise, noise_of
from en4dvar.observations import Observations
from en4dvar.prior import Prior, PriorTerm
from en4dvar.problem import InverseProblem, discrepancy_parameters
from en4dvar.state import Array
from en4dvar.units import UnitError, convert
from en4dvar.varying import Varying


def build(config: Config) -> tuple[InverseProblem, ...]:
    """One inverse problem a data set, in the order of the paths (of a glob: sorted).

    Raises
    ------
    ConfigError: there is no ``data:`` section, nothing is estimated, or a prior does not suit the data.
    DataError: data files cannot be used; names every one of them.
    """
    plan = inverse_plan(config)
    problems: list[InverseProblem] = []
    unusable: list[DataError] = []
    for name, file in data_files(plan).items():
        try:
            problems.append(build_one(config, name, file))
        except DataError as error:
            unusable.append(error)
    if unusable:
        raise DataError("\n".join(map(str, unusable)))
    return tuple(problems)


def inverse_plan(config: Config) -> Data:
    """How the observations are read. Raises :class:`ConfigError` without data or without anything to estimate."""
    if config.data is None:
        raise ConfigError([Fault("required: where the observations are", "data", config.document.file)])
    if not config.initial_state and not any(isinstance(entry, Uncertain) for entry in config.parameters):
        raise ConfigError([config.document.fault(("parameters",), "no parameter has a prior; nothing to estimate")])
    return config.data


def build_one(config: Config, name: str, file: DataFile) -> InverseProblem:
    """The inverse problem of one of :func:`data_files`. Raises :class:`ConfigError`, :class:`DataError`."""
    return problem_of(config, read_observations(inverse_plan(config), file, name, config.weights))


def problem_of(config: Config, observations: Observations) -> InverseProblem:
    """The inverse problem of observations, wherever they come from. Raises :class:`ConfigError`."""
    terms, fixed = resolve_parameters(config, observations)
    terms = (*terms, *(perturbed.term for perturbed in config.initial_state), *_discrepancy(config, observations))
    perturbations = tuple(perturbed.perturbation for perturbed in config.initial_state)
    varying = _varying(config, observations, terms)
    asked, count = config.assimilation, len(terms) + sum(len(one.changes) for one in varying)
    if asked.sampling == "exact" and asked.members <= count:
        message = f"{asked.members} are too few for {count} parameters; at least {count + 1}"
        raise ConfigError([config.document.fault(("assimilation", "members"), message)])
    problem = InverseProblem(config.model, config.observable, observations, Prior(terms), fixed, perturbations)
    if varying:
        problem = problem.varied(varying)
    check_problem(problem)
    return problem


def _varying(config: Config, observations: Observations, terms: Sequence[PriorTerm]) -> list[Varying]:
    """What varies in time. Raises :class:`ConfigError`: knots that do not suit the observations."""
    model, times, by_name = config.model, observations.times, {term.parameter.name: term for term in terms}
    asked: list[tuple[tuple[str, ...], Callable[[], Varying | None]]] = [
        (("parameters", e.parameter.name), partial(e.walk, model, by_name[e.parameter.name], times))
        for e in config.parameters
        if isinstance(e, Uncertain)
    ]
    asked += [(("model_error", one.field.name), partial(one.changes, model, times)) for one in config.model_error]
    found: list[Varying] = []
    for path, make in asked:
        try:
            one = make()
        except ConfigError as error:
            places = [((*path, *f.path.split(".")) if f.path else path, f.message) for f in error.problems]
            raise ConfigError([config.document.fault(*place) for place in places]) from None
        found += [] if one is None else [one]
    return found


def _discrepancy(config: Config, observations: Observations) -> tuple[PriorTerm, ...]:
    """Priors of the discrepancy that the observations allow for."""
    asked = None if config.data is None else config.data.error.discrepancy
    if asked is None or not observations.noise.discrepant:
        return ()
    times, parameters = observations.times, discrepancy_parameters(config.model, config.observable)
    return asked.terms(parameters, float(observations.values.max()), float(times[-1] - times[0]))


def data_files(plan: Data) -> dict[str, DataFile]:
    """Name of the data set → file: the file's stem, made unique by its folders, then by a number.

    Data sets of one file have the name of their part behind its name.

    Raises
    ------
    DataError: no file matches a pattern, or a file is named twice.
    """
    time = plan.columns.time
    return with_parts(
        find_files(plan.path.base, plan.path.texts),
        plan.columns.observable,
        plan.layout,
        time.name if isinstance(time, Column) else None,
    )


def with_parts(
    files: Mapping[str, Path],
    value: Column,
    layout: Layout = ANY,
    time: str | None = None,
) -> dict[str, DataFile]:
    """Every data set that the files hold, see :func:`~en4dvar.inputs.readers.parts_of`."""
    found: dict[str, DataFile] = {}
    for name, path in files.items():
        try:
            parts = parts_of(path, value, layout, time)
        except DataError:  # told with its reason where it is read
            parts = ()
        for part in parts or ("",):
            found[readable(f"{name}_{part}") if part else name] = DataFile(path, part)
    return found


def find_files(base: Path, texts: Sequence[str]) -> dict[str, Path]:
    """:func:`data_files` of paths, folders and patterns relative to ``base``. Raises :class:`DataError`."""
    paths: list[Path] = []
    for text in texts:
        try:
            path = base / expanded(text)
        except PathError as error:
            raise DataError(str(error)) from None
        if glob.has_magic(text) and not os.path.exists(path):
            found = sorted(Path(p) for p in glob.glob(str(path), recursive=True))
            if not found:
                raise DataError(f"{path}: no file matches")
            paths += found
        elif os.path.isdir(path):
            held = sorted(p for p in _beside(path) if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
            if not held:
                raise DataError(f"{path}: the folder holds no data file ({', '.join(SUFFIXES)})")
            paths += held
        else:
            paths.append(path)
    again = [path for path, count in Counter(os.path.abspath(p) for p in paths).items() if count > 1]
    if again:
        raise DataError(f"{again[0]}: occurs more than once in data.path")
    return dict(zip(_unique_names(paths), paths, strict=True))


def _beside(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise DataError(f"{folder}: cannot be read: {error.strerror}") from None


def _unique_names(paths: list[Path]) -> list[str]:
    stems = Counter(p.stem for p in paths)
    names: dict[str, None] = {}
    for path in paths:
        name = path.stem if stems[path.stem] == 1 else f"{path.parent.name}_{path.stem}"
        same = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
        names[next(n for n in same if n not in names)] = None
    return list(map(readable, names))


def read_observations(plan: Data, file: DataFile, name: str, weights: str = "sum") -> Observations:
    """The observations (y, t, R) of one data set inside the window. Raises :class:`DataError`."""
    columns, asked, path = plan.columns, plan.window, file.path
    clock = columns.time if isinstance(columns.time, Column) else columns.time.column
    stds = plan.error.column("std", columns.observable.unit)
    timing = plan.error.column("time_std", clock.unit if clock else "")
    errors = [column for column in (stds, timing) if column]
    series = read_series(path, columns.time, columns.observable, plan.layout, errors, file.part)
    try:
        window = select(series.times, series.values, asked.start, asked.end, asked.prominence)
    except DataError as error:
        raise DataError(f"{path}: {error}{_span(series.times, plan)}") from None
    times, values = series.times[window], series.values[window]
    if not len(times):
        raise DataError(f"{path}: no observation lies in the window{_span(series.times, plan)}")
    zero = {"file": 0.0, "window": times[0]}.get(str(plan.time_zero), plan.time_zero)
    times = times - float(zero)
    if times[0] < 0:
        raise DataError(f"{path}: the first observation used lies {-times[0]:g} before time zero; see data.time_zero")
    try:
        stated = {key: series.errors[c.name][window] for key, c in (("std", stds), ("time_std", timing)) if c}
        noise = _noise(plan, times, values, np.arange(len(series.times))[window], stated)
    except ValueError as error:
        raise DataError(f"{readable(path)}: {error}") from None
    count = len(times)
    return Observations(
        times=times,
        values=values,
        noise=noise,
        weights=np.full(count, 1.0 if weights == "sum" else 1.0 / count),
        name=name,
        source=readable(path),
        scalars=series.scalars,
        doubts=_doubts(plan, series),
    )


def _doubts(plan: Data, series: Readings) -> tuple[Caution, ...]:
    """What makes the times of a series implausible, where the file states them."""
    column = plan.columns.time
    if not isinstance(column, Column):
        return ()
    return step_doubts(series.times, column.target, column.unit, series.scalars, column.rate)


def _span(times: Array, plan: Data) -> str:
    """Where the readings are, on the file's clock."""
    column = plan.columns.time
    if not isinstance(column, Column):
        return ""
    first, last = convert(times[[0, -1]], column.target, column.unit)
    return f"; the readings go from {first:g} to {last:g} {column.unit}"


def _noise(
    plan: Data, times: Array, values: Array, samples: npt.NDArray[np.intp], stated: Mapping[str, Array]
) -> Noise:
    """The observation errors; ``samples`` (K,) are the places of the observations in the series.

    ``stated``: ``std`` and ``time_std`` (K,) where columns of the file hold them.

    A covariance file holds one row an observation of the window, or one a usable sample of the whole series.
    """
    error, correlation = plan.error, None
    kernel = error.discrepancy.kernel_at(times) if error.discrepancy else None
    time_std = stated["time_std"] if "time_std" in stated else np.full(len(times), error.time_std)
    if error.covariance is not None:
        covariance = read_covariance(error.covariance)
        if len(covariance) > samples[-1] and len(covariance) != len(times):
            covariance = covariance[np.ix_(samples, samples)]
        if len(covariance) != len(times):
            raise DataError(f"{error.covariance.path}: {len(covariance)} rows, but {len(times)} observations")
        std = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(std, std)
        np.fill_diagonal(correlation, 1.0)
        return noise_of(std, time_std, correlation, discrepancy=kernel)
    if error.std is None:
        raise ConfigError("data.error: neither a std nor a covariance")
    if isinstance(error.std, Spread):
        std = np.full(len(times), error.std.absolute(float(values.max())))
    else:
        std = stated["std"]
    if error.correlation_time is not None:
        correlation = np.exp(-np.abs(np.subtract.outer(times, times)) / error.correlation_time)
    return noise_of(std, time_std, correlation, error.huber, kernel)


def resolve_parameters(
    config: Config, observations: Observations | None
) -> tuple[tuple[PriorTerm, ...], dict[str, float]]:
    """Prior terms and fixed values, evaluated on the data where they refer to them.

    Raises
    ------
    ConfigError: every entry that cannot be evaluated, located in the file.
    """
    terms: list[PriorTerm] = []
    fixed: dict[str, float] = {}
    faults: list[Fault] = []
    for entry in config.parameters:
        path = ("parameters", entry.parameter.name)
        try:
            if isinstance(entry, Fixed):
                fixed[entry.parameter.name] = entry.value
            elif isinstance(entry, Uncertain):
                terms.append(entry.term(_maximum(entry, config, observations)))
            elif observations is None:
                raise ConfigError("the value comes from the data file, and there is none; set a value")
            else:
                fixed[entry.parameter.name] = entry.value(observations.scalars, observations.source)
        except ConfigError as error:
            faults += [config.document.fault((*path, f.path) if f.path else path, f.message) for f in error.problems]
        except UnitError as error:
            faults.append(config.document.fault(path, str(error)))
    if faults:
        raise ConfigError(faults)
    return tuple(terms), fixed


def _maximum(entry: Uncertain, config: Config, observations: Observations | None) -> float | None:
    """The observed maximum in the parameter's unit, where the entry asks for it."""
    if observations is None or not entry.needs_data:
        return None
    return convert(float(observations.values.max()), config.observable.unit, entry.parameter.unit)
