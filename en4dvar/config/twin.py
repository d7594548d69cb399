"""A twin experiment from YAML: the file has a ``twin:`` section where others have ``data:``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from en4dvar.config.context import TEXT, Context, Made, quantity, read_each, subject_unit, time_unit
from en4dvar.config.document import Document
from en4dvar.config.initial_state import dynamic_fields
from en4dvar.config.load import read_file
from en4dvar.config.parameters import Entry, Fixed, Uncertain, entries
from en4dvar.config.schema import File, Output, Section, section_of
from en4dvar.config.validate import Faults
from en4dvar.cycling.sequential import SequentialSettings
from en4dvar.cycling.twin import TwinExperiment
from en4dvar.errors import ConfigError, DataError, Fault
from en4dvar.files import expanded
from en4dvar.forward import ForwardModel, Observable
from en4dvar.inputs.asked import Matrix
from en4dvar.inputs.square import read_covariance
from en4dvar.noise import Correlation
from en4dvar.prior import Prior
from en4dvar.schemes import ON_A_SERIES
from en4dvar.schemes.inflation import Inflation
from en4dvar.schemes.localisation import Localisation

FileName = Annotated[str, Field(min_length=1)]


def _errors(model: ForwardModel) -> dict[str, Observable]:
    return {f"{observable.name}_std": observable for observable in model.observables}


def _stds(known: Callable[[ForwardModel], Mapping[str, Any]]) -> Made:
    """Standard deviations by the name of a thing that the model knows."""

    positive = quantity(subject_unit, "positive")

    def read(given: Mapping[str, Any], context: Context) -> dict[str, float]:
        things = known(context.model)
        with Faults() as faults:
            if not given:
                faults.add((), f"give at least one of: {', '.join(things)}")
            return read_each(given, things, context, faults, positive.make)

    json = {"type": "object", "minProperties": 1, "additionalProperties": TEXT}
    return Made(read, dict[str, Any], json)


def _correlation(path: str, context: Context) -> tuple[str, Correlation]:
    """The absolute path and the matrix."""
    try:
        file = (context.base / expanded(path)).absolute()
        return str(file), Correlation(read_covariance(Matrix(file, "1", "1")))
    except (DataError, ValueError) as error:
        raise ConfigError(str(error)) from None


class Twin(Section):
    """How the truth is made and observed."""

    cycles: Annotated[int, Field(ge=1)]
    """Number of analyses."""
    burn_in: Annotated[int, Field(ge=0)] = 0
    """Cycles at the beginning that no score counts."""
    interval: Annotated[float, quantity(time_unit, "positive")]
    """Time between two observations, in the model's unit of time."""
    error: Annotated[dict[str, float], _stds(_errors)]
    """Std of the observation errors, by observable: ``<observable>_std``."""
    error_correlation: (
        Annotated[tuple[str, Correlation], Made(_correlation, Annotated[str, Field(min_length=1)])] | None
    ) = None
    """CSV file of the correlation of the errors at one instant, full or block diagonal, one row an observation, without
    header; relative to the configuration's folder. Default: independent errors."""
    initial_std: Annotated[dict[str, float], _stds(dynamic_fields)]
    """Std of the initial ensemble, by field of the state."""

    @model_validator(mode="after")
    def _something_counts(self) -> Self:
        if self.burn_in >= self.cycles:
            raise ValueError(f"burn_in ({self.burn_in}) leaves none of {self.cycles} cycles")
        return self

    def as_written(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As given, with an absolute path."""
        written = super().as_written(given)
        return written | ({"error_correlation": self.error_correlation[0]} if self.error_correlation else {})


class Local(Section):
    """Gaspari–Cohn taper over the indices of the observed field; it vanishes from ``2 radius`` on."""

    radius: Annotated[float, Field(gt=0)]
    """Radius of the taper, in indices: an observation has no influence from twice this distance on."""
    periodic: bool = False
    """The field is a circle: the last index is next to the first."""
    block_size: Annotated[int, Field(ge=1)] = 1
    """Neighbouring indices that share one analysis."""
    shape: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] | None = None
    """Cells along each axis of a field in two or three dimensions, the last running fastest; distances are then in
    cells of this grid. Default: the indices lie on a line."""

    @model_validator(mode="after")
    def _one_cell_each(self) -> Local:
        if self.shape and self.block_size > 1:
            raise ValueError("block_size: only without shape")
        return self


_KINDS = ON_A_SERIES
_KEYS = {name: {field.name for field in fields(kind)} for name, kind in _KINDS.items()}
_FOREIGN = {name: set().union(*_KEYS.values()) - keys for name, keys in _KEYS.items()}  # keys of other schemes
if TYPE_CHECKING:
    OnASeries = str
else:
    OnASeries = Literal[tuple(ON_A_SERIES)]


class _Scheme(Section):
    scheme: OnASeries
    """A filter (one analysis a cycle), or ienks (sliding-window smoother)."""
    members: Annotated[int, Field(ge=3)]
    """Ensemble size N."""


_Iterations: Any = section_of(*_KINDS.values(), base=_Scheme)


class Sequential(_Iterations):
    """The scheme and what it does to the ensemble."""

    inflation: Annotated[float, Field(gt=0)] = 1.0
    """Factor on the anomalies after each analysis; 1 is none."""
    rtps: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Relaxation to the prior spread, 0 (none) to 1."""
    rotation: bool = False
    """Rotate the ensemble at random after each analysis, mean and covariance kept."""
    localisation: Local | None = None
    """Gaspari–Cohn taper over the indices of the observed field."""
    stochastic_model: bool = False
    """true: accept a model that gives other numbers when a member is run again; by default that is an error."""

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        others = self.model_fields_set & _FOREIGN[self.scheme]
        if others:
            takers = [name for name, keys in _KEYS.items() if keys >= others]
            raise ValueError(f"{', '.join(sorted(others))}: only with scheme {' or '.join(takers)}")
        return self

    def built(self, localisation: Localisation | None) -> SequentialSettings:
        """What the loop needs."""
        scheme = _KINDS[self.scheme](**{key: getattr(self, key) for key in _KEYS[self.scheme]})
        inflation = Inflation(self.inflation, self.rtps)
        return SequentialSettings(
            scheme, inflation, self.rotation, localisation, stochastic_model=self.stochastic_model
        )

    def as_written(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As given, without what the scheme does not take."""
        written = super().as_written(given)
        return {key: value for key, value in written.items() if key not in _FOREIGN[self.scheme]}


class Workers(Section):
    """Where members are integrated; never changes the numbers. A cycle is short: one worker is the default."""

    workers: Annotated[int, Field(ge=1)] = 1
    """Parallel workers."""
    checkpoint_every: Annotated[float, Field(ge=0)] = 2.0
    """Seconds between two checkpoints, 0: one after every cycle. Each holds the moments of all cycles done."""


class TwinFile(File):
    """A twin experiment; ``model`` and ``parameters`` are as for an estimation."""

    parameters: Annotated[tuple[Entry, ...], entries("a twin experiment")] = Field({}, validate_default=True)
    """Parameters to estimate (a prior) or to change from the model's default (a quantity)."""
    twin: Twin
    """How the truth is made and observed."""
    assimilation: Sequential
    """The scheme and what it does to the ensemble."""
    execution: Workers = Workers()
    """Where members are integrated; never changes the numbers."""
    output: Output = Output()
    """Where results go."""

    @classmethod
    def rules(cls, given: Mapping[str, Any], context: Context, faults: Faults) -> None:
        twin, assimilation = given.get("twin"), given.get("assimilation")
        correlated = isinstance(twin, dict) and twin.get("error_correlation") is not None
        if correlated and isinstance(assimilation, dict) and assimilation.get("localisation"):
            message = "needs observations with independent errors, but twin.error_correlation is given"
            faults.add(("assimilation", "localisation"), message)
        units = {field.unit for field in dynamic_fields(context.model).values()}
        if len(units) > 1:
            faults.add(("model",), f"RMSE and spread need one unit, but the state has {', '.join(sorted(units))}")


@dataclass(frozen=True)
class TwinConfig:
    """A validated twin experiment."""

    document: Document
    name: str
    seed: int
    experiment: TwinExperiment
    scheme: str
    execution: Workers
    directory: Path
    report: bool
    resolved: str

    @property
    def text(self) -> str:
        """The file, verbatim."""
        return self.document.text


def resolve_twin(document: Document, base: Path) -> TwinConfig:
    """Validate a document with a ``twin:`` section. Raises :class:`ConfigError`, every fault at once."""
    read = read_file(TwinFile, document, base)
    file, model, twin = read.file, read.model, read.file.twin
    observed = {name.removesuffix("_std"): std for name, std in twin.error.items()}
    local = None
    if file.assimilation.localisation:
        try:
            local = _localisation(file.assimilation.localisation, model, observed.keys())
        except ConfigError as error:
            where = ("assimilation", "localisation")
            raise ConfigError([document.fault((*where, f.path) if f.path else where, f.message)
                               for f in error.problems]) from None  # fmt: skip
    terms = tuple(entry.term() for entry in file.parameters if isinstance(entry, Uncertain))
    experiment = TwinExperiment(
        model=model,
        sequential=file.assimilation.built(local),
        members=file.assimilation.members,
        cycles=twin.cycles,
        interval=twin.interval,
        error_std=observed,
        initial_std=twin.initial_std,
        burn_in=twin.burn_in,
        error_correlation=twin.error_correlation[1] if twin.error_correlation else None,
        prior=Prior(terms) if terms else None,
        fixed={entry.parameter.name: entry.value for entry in file.parameters if isinstance(entry, Fixed)},
    )
    return TwinConfig(
        document=document,
        name=file.name,
        seed=file.seed,
        experiment=experiment,
        scheme=file.assimilation.scheme,
        execution=file.execution,
        directory=file.output.directory or Path("runs") / file.name,
        report=file.output.report,
        resolved=read.resolved(()),
    )


def _localisation(settings: Local, model: ForwardModel, observed: Set[str]) -> Localisation:
    """Positions are indices of the one observed field, which fills the state but for the parameters.

    Raises :class:`ConfigError`.
    """
    fields = list(dynamic_fields(model).values())
    if len(fields) != 1 or observed != {fields[0].name}:
        raise ConfigError("needs a model whose state is one field, and this field observed")
    (field,) = fields
    if settings.shape:
        if math.prod(settings.shape) != field.size:
            cells = " x ".join(map(str, settings.shape))
            raise ConfigError([Fault(f"{cells} cells, but {field.name} has {field.size}", "shape")])
        where = np.arange(model.layout.size)[model.layout[field.name]]
        return Localisation.on_grid(where, settings.shape, settings.radius, settings.periodic)
    positions = np.arange(field.size, dtype=float)
    state = np.full(model.layout.size, np.nan)
    state[model.layout[field.name]] = positions
    period = float(field.size) if settings.periodic else None
    return Localisation.on_line(state, positions, settings.radius, period, settings.block_size)
