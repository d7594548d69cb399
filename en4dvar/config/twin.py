"""A twin experiment from YAML: the file has a ``twin:`` section where others have ``data:``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field, model_validator

from en4dvar.config import schema
from en4dvar.config.document import Document
from en4dvar.config.models import read_model
from en4dvar.config.parameters import Fixed, Uncertain, read_parameters
from en4dvar.config.schema import QuantityText, Section
from en4dvar.config.validate import check
from en4dvar.cycling.sequential import SequentialSettings
from en4dvar.cycling.twin import TwinExperiment
from en4dvar.errors import ConfigError, DataError, Fault
from en4dvar.forward import ForwardModel
from en4dvar.hints import suggest
from en4dvar.inputs.readers import Matrix, read_covariance
from en4dvar.noise import Correlation
from en4dvar.prior import Prior
from en4dvar.schemes.etkf import ETKF
from en4dvar.schemes.ienks import IEnKS
from en4dvar.schemes.inflation import Inflation
from en4dvar.schemes.localisation import Localisation
from en4dvar.units import UnitError, parse_quantity


class Twin(Section):
    """How the truth is made and observed."""

    cycles: Annotated[int, Field(ge=1)]
    """Number of analyses."""
    burn_in: Annotated[int, Field(ge=0)] = 0
    """Cycles at the beginning that no score counts."""
    interval: QuantityText
    """Time between two observations, in the model's unit of time."""
    error: Annotated[dict[str, QuantityText], Field(min_length=1)]
    """Std of the observation errors, by observable: ``<observable>_std``."""
    error_correlation: Annotated[str, Field(min_length=1)] | None = None
    """CSV file of the correlation of the errors at one instant, full or block diagonal, one row an observation, without
    header; relative to the configuration's folder. Default: independent errors."""
    initial_std: Annotated[dict[str, QuantityText], Field(min_length=1)]
    """Std of the initial ensemble, by field of the state."""

    @model_validator(mode="after")
    def _something_counts(self) -> Twin:
        if self.burn_in >= self.cycles:
            raise ValueError(f"burn_in ({self.burn_in}) leaves none of {self.cycles} cycles")
        return self


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


class Sequential(Section):
    """The scheme and what it does to the ensemble."""

    scheme: Literal["etkf", "ienks"]
    """etkf (filter) or ienks (sliding-window smoother)."""
    members: Annotated[int, Field(ge=3)]
    """Ensemble size N."""
    lag: Annotated[int, Field(ge=0)] = IEnKS.lag
    """Length of the smoother's window in cycles; 0 is a filter."""
    linearisation: Literal["transform", "bundle"] = IEnKS.linearisation
    """Regression over the ensemble (transform), or tangent from runs close to the iterate (bundle)."""
    epsilon: Annotated[float, Field(gt=0, le=1)] = IEnKS.epsilon
    """Size of the bundle: factor on the anomalies."""
    max_iterations: Annotated[int, Field(ge=1)] = IEnKS.max_iterations
    """Iteration limit in each cycle."""
    tolerance: Annotated[float, Field(gt=0)] = IEnKS.tolerance
    """Iterations end where the step is shorter than this, in posterior standard deviations."""
    inflation: Annotated[float, Field(gt=0)] = 1.0
    """Factor on the anomalies after each analysis; 1 is none."""
    rtps: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Relaxation to the prior spread, 0 (none) to 1."""
    rotation: bool = False
    """Rotate the ensemble at random after each analysis, mean and covariance kept."""
    localisation: Local | None = None
    """Gaspari–Cohn taper over the indices of the observed field (etkf only)."""

    @model_validator(mode="after")
    def _belongs_together(self) -> Sequential:
        iterated = {"lag", "linearisation", "epsilon", "max_iterations", "tolerance"} & self.model_fields_set
        if self.scheme == "etkf" and iterated:
            raise ValueError(f"{', '.join(sorted(iterated))}: only with scheme ienks")
        if self.scheme == "ienks" and self.localisation:
            raise ValueError("localisation: only with scheme etkf")
        return self

    @property
    def built(self) -> ETKF | IEnKS:
        if self.scheme == "etkf":
            return ETKF()
        return IEnKS(self.lag, self.linearisation, self.epsilon, self.max_iterations, self.tolerance)


class Workers(Section):
    """Where members are integrated; never changes the numbers. A cycle is short: one worker is the default."""

    workers: Annotated[int, Field(ge=1)] = 1
    """Parallel workers."""
    checkpoint_every: Annotated[float, Field(ge=0)] = 2.0
    """Seconds between two checkpoints, 0: one after every cycle. Each holds the moments of all cycles done."""


class TwinSchema(Section):
    """The whole file; ``model`` and ``parameters`` are as for an estimation and validated by themselves."""

    name: schema.Name
    """Name of the run; its results go to runs/<name>."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of truth, observations and ensemble."""
    model: dict[str, Any]
    """The forward model: its ``name`` (see ``en4dvar models``) and its settings."""
    parameters: dict[str, Any] = Field(default_factory=dict)
    """Parameters to estimate (a prior) or to change from the model's default (a quantity)."""
    twin: dict[str, Any]
    """How the truth is made and observed."""
    assimilation: dict[str, Any]
    """The scheme and what it does to the ensemble."""
    execution: Workers = Workers()
    """Where members are integrated; never changes the numbers."""
    output: schema.Output = schema.Output()
    """Where results go."""


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
    faults: list[Fault] = []
    data = document.data
    top = check(TwinSchema, data, (), document, faults)
    found = read_model(data["model"], base, document, faults) if isinstance(data.get("model"), dict) else None
    twin = check(Twin, data["twin"], ("twin",), document, faults)
    settings = check(Sequential, data.get("assimilation", {}), ("assimilation",), document, faults)
    if top is None or found is None or twin is None or settings is None:
        raise ConfigError(faults)
    model, model_resolved = found
    entries = read_parameters(top.parameters, model, document, faults)
    for entry in entries:
        if entry.needs_data:
            path = ("parameters", entry.parameter.name)
            faults.append(document.fault(path, "a twin experiment has no data file to take a value from"))
    interval = _quantities({"interval": twin.interval}, {"interval": model.time_unit}, (), document, faults)
    error = _quantities(twin.error, {f"{o.name}_std": o.unit for o in model.observables}, ("error",), document, faults)
    constant = {p.name for p in model.parameters}
    fields = {f.name: f.unit for f in model.layout if f.name not in constant}
    initial = _quantities(twin.initial_std, fields, ("initial_std",), document, faults)
    if len(set(fields.values())) > 1:
        message = f"RMSE and spread need one unit, but the state has {', '.join(sorted(set(fields.values())))}"
        faults.append(document.fault(("model",), message))
    observed = {name.removesuffix("_std"): std for name, std in error.items()}
    correlation = None
    if twin.error_correlation is not None:
        twin = twin.model_copy(update={"error_correlation": str((base / twin.error_correlation).absolute())})
        correlation = _correlation(str(twin.error_correlation), document, faults)
        if settings.localisation:
            message = "needs observations with independent errors, but twin.error_correlation is given"
            faults.append(document.fault(("assimilation", "localisation"), message))
    local = None
    if settings.localisation and not faults:
        local = _localisation(settings.localisation, model, set(observed), document, faults)
    if faults:
        raise ConfigError(faults)
    terms = tuple(entry.term() for entry in entries if isinstance(entry, Uncertain))
    experiment = TwinExperiment(
        model=model,
        sequential=SequentialSettings(
            settings.built, Inflation(settings.inflation, settings.rtps), settings.rotation, local
        ),
        members=settings.members,
        cycles=twin.cycles,
        interval=interval["interval"],
        error_std=observed,
        initial_std=initial,
        burn_in=twin.burn_in,
        error_correlation=correlation,
        prior=Prior(terms) if terms else None,
        fixed={entry.parameter.name: entry.value for entry in entries if isinstance(entry, Fixed)},
    )
    return TwinConfig(
        document=document,
        name=top.name,
        seed=top.seed,
        experiment=experiment,
        scheme=settings.scheme,
        execution=top.execution,
        directory=top.output.directory or Path("runs") / top.name,
        report=top.output.report,
        resolved=_resolved(top, model_resolved, twin, settings),
    )


