"""From a configuration to the experiments it plans: every combination of its knobs, as problems without readings."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from en4dvar.assembly.build import data_files, inverse_plan, problem_of
from en4dvar.assembly.reading import errors_of, read_observations
from en4dvar.config import Config, resolve
from en4dvar.config.design import Value
from en4dvar.config.document import Document, override
from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Series
from en4dvar.ensemble.forecast import forecast
from en4dvar.inputs.asked import DataFile
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar.problem import InverseProblem


@dataclass(frozen=True)
class Candidate:
    """A design: what its knobs are set to, and the configuration that this makes. Without settings: as in the file.

    ``laws``: the same configuration with each of the laws that are to be told apart.
    """

    settings: Mapping[str, Value]
    config: Config
    laws: tuple[Config, ...] = ()

    @classmethod
    def of(cls, settings: Mapping[str, Value], document: Document, base: Path) -> "Candidate":
        """From the document that the settings make. Raises :class:`ConfigError`."""
        config = resolve(document, base)
        laws = (resolve(override(document, keys), base) for keys in config.design.laws.values())
        return cls(settings, config, tuple(laws))


def candidates(document: Document, base: Path) -> Iterator[Candidate]:
    """The file's own design, then every combination of its knobs. Raises :class:`ConfigError`."""
    first = Candidate.of({}, document, base)
    yield first
    design = first.config.design
    if design.knobs:
        for settings in design.settings():
            overrides = {design.knobs[name].key: value for name, value in settings.items()}
            yield Candidate.of(settings, override(document, overrides), base)


def planned_problem(config: Config) -> InverseProblem:
    """The inverse problem of an experiment that is yet to be made.

    Its readings are those of the model at the centre of the prior, of which errors may be a share.

    Raises
    ------
    ConfigError: no times, or something that only readings can say. DataError: a data file that is needed cannot be
        used. En4dvarError: the model fails at the centre of the prior.
    """
    plan, times = inverse_plan(config), _planned_times(config)
    measured = None
    for name, file in files_needed(config).items():
        measured = read_observations(plan, file, name, config.weights)
    if config.weights != "sum":
        raise ConfigError([config.document.fault(("assimilation", "weights"), "only 'weights: sum' is Bayesian")])
    if times is None and measured is not None:
        return problem_of(config, measured)
    assert times is not None
    for series in plan.series:
        error = series.data.error
        for present, what in (
            (bool(error.columns("", "")), "errors in a column of the file"),
            (error.covariance is not None, "a covariance of readings"),
            (series.data.weights is not None, "weights of readings"),
            (series.data.places is not None, "places on a field"),
        ):
            if present:
                raise ConfigError(
                    f"data: {what} cannot be planned at design.times; leave design.times out, or state a std"
                )
    scale = 1.0 if measured is None else float(measured.values.max())  # for priors that refer to the largest reading
    blank = _observations(config, [np.full(len(times), scale)] * len(plan.series), times, measured)
    problem = problem_of(config, blank)
    run = forecast(problem, problem.prior.mean[None])
    if run.failures[0]:
        raise En4dvarError(f"the model fails at the centre of the prior: {run.failures[0]}")
    values = np.split(run.predictions[0], len(plan.series))
    return replace(problem, observations=_observations(config, values, times, measured, stated=True))


def _planned_times(config: Config) -> Array | None:
    return config.design.times if config.design.times is not None else config.simulate_times


def files_needed(config: Config) -> dict[str, DataFile]:
    """The data file, by its name, that a plan takes its times or a prior's ``maximum`` from, if it needs one.

    Raises :class:`ConfigError`, :class:`DataError`: there is none.
    """
    if _planned_times(config) is not None and not any(entry.needs_data for entry in config.parameters):
        return {}
    return dict([next(iter(data_files(inverse_plan(config)).items()))])


def _observations(
    config: Config, values: list[Array], times: Array, measured: Observations | None, stated: bool = False
) -> Observations:
    """Readings of all series at ``times``, with the errors that the file has ``stated``."""
    plan = inverse_plan(config)
    series = [
        Series(
            observable=planned.observable,
            times=times,
            values=own,
            noise=errors_of(planned.data, times, own, np.arange(len(times)), {})
            if stated
            else noise_of(np.ones(len(times)), np.zeros(len(times))),
            name=planned.name,
            group=planned.group,
            scalars=measured.scalars if measured else {},
            source=measured.source if measured else "",
        )
        for planned, own in zip(plan.series, values, strict=True)
    ]
    return Observations.of_series(series, plan.correlation if stated else {}, config.name)
