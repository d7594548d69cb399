"""Files of other kinds than an estimation: a series that is assimilated cycle by cycle, and synthetic readings.

A twin experiment has a section ``twin:`` where others have ``data:``, a series of data ``sequence:`` beside it, a
synthetic campaign ``campaign:``.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidatorFunctionWrapHandler, WrapValidator

from en4dvar.config.context import Context, Faults, Made
from en4dvar.config.data import DATA, DataPlan
from en4dvar.config.dependence import A_FILE
from en4dvar.config.document import Document
from en4dvar.config.load import Read, Validated, read_file
from en4dvar.config.of_readings import BESIDE
from en4dvar.config.parameters import Entry, Fixed, Uncertain, entries
from en4dvar.config.quantities import Spread, quantity, time_unit
from en4dvar.config.schema import File, Name, Output, Section
from en4dvar.config.sequential import Sequential, Workers, error_rates, localisation_of, stds
from en4dvar.config.varies import MODEL_ERROR, ErrorOf, dynamic_fields
from en4dvar.data.noise import Correlation
from en4dvar.inputs.members import read_covariance
from en4dvar.inputs.parts import Matrix
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.plumbing.hints import shown, suggest
from en4dvar.plumbing.units import parse_quantity
from en4dvar.priors.prior import Prior, PriorTerm
from en4dvar.series.start import EnsembleCoordinates, InitialEnsemble
from en4dvar.series.twin import TwinExperiment


class Twin(Section):
    """How the truth is made and observed."""

    cycles: Annotated[int, Field(ge=1)]
    """Number of analyses."""
    burn_in: Annotated[int, Field(ge=0)] = 0
    """Cycles at the beginning that are left out of the scores."""
    interval: Annotated[float, quantity(time_unit, "positive")]
    """Time between two observations, in the model's unit of time."""
    error: Annotated[dict[str, float], stds(lambda model: {f"{o.name}_std": o for o in model.observables})]
    """Std of the observation errors, by observable: ``<observable>_std``."""
    error_correlation: Annotated[Path, A_FILE] | None = None
    """CSV file of the correlation of the errors at one instant, full or block diagonal, one row an observation, without
    header; relative to the configuration's folder. Default: independent errors."""
    initial_std: Annotated[dict[str, float], stds(dynamic_fields)]
    """Std of the initial ensemble, by field of the state."""

    def check_values(self, faults: Faults) -> None:
        if self.burn_in >= self.cycles:
            raise ValueError(f"burn_in ({self.burn_in}) leaves none of {self.cycles} cycles")


class TwinFile(File):
    """A twin experiment; ``model`` and ``parameters`` are as for an estimation."""

    parameters: Annotated[tuple[Entry, ...], entries("a twin experiment")] = Field({}, validate_default=True)
    """Parameters to estimate (a prior) or to change from the model's default (a quantity)."""
    twin: Twin
    model_error: Annotated[tuple[ErrorOf, ...], MODEL_ERROR] | None = None
    """Fields of the state that the model misses in part, of the truth as well: each changes at random between two
    observations, its variance growing by ``std`` squared in a time of ``every``."""
    assimilation: Sequential
    execution: Workers = Workers()
    output: Output = Output()

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        twin, assimilation = keys.get("twin"), keys.get("assimilation")
        correlated = isinstance(twin, dict) and twin.get("error_correlation") is not None
        if correlated and isinstance(assimilation, dict) and assimilation.get("localisation"):
            message = "needs observations with independent errors, but twin.error_correlation is given"
            faults.add(("assimilation", "localisation"), message)
        units = {field.unit for field in dynamic_fields(context.model).values()}
        if len(units) > 1:
            faults.add(("model",), f"RMSE and spread need one unit, but the state has {', '.join(sorted(units))}")


@dataclass(frozen=True, kw_only=True)
class TwinConfig(Validated):
    """A validated twin experiment."""

    experiment: TwinExperiment
    scheme: str
    execution: Workers


def terms_and_fixed(entries: tuple[Entry, ...]) -> tuple[tuple[PriorTerm, ...], dict[str, float]]:
    """The priors and the values of entries that need no data."""
    terms = tuple(entry.term() for entry in entries if isinstance(entry, Uncertain))
    return terms, {entry.parameter.name: entry.value for entry in entries if isinstance(entry, Fixed)}