def _quantities(
    given: Mapping[str, QuantityText],
    units: Mapping[str, str],
    path: tuple[str, ...],
    document: Document,
    faults: list[Fault],
) -> dict[str, float]:
    """Positive quantities by name, in ``units``; faults are appended."""
    values: dict[str, float] = {}
    for name, text in given.items():
        where = ("twin", *path, name)
        if name not in units:
            faults.append(document.fault(where, f"unknown key {name!r}{suggest(name, units)}", at_key=True))
            continue
        try:
            values[name] = parse_quantity(text, units[name])
        except UnitError as error:
            faults.append(document.fault(where, str(error)))
            continue
        if not values[name] > 0:
            faults.append(document.fault(where, f"must be positive, not {text}"))
    return values


def _correlation(file: str, document: Document, faults: list[Fault]) -> Correlation | None:
    """The correlation matrix of the observation errors, or None with a fault appended."""
    try:
        return Correlation(read_covariance(Matrix(Path(file).expanduser(), "1", "1")))
    except (DataError, ValueError) as error:
        faults.append(document.fault(("twin", "error_correlation"), str(error)))
        return None


def _localisation(
    settings: Local, model: ForwardModel, observed: set[str], document: Document, faults: list[Fault]
) -> Localisation | None:
    """Positions are indices of the one observed field, which fills the state but for the parameters."""
    constant = {p.name for p in model.parameters}
    fields = [f for f in model.layout if f.name not in constant]
    if len(fields) != 1 or observed != {fields[0].name}:
        message = "needs a model whose state is one field, and this field observed"
        faults.append(document.fault(("assimilation", "localisation"), message))
        return None
    if settings.shape:
        if math.prod(settings.shape) != fields[0].size:
            message = f"{' x '.join(map(str, settings.shape))} cells, but {fields[0].name} has {fields[0].size}"
            faults.append(document.fault(("assimilation", "localisation", "shape"), message))
            return None
        where = np.arange(model.layout.size)[model.layout[fields[0].name]]
        return Localisation.on_grid(where, settings.shape, settings.radius, settings.periodic)
    positions = np.arange(fields[0].size, dtype=float)
    state = np.full(model.layout.size, np.nan)
    state[model.layout[fields[0].name]] = positions
    period = float(fields[0].size) if settings.periodic else None
    return Localisation.on_line(state, positions, settings.radius, period, settings.block_size)


def _resolved(top: TwinSchema, model: dict[str, Any], twin: Twin, settings: Sequential) -> str:
    """The configuration with overrides and defaults written out, as YAML that loads again."""
    content = top.model_dump(mode="json", by_alias=True, exclude_none=True)
    content["model"] = model
    content["twin"] = twin.model_dump(mode="json")
    smoother = {"lag", "linearisation", "epsilon", "max_iterations", "tolerance"}
    left_out = smoother if settings.scheme == "etkf" else {"localisation"}
    content["assimilation"] = settings.model_dump(mode="json", exclude_none=True, exclude=left_out)
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120)
