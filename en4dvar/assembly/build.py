"""Settings → problems and series: reads the data files, cuts the windows, evaluates what refers to the data."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from en4dvar.assembly.reading import find_files, read_observations, with_parts
from en4dvar.config import Config
from en4dvar.config.data import DataPlan, SeriesPlan
from en4dvar.config.kinds import SequenceConfig
from en4dvar.config.parameters import READINGS, Fixed, Scalar, Tied, Uncertain, inside_bounds
from en4dvar.config.quantities import Spread
from en4dvar.config.sequential import SeriesLocalisation, error_rates, localisation_of, per_time
from en4dvar.config.varies import Estimated, Perturbed, VariesSection, modes_of
from en4dvar.data.observations import Observations
from en4dvar.descent.field_data import gain_of
from en4dvar.descent.start import given
from en4dvar.ensemble.forecast import check_problem
from en4dvar.ensemble.tangent import derivatives_of
from en4dvar.inputs.parts import Column, DataFile, Layout
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, DataError, Fault, retold
from en4dvar.plumbing.hints import beside
from en4dvar.plumbing.units import convert
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.priors.varying import RandomWalk, Varying
from en4dvar.problem import InverseProblem, Tie, discrepancy_parameters
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.problem import SeriesProblem
from en4dvar.series.series import AtPlaces
from en4dvar.series.start import EnsembleCoordinates, InitialEnsemble


def build(config: Config) -> tuple[InverseProblem, ...]:
    """One inverse problem a data set, in the order of the paths (of a glob: sorted).

    Raises :class:`ConfigError`: there is no ``data:`` section, nothing is estimated, or a prior does not suit the data.
    :class:`DataError`: data files cannot be used; names every one of them.
    """
    problems: list[InverseProblem] = []
    unusable: list[DataError] = []
    for name, file in estimated_files(config).items():
        try:
            problems.append(build_one(config, name, file))
        except DataError as error:
            unusable.append(error)
    if unusable:
        raise DataError("\n".join(map(str, unusable)))
    return tuple(problems)


def inverse_plan(config: Config) -> DataPlan:
    """How the observations are read. Raises :class:`ConfigError` without data or without anything to estimate."""
    if config.data is None:
        raise ConfigError([Fault("required: it says where the observations are", "data", config.document.file)])
    uncertain = any(isinstance(entry, Uncertain) for entry in config.parameters)
    if not (uncertain or config.initial_state or config.model_error):
        message = "no parameter has a prior, nor is there initial_state or model_error; nothing to estimate"
        raise ConfigError([config.document.fault(("parameters",), message)])
    return config.data


def estimated_files(config: Config) -> dict[str, DataFile]:
    """The :func:`data_files` of an estimation. Raises :class:`ConfigError` where there is nothing to estimate, or the
    experiment is only planned; :class:`DataError` as they do.
    """
    files = data_files(inverse_plan(config))
    if "design" in config.document.data and not any(file.path.exists() for file in files.values()):
        message = "no such file; an experiment that is still to come is for 'en4dvar design'"
        raise ConfigError([config.document.fault(("data", "path"), message)])
    return files


def build_one(config: Config, name: str, file: DataFile) -> InverseProblem:
    """The inverse problem of one of :func:`data_files`. Raises :class:`ConfigError`, :class:`DataError`."""
    return problem_of(config, read_observations(inverse_plan(config), file, name, config.weights))


def problem_of(config: Config, observations: Observations) -> InverseProblem:
    """The inverse problem of observations, wherever they come from. Raises :class:`ConfigError`."""
    terms, fixed = resolve_parameters(config, observations)
    asked = config.assimilation
    perturbed = [start for start in config.initial_state if isinstance(start, Perturbed)]
    fields = tuple(prior for prior in config.initial_state if isinstance(prior, FieldPrior))
    if asked.localisation is None:
        with config.document.placing():
            perturbed += [mode for prior in fields for mode in modes_of(prior)]
        fields = ()
    terms = (*terms, *(start.term for start in perturbed), *discrepancy_terms(config, observations))
    estimated = {term.parameter.name for term in terms}
    following = (entry for entry in config.parameters if isinstance(entry, Tied) and entry.to in estimated)
    tied = tuple(Tie(entry.parameter, entry.to, entry.factor) for entry in following)
    perturbations = tuple(start.perturbation for start in perturbed)
    varying = _varying(config, observations, terms)
    count, localised = len(terms) + sum(len(change.terms) for change in varying), asked.localisation is not None
    if asked.sampling == "exact" and asked.members <= count and not localised:
        modes = sum(bool(effect.pattern) for effect in perturbations)
        of_fields = f", {modes} of them modes of fields (or say how many: modes, or localisation)" if modes else ""
        message = f"{asked.members} are too few for {count} parameters{of_fields}; at least {count + 1}"
        raise ConfigError([config.document.fault(("assimilation", "members"), message)])
    prior = Prior(terms, config.dependence)
    problem = InverseProblem(config.model, config.observable, observations, prior, fixed, perturbations, tied, fields)
    if varying:
        problem = problem.varied(varying)
    with config.document.placing():
        check_problem(problem)
    minimiser = asked.own.minimiser
    if minimiser and not isinstance(minimiser.start, str):
        with config.document.placing("assimilation", "start"):
            given(problem, minimiser.start)
    with config.document.placing():
        derivatives_of(problem, getattr(minimiser, "linearisation", ""))
    if localised:
        with config.document.placing("assimilation", "localisation"):
            gain_of(problem, asked)
    return problem


def _varying(config: Config, observations: Observations, terms: Sequence[PriorTerm]) -> list[Varying]:
    """Parameters and model errors that vary in time; knots that do not suit the observations raise ConfigError."""
    model, by_name = config.model, {term.parameter.name: term for term in terms}
    varying: list[Varying] = []
    for name, said in _said_to_vary(config):
        with config.document.placing("parameters", name, "varies"):
            knots, estimated = said.knots(observations), isinstance(said.std, Estimated)
            varying.append(RandomWalk.of(model, by_name[name], knots, said.std_of(by_name[name]), estimated))
    for error in config.model_error:
        with config.document.placing("model_error", error.field.name):
            varying.append(error.changes(model, observations))
    return varying


def _said_to_vary(config: Config | SequenceConfig) -> Iterator[tuple[str, VariesSection]]:
    """Names of the parameters that vary in time, and how."""
    for entry in config.parameters:
        if isinstance(entry, Uncertain) and entry.spec.varies is not None:
            yield entry.parameter.name, entry.spec.varies


def discrepancy_terms(config: Config, observations: Observations) -> tuple[PriorTerm, ...]:
    """Priors of the discrepancy that the observations allow for."""
    asked = None if config.data is None else config.data.series[0].data.error.discrepancy
    if asked is None or not observations.noise.discrepant:
        return ()
    first, last = observations.span
    parameters = discrepancy_parameters(config.model, config.observable)
    return asked.terms(parameters, float(observations.values.max()), last - first)


def data_files(plan: DataPlan) -> dict[str, DataFile]:
    """Name of the data set → file: the file's stem, made unique by its folders, then by a number.

    A name of its own (``data.name``) goes before. Data sets of one file have the name of their part behind its name.
    Several series name as many files each: of one data set the first series gives the name, of several they have the
    same names in every series.

    Raises :class:`DataError`: no file matches a pattern, or a file is named twice; series that do not go together.
    """
    files_of_series = [_files_of(series) for series in plan.series]
    first, *others = files_of_series
    if (own := plan.series[0].data.name) is not None:
        if len(first) != 1:
            raise DataError(f"name: {own} is that of one data set, and there are {len(first)}; leave it out")
        first = {own: next(iter(first.values()))}
    for series, files in zip(plan.series[1:], others, strict=True):
        if len(files) != len(first) or (len(first) > 1 and files.keys() != first.keys()):
            rest = [name for name in (*first, *files) if (name in first) != (name in files)]
            counts = f"series {series.name} has {len(files)} data sets, {plan.series[0].name} has {len(first)}"
            lacking = f"; not so {rest[0]}" if rest else ""
            raise DataError(f"{counts}; each data set needs a file of the same name in every series{lacking}")
    return {
        name: replace(file, others=tuple(files.get(name) or next(iter(files.values())) for files in others))
        for name, file in first.items()
    }


def needed_file(config: Config, times: object) -> dict[str, DataFile]:
    """The first data set, by its name, where times (None) or values of parameters come from it; else none.

    Raises :class:`ConfigError`: a value needs a file that is not there. :class:`DataError` as :func:`data_files` does.
    """
    asking = [entry.parameter.name for entry in config.parameters if entry.needs_data]
    if config.data is None or (times is not None and not asking):
        return {}
    name, file = next(iter(data_files(config.data).items()))
    if asking and not file.path.exists():
        words = f"takes a value from {file.path}: {beside(file.path)}; for an experiment to come, give a quantity"
        raise ConfigError([config.document.fault(("parameters", asked), words) for asked in asking])
    return {name: file}


def _files_of(series: SeriesPlan) -> dict[str, DataFile]:
    data = series.data
    with retold(DataError, DataError, "", series.name):
        files = find_files(Path(), data.path)
    time = data.columns.time.name if isinstance(data.columns.time, Column) else None
    return with_parts(files, data.columns.observable, data.part(Layout), time)


def resolve_parameters(
    config: Config | SequenceConfig, observations: Observations | None
) -> tuple[tuple[PriorTerm, ...], dict[str, float]]:
    """Prior terms and fixed values, evaluated on the data where they refer to them. Raises :class:`ConfigError`: every
    entry that cannot be evaluated, located in the file.
    """
    terms: list[PriorTerm] = []
    fixed: dict[str, float] = {}
    faults: list[Fault] = []
    tied: list[Tied] = []
    for entry in config.parameters:
        with config.document.collecting(faults, "parameters", entry.parameter.name):
            if isinstance(entry, Fixed):
                fixed[entry.parameter.name] = entry.value
            elif isinstance(entry, Uncertain):
                unit = entry.parameter.unit
                terms.append(entry.term(_of_data(config, observations, unit) if observations is not None else None))
            elif isinstance(entry, Tied):
                tied.append(entry)
            elif observations is None:
                raise ConfigError("the value comes from the data file, and there is none; set a value")
            else:
                fixed[entry.parameter.name] = entry.value(observations.scalars, observations.source)
    for entry in tied:
        if entry.to in fixed:
            with config.document.collecting(faults, "parameters", entry.parameter.name):
                fixed[entry.parameter.name] = inside_bounds(fixed[entry.to] * entry.factor, entry.parameter)
    if faults:
        raise ConfigError(faults)
    return tuple(terms), fixed


def _of_data(
    config: Config | SequenceConfig, observations: Observations, unit: str
) -> Callable[[Spread | Scalar], float]:
    """What a location of a prior is that the data say, in the parameter's ``unit``."""

    def value(where: Spread | Scalar) -> float:
        if isinstance(where, Scalar):
            return where.value(observations.scalars, observations.source)
        if observations.parts:
            raise ConfigError(f"'{where.whole}' is defined only for a single series without places; give a value")
        return where.value * convert(READINGS[where.whole](observations.values), config.observable.unit, unit)

    return value


