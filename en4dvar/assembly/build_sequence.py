"""Settings of a sequence → the series to assimilate: reads the data file, and evaluates what refers to it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from en4dvar.assembly.build import data_files, resolve_parameters
from en4dvar.assembly.reading import read_observations
from en4dvar.config.parameters import Uncertain
from en4dvar.config.sequence import SequenceConfig
from en4dvar.config.sequential import SeriesLocalisation, error_rates, localisation_of, per_time
from en4dvar.config.series import DataPlan
from en4dvar.inputs.asked import DataFile
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.schemes.localisation import BlockLocalisation
from en4dvar.series.problem import SeriesProblem
from en4dvar.series.series import AtPlaces
from en4dvar.series.start import EnsembleCoordinates, InitialEnsemble


def sequence_data(config: SequenceConfig) -> dict[str, DataFile]:
    """The data set, by its name. Raises :class:`DataError`: there are several."""
    files = data_files(DataPlan.of(config.data, config.observable))
    if len(files) > 1:
        raise DataError(f"a sequence is one data set, but there are {len(files)}: {', '.join(files)}")
    return files


def build_sequence(config: SequenceConfig) -> SeriesProblem:
    """The series and how it is assimilated. Raises :class:`ConfigError`, :class:`DataError`."""
    plan = DataPlan.of(config.data, config.observable)
    ((name, file),) = sequence_data(config).items()
    observations = read_observations(plan, file, name)
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
    plan = DataPlan.of(config.data, config.observable)
    operators = [read.operator for read in problem.observables]
    with config.document.placing("assimilation", "localisation"):
        if problem.series.correlation is not None:
            raise ConfigError("needs observations with independent errors")
        if not all(isinstance(operator, AtPlaces) for operator in operators):
            raise ConfigError("needs readings of a field: data.places")
        places = [operator.places for operator in operators if isinstance(operator, AtPlaces)]
        cells = np.concatenate([np.sum(at.indices * at.shares, axis=1) for at in places])
        return localisation_of(asked, config.model, {series.observable.name for series in plan.series}, cells)


def _walks(config: SequenceConfig, terms: Sequence[PriorTerm]) -> Array:
    """Variance (n_state,) per unit of time of parameters that vary, in the coordinates of their priors."""
    rate, by_name = np.zeros(config.model.layout.size), {term.parameter.name: term for term in terms}
    for entry in config.parameters:
        if not isinstance(entry, Uncertain) or entry.spec.varies is None:
            continue
        name = entry.parameter.name
        with config.document.placing("parameters", name, "varies"):
            std = entry.spec.varies.std_of(by_name[name])
        rate[config.model.layout[name]] = per_time(entry.spec.varies, std, f"parameters.{name}.varies")
    return rate