def resolve_twin(document: Document, base: Path) -> TwinConfig:
    """Validate a document with a ``twin:`` section. Raises :class:`ConfigError`, every fault at once."""
    read = read_file(TwinFile, document, base)
    file, model, twin = read.file, read.model, read.file.twin
    observed = {name.removesuffix("_std"): std for name, std in twin.error.items()}
    local = None
    if file.assimilation.localisation:
        with document.placing("assimilation", "localisation"):
            local = localisation_of(file.assimilation.localisation, model, observed.keys())
    terms, fixed = terms_and_fixed(file.parameters)
    prior = Prior(terms) if terms else None
    with document.placing():
        rate = error_rates(model, file.model_error or ())
    correlation = None
    if twin.error_correlation:
        with document.placing("twin", "error_correlation"), retold((DataError, ValueError), ConfigError):
            correlation = Correlation(read_covariance(Matrix(twin.error_correlation, "1", "1")))
    coordinates = EnsembleCoordinates.of(model, prior)
    experiment = TwinExperiment(
        start=InitialEnsemble(model, twin.initial_std, prior, fixed, coordinates),
        sequential=file.assimilation.built(local, rate, coordinates),
        members=file.assimilation.members,
        cycles=twin.cycles,
        interval=twin.interval,
        error_std=observed,
        burn_in=twin.burn_in,
        error_correlation=correlation,
    )
    if correlation is not None:
        with document.placing():
            _ = experiment.widths  # before anything is run
    return read.validated(TwinConfig, experiment=experiment, scheme=file.assimilation.scheme)


def _known_fields(names: tuple[str, ...], context: Context) -> tuple[str, ...]:
    known = dynamic_fields(context.model)
    with Faults() as faults:
        for k, name in enumerate(names):
            if name not in known:
                faults.add((k,), f"unknown field {shown(name)}{suggest(name, known)}")
    return names


class Sequence(Section):
    """The prior of the state at time zero, and the results that are kept."""

    initial_std: Annotated[dict[str, Spread], stds(dynamic_fields, relative=True)] = Field({}, validate_default=True)
    """Spread of the model's initial state, by field, each of its values for itself: in the field's unit, or in % of a
    field that is positive and then estimated by its logarithm."""
    positive: Annotated[tuple[str, ...], Made(_known_fields, tuple[str, ...])] = ()
    """Further fields that are estimated by their logarithm, of what exceeds their lower bound: none falls below it."""
    members_every: Annotated[int, Field(ge=0)] = 0
    """The ensemble is stored after each so many observation times, and at the end; 0: at the end only."""


class SequenceFile(File):
    """A series of data, assimilated by a filter or a smoother of a sliding window."""

    data: DATA
    """Where the observations are, what they mean and how well they are known."""
    parameters: Annotated[tuple[Entry, ...], entries("a sequence", data=True)] = Field({}, validate_default=True)
    """For each parameter a prior (estimated beside the state), a quantity or a scalar of the data file (fixed)."""
    sequence: Sequence
    model_error: Annotated[tuple[ErrorOf, ...], MODEL_ERROR] | None = None
    """Fields of the state that the model misses in part: each changes at random between two observations, its variance
    growing by ``std`` squared in a time of ``every``."""
    assimilation: Sequential
    execution: Workers = Workers()
    output: Output = Output()

    @classmethod
    def rules(cls, keys: Mapping[str, Any], context: Context, faults: Faults) -> None:
        for place, error in _errors({"data": keys.get("data")}):
            for key in BESIDE:
                if key in error and (key != "discrepancy" or "series" not in place):  # which several series never have
                    message = "not in a sequence, where the errors of every instant are Gaussian and for themselves"
                    faults.add((*place, key), message, at_key=True)
        if not context.model.resumable:
            faults.add(("model",), "has no step: it cannot go on from a state on its way, as a sequence needs")


def _errors(keys: Mapping[str, Any], *above: str) -> Iterator[tuple[tuple[str, ...], Mapping[str, Any]]]:
    """The sections of errors, of one series or of several, and where they are."""
    for key, section in keys.items():
        if isinstance(section, dict):
            if key == "error":
                yield (*above, key), section
            yield from _errors(section, *above, key)