def sequence_data(config: SequenceConfig) -> dict[str, DataFile]:
    """The data set, by its name. Raises :class:`DataError`: there are several."""
    files = data_files(config.data)
    if len(files) > 1:
        raise DataError(f"a sequence is one data set, but there are {len(files)}: {', '.join(files)}")
    return files


def build_sequence(config: SequenceConfig) -> SeriesProblem:
    """The series and how it is assimilated. Raises :class:`ConfigError`, :class:`DataError`."""
    ((name, file),) = sequence_data(config).items()
    observations = read_observations(config.data, file, name)
    terms, fixed = resolve_parameters(config, observations)
    positive = {name for name, spread in config.sequence.initial_std.items() if spread.relative}
    positive |= set(config.sequence.positive)
    prior = Prior(terms) if terms else None
    coordinates = EnsembleCoordinates.of(config.model, prior, sorted(positive))
    with config.document.placing():
        rate = error_rates(config.model, config.model_error, positive) + _walks(config, terms)
        settings = config.assimilation.built(None, rate, coordinates)
    std = {name: spread.value for name, spread in config.sequence.initial_std.items()}
    start = InitialEnsemble(config.model, std, prior, fixed, coordinates)
    settings = replace(settings, members_every=config.sequence.members_every)
    problem = SeriesProblem.of(start, config.observable, observations, settings, config.assimilation.members)
    if config.assimilation.localisation is None:
        return problem
    local = _localisation(config, config.assimilation.localisation, problem)
    return replace(problem, settings=replace(problem.settings, localisation=local))


def _localisation(config: SequenceConfig, asked: SeriesLocalisation, problem: SeriesProblem) -> BlockLocalisation:
    """By the distance between cells of the field and the places that were read. Raises :class:`ConfigError`."""
    read = [o.operator.places for o in problem.observables if isinstance(o.operator, AtPlaces)]
    with config.document.placing("assimilation", "localisation"):
        if problem.series.correlation is not None:
            raise ConfigError("needs observations with independent errors")
        if len(read) < len(problem.observables):
            raise ConfigError("needs readings of a field: data.places")
        cells = np.concatenate([np.sum(at.indices * at.shares, axis=1) for at in read])
        return localisation_of(asked, config.model, {series.observable.name for series in config.data.series}, cells)


def _walks(config: SequenceConfig, terms: Sequence[PriorTerm]) -> Array:
    """Variance (n_state,) per unit of time of parameters that vary, in the coordinates of their priors."""
    rate, by_name = np.zeros(config.model.layout.size), {term.parameter.name: term for term in terms}
    for name, said in _said_to_vary(config):
        with config.document.placing("parameters", name, "varies"):
            std = said.std_of(by_name[name])
        rate[config.model.layout[name]] = per_time(said, std, f"parameters.{name}.varies")
    return rate
