"""A twin experiment from YAML: the file has a ``twin:`` section where others have ``data:``."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from en4dvar.config.context import Context, Made, quantity, time_unit
from en4dvar.config.document import Document
from en4dvar.config.initial_state import dynamic_fields
from en4dvar.config.load import Validated, read_file
from en4dvar.config.parameters import Entry, Fixed, Uncertain, entries
from en4dvar.config.schema import File, Output, Section
from en4dvar.config.sequential import Sequential, Workers, error_rates, localisation_of, stds
from en4dvar.config.validate import Faults
from en4dvar.config.varies import MODEL_ERROR, ErrorOf
from en4dvar.data.noise import Correlation
from en4dvar.inputs.asked import Matrix
from en4dvar.inputs.square import read_covariance
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.plumbing.errors import ConfigError, DataError, retold
from en4dvar.priors.prior import Prior
from en4dvar.series.start import EnsembleCoordinates
from en4dvar.series.twin import TwinExperiment


def _errors(model: ForwardModel) -> dict[str, Observable]:
    return {f"{observable.name}_std": observable for observable in model.observables}


def _correlation(path: str, context: Context) -> tuple[str, Correlation]:
    """The absolute path and the matrix."""
    with retold((DataError, ValueError), ConfigError):
        file = context.path(path)
        return str(file), Correlation(read_covariance(Matrix(file, "1", "1")))


class Twin(Section):
    """How the truth is made and observed."""

    cycles: Annotated[int, Field(ge=1)]
    """Number of analyses."""
    burn_in: Annotated[int, Field(ge=0)] = 0
    """Cycles at the beginning that are left out of the scores."""
    interval: Annotated[float, quantity(time_unit, "positive")]
    """Time between two observations, in the model's unit of time."""
    error: Annotated[dict[str, float], stds(_errors)]
    """Std of the observation errors, by observable: ``<observable>_std``."""
    error_correlation: (
        Annotated[tuple[str, Correlation], Made(_correlation, Annotated[str, Field(min_length=1)])] | None
    ) = None
    """CSV file of the correlation of the errors at one instant, full or block diagonal, one row an observation, without
    header; relative to the configuration's folder. Default: independent errors."""
    initial_std: Annotated[dict[str, float], stds(dynamic_fields)]
    """Std of the initial ensemble, by field of the state."""

    @model_validator(mode="after")
    def _something_counts(self) -> Self:
        if self.burn_in >= self.cycles:
            raise ValueError(f"burn_in ({self.burn_in}) leaves none of {self.cycles} cycles")
        return self

    def as_written(self, source: Mapping[str, Any]) -> dict[str, Any]:
        """The section as it was written, with an absolute path."""
        written = super().as_written(source)
        return written | ({"error_correlation": self.error_correlation[0]} if self.error_correlation else {})


class TwinFile(File):
    """A twin experiment; ``model`` and ``parameters`` are as for an estimation."""

    parameters: Annotated[tuple[Entry, ...], entries("a twin experiment")] = Field({}, validate_default=True)
    """Parameters to estimate (a prior) or to change from the model's default (a quantity)."""
    twin: Twin
    """How the truth is made and observed."""
    model_error: Annotated[tuple[ErrorOf, ...], MODEL_ERROR] | None = None
    """Fields of the state that the model misses in part, of the truth as well: each changes at random between two
    observations, its variance growing by ``std`` squared in a time of ``every``."""
    assimilation: Sequential
    """The scheme and what it does to the ensemble."""
    execution: Workers = Workers()
    """Where members are integrated; never changes the numbers."""
    output: Output = Output()
    """Where results go."""

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

    @property
    def model(self) -> ForwardModel:
        """That of the truth and of the members."""
        return self.experiment.model


def resolve_twin(document: Document, base: Path) -> TwinConfig:
    """Validate a document with a ``twin:`` section. Raises :class:`ConfigError`, every fault at once."""
    read = read_file(TwinFile, document, base)
    file, model, twin = read.file, read.model, read.file.twin
    observed = {name.removesuffix("_std"): std for name, std in twin.error.items()}
    local = None
    if file.assimilation.localisation:
        with document.placing("assimilation", "localisation"):
            local = localisation_of(file.assimilation.localisation, model, observed.keys())
    terms = tuple(entry.term() for entry in file.parameters if isinstance(entry, Uncertain))
    prior = Prior(terms) if terms else None
    with document.placing():
        rate = error_rates(model, file.model_error or ())
    experiment = TwinExperiment(
        model=model,
        sequential=file.assimilation.built(local, rate, EnsembleCoordinates.of(model, prior)),
        members=file.assimilation.members,
        cycles=twin.cycles,
        interval=twin.interval,
        error_std=observed,
        initial_std=twin.initial_std,
        burn_in=twin.burn_in,
        error_correlation=twin.error_correlation[1] if twin.error_correlation else None,
        prior=prior,
        fixed={entry.parameter.name: entry.value for entry in file.parameters if isinstance(entry, Fixed)},
    )
    common = read.common(())
    return TwinConfig(**common, experiment=experiment, scheme=file.assimilation.scheme, execution=file.execution)