@dataclass(frozen=True, kw_only=True)
class SequenceConfig(Validated):
    """A validated configuration of a sequence. Nothing of the data file has been read yet."""

    observable: Observable
    data: DataPlan
    parameters: tuple[Entry, ...]
    sequence: Sequence
    model_error: tuple[ErrorOf, ...] = ()
    assimilation: Sequential
    execution: Workers
    scheme: str


def resolve_sequence(document: Document, base: Path, model: ForwardModel | None = None) -> SequenceConfig:
    """Validate a document with a ``sequence:`` section. Raises :class:`ConfigError`, every fault at once."""
    read: Read[SequenceFile] = read_file(SequenceFile, document, base, model)
    file = read.file
    faults = [
        document.fault(("sequence", "initial_std", name), "give it in %: the field is positive")
        for name in file.sequence.positive
        if name in file.sequence.initial_std and not file.sequence.initial_std[name].relative
    ]
    uncertain = file.sequence.initial_std or any(isinstance(entry, Uncertain) for entry in file.parameters)
    if not uncertain:
        faults.append(document.fault(("sequence",), "nothing is uncertain: give initial_std, or a parameter a prior"))
    if faults:
        raise ConfigError(faults)
    observable = file.data.series[0].observable
    return read.validated(SequenceConfig, observable=observable, scheme=file.assimilation.scheme)


class GroupSection(Section):
    """Data sets of one kind: how many, and what their parameters are drawn from."""

    datasets: Annotated[int, Field(ge=1, le=999)]
    """How many data sets."""
    parameters: Annotated[tuple[Entry, ...], entries("a campaign")]
    """What their truths are drawn from: a prior (drawn for each) or a quantity (common to all)."""


def _ascending(written: Any, validate: ValidatorFunctionWrapHandler) -> tuple[float, float]:
    low, high = validate(written)
    if low is not None and low > high:
        raise ValueError(f"{written[0]} is larger than {written[1]}")
    return low, high


NOUGHT = ("0", "0.0")  # needs no unit
End = Annotated[float, Made(lambda text, c: 0.0 if str(text) in NOUGHT else parse_quantity(text, time_unit(c)))]
Interval = Annotated[tuple[End, End], WrapValidator(_ascending)]
Width = Annotated[float, quantity(time_unit, "positive")]


def _below(directory: str, context: Context) -> Path:
    base = Path(os.path.abspath(context.base))  # a link may lead elsewhere, the configuration may not
    if base not in Path(os.path.abspath(base / directory)).parents:
        raise ValueError(f"must be a folder below {base}")
    return context.base / directory


class CampaignSection(Section):
    """How the truths are observed, in the model's units. Pairs are the ends of uniform distributions."""

    directory: Annotated[Path, Made(_below, Annotated[str, Field(min_length=1)])]
    """Folder of the data files, relative to the configuration's."""
    first: Interval
    """Instant of the first reading."""
    spacing: Annotated[tuple[Width, Width], WrapValidator(_ascending)]
    """Time between two readings."""
    stop: Annotated[float, Field(gt=0, lt=1)]
    """Readings end with the first one below this times the largest so far."""
    most: Annotated[int, Field(ge=3, le=100_000)] = 60
    """Largest number of readings."""
    fewest: Annotated[int, Field(ge=3)] = 5
    """A data set with fewer readings is drawn again."""
    noise: Annotated[float, quantity(lambda context: context.units.observables[0].unit, "positive", error=True)]
    """Std of the error of a reading, in the observable's unit."""
    time_shift: Interval = (0.0, 0.0)
    """t_s: a reading told at t was taken at t + t_s."""
    groups: Annotated[dict[Name, GroupSection], Field(min_length=1)]
    """Data sets of one kind, by name."""

    def check_values(self, faults: Faults) -> None:
        first, shift = self.first[0], self.time_shift[0]
        if None not in (first, shift) and first + shift < 0:
            faults.add(("first",), "the first reading could be taken before time zero")


class CampaignFile(File):
    """A synthetic campaign: what is drawn, and how it is observed."""

    name: Name
    """Name of the campaign."""
    campaign: CampaignSection


def resolve_campaign(document: Document, base: Path) -> Read[CampaignFile]:
    """Validate a document with a ``campaign:`` section. Raises :class:`ConfigError`, every fault at once."""
    return read_file(CampaignFile, document, base)
