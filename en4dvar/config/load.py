"""From a YAML file to a frozen :class:`Config`, or every fault of the file at once."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
from pydantic import Field

from en4dvar.config.context import Context, Made, check
from en4dvar.config.data import DATA, DataPlan
from en4dvar.config.dependence import Groups, PopulationSection, PriorCorrelation, PriorFile, Sharing, resolved
from en4dvar.config.design import Design, Times, read_times
from en4dvar.config.document import Document, Source, document_from, parse_document, yaml_text
from en4dvar.config.models import read_model
from en4dvar.config.parameters import Entry, Fixed, Uncertain, entries
from en4dvar.config.schema import Assimilation, Execution, File, GivenStart, Output, Section
from en4dvar.config.varies import MODEL_ERROR, PERTURBED, ErrorOf, Initial, Perturbed
from en4dvar.inputs.members import read_centres, read_members
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.model.state import NOISE_SCALE, Array
from en4dvar.plumbing.errors import ConfigError, DataError, Fault, retold
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.installed import installed
from en4dvar.plumbing.units import UnitError, parse_quantity
from en4dvar.priors.dependence import Dependence
from en4dvar.schemes.settings import AssimilationSettings

KINDS = {  # the section that marks a file of another kind than an estimation → what it is, and what it is for
    "twin": "a twin experiment, for 'en4dvar run' and 'en4dvar sweep-twin'",
    "sequence": "a sequence, for 'en4dvar run'",
    "campaign": "a synthetic campaign, for 'en4dvar simulate'",
}
OTHERS = "en4dvar.schemas"  # entry points: the section that marks a kind of file → pydantic model of the whole file


class Simulate(Section):
    """Settings of ``en4dvar simulate``: when the synthetic observations are taken."""

    times: Annotated[Array, Made(read_times, Times)]
    """Instants of the synthetic observations."""


class Estimation(File):
    """What is estimated from which observations, and how."""

    data: DATA | None = None
    """Where the observations are, what they mean and how well they are known."""
    parameters: Annotated[tuple[Entry, ...], entries()] = Field({}, validate_default=True)
    """For each parameter a prior (estimated), a quantity (fixed), or a scalar of the data file (fixed)."""
    groups: Groups | None = None
    """What data sets have in common, e.g. ``batch: {first: 'a_*', second: [b_*, c_01]}``: under each kind of group the
    groups, with patterns of the names of their data sets."""
    population: PopulationSection | None = None
    prior: PriorFile | None = None
    prior_correlation: tuple[PriorCorrelation, ...] | None = None
    """Which parameters are correlated in the prior, and how."""
    initial_state: Annotated[tuple[Initial, ...], PERTURBED] | None = None
    """Fields of the initial state that are uncertain, each with its ``std``; with a ``kernel`` and a ``length`` cell by
    cell."""
    model_error: Annotated[tuple[ErrorOf, ...], MODEL_ERROR] | None = None
    """Fields of the state that change at knots, by something the model does not know, each with its ``std``."""
    assimilation: Assimilation = Assimilation()
    execution: Execution = Execution()
    output: Output = Output()
    simulate: Simulate | None = None
    design: Design | None = None


@dataclass(frozen=True, kw_only=True)
class Validated:
    """What every validated file says: where results go, and as which text it is recorded."""

    document: Document
    model: ForwardModel
    name: str
    seed: int
    directory: Path
    report: bool
    figures: bool
    resolved: str

    @property
    def text(self) -> str:
        """The file, verbatim."""
        return self.document.text


@dataclass(frozen=True, kw_only=True)
class Config(Validated):
    """A validated configuration. Nothing of the data files has been read yet."""

    observable: Observable
    parameters: tuple[Entry, ...]
    data: DataPlan | None = None
    assimilation: AssimilationSettings
    weights: Literal["sum", "mean", "balanced"]
    execution: Execution
    simulate_times: Array | None
    sharing: Sharing
    initial_state: tuple[Initial, ...] = ()
    model_error: tuple[ErrorOf, ...] = ()
    dependence: tuple[Dependence, ...] = ()
    design: Design = field(default_factory=Design)
    population: PopulationSection | None = None


def load_config(source: Source, overrides: Mapping[str, Any] | None = None) -> Config:
    """Read and validate a configuration.

    Parameters
    ----------
    source: the YAML file, paths inside it relative to its folder; or a dict of the same, relative to this folder.
    overrides: values for dotted keys such as ``"assimilation.members"``; text is read as YAML.

    Raises
    ------
    ConfigError: carries every fault found, with file, line and column.
    """
    return resolve(*document_from(source, overrides))


def recorded(text: str, file: str) -> Document:
    """The resolved configuration that a result holds. Raises :class:`ConfigError`. Version 1.0 also wrote the defaults
    of keys that the scheme does not read; these are left out.
    """
    document = parse_document(text, file)
    section = document.data.get("assimilation")
    if isinstance(section, dict):
        for key in Assimilation.unread(section):
            del section[key]
    return document


def resolve(document: Document, base: Path, model: ForwardModel | None = None) -> Config:
    """Validate a document whose relative paths start at ``base``. Raises :class:`ConfigError`. ``model``: one that is
    there already; the ``model:`` section then only records what it is.
    """
    read = read_file(Estimation, document, base, model)
    file = read.file
    own = {p.name for p in read.model.parameters}
    apart = {} if NOISE_SCALE.name in own else {NOISE_SCALE.name: "it is the scale of the errors"}
    others = [initial.term.parameter.name for initial in file.initial_state or () if isinstance(initial, Perturbed)]
    parameters, blocks = resolved(file.parameters, file.prior, file.prior_correlation or (), others, apart, document)
    if file.population is not None:
        file.population.check(parameters, file.groups or {}, document)
    several = file.data is not None and len(file.data.series) > 1
    settings = file.assimilation.settings
    minimiser = settings.own.minimiser
    if minimiser and isinstance(minimiser.start, GivenStart):
        settings = replace(settings, own=replace(minimiser, start=values_of(minimiser.start, parameters, document)))
    return read.validated(
        Config,
        observable=file.data.series[0].observable if file.data else read.model.observables[0],
        parameters=parameters,
        assimilation=settings,
        weights=file.assimilation.weights,
        simulate_times=file.simulate.times if file.simulate else None,
        sharing=Sharing.of(parameters, file.groups or {}, bool(blocks), several, document),
        dependence=blocks,
    )


S = TypeVar("S", bound=Section)
V = TypeVar("V", bound=Validated)


@dataclass(frozen=True)
class Read(Generic[S]):
    """A validated file: its sections, the model, and the model's section with its defaults."""

    file: S
    model: ForwardModel
    document: Document
    model_section: dict[str, Any]

    def validated(self, kind: type[V], **more: Any) -> V:
        """A file with a section ``output``, of a ``kind`` whose fields are those of the file, and ``more``.

        ``resolved`` is the file with overrides and defaults written out and paths absolute, as YAML that loads again.
        """
        file: Any = self.file
        own = {f.name: value for f in fields(kind) if (value := getattr(file, f.name, None)) is not None}
        where = file.output.directory or Path("runs") / file.name
        said = {"directory": where, "report": file.output.report, "figures": file.output.figures}
        content = file.as_written(self.document.data)
        content["model"] = self.model_section
        for entry in own.get("parameters", ()):
            name, unit = entry.parameter.name, entry.parameter.unit
            if isinstance(entry, Fixed) and name not in content["parameters"]:
                content["parameters"][name] = f"{entry.value!r} {unit}" if unit != "1" else entry.value
        said |= {"document": self.document, "model": self.model, "resolved": yaml_text(content)}
        return kind(**own | said | more)


def require_kind(schema: type[Section], document: Document) -> None:
    """Raise :class:`ConfigError` where a file is of another kind than that of the ``schema``: what is it for?"""
    others = installed(OTHERS)
    marks = [*KINDS, *others]
    own, written = ([mark for mark in marks if mark in keys] for keys in (schema.model_fields, document.data))
    if set(own) & set(written) or not (own or written):
        return
    if written:
        mark = written[0]
        purpose = KINDS.get(mark) or getattr(others[mark].load(), "PURPOSE", "a file of another kind")
        raise ConfigError([document.fault((mark,), f"it makes the file {purpose}", at_key=True)])
    commands = " and ".join(["'en4dvar run'", *["'en4dvar design'"] * ("design" in document.data)])
    raise ConfigError([document.fault((own[0],), f"required, but not given; without it the file is for {commands}")])


def read_file(kind: type[S], document: Document, base: Path, model: ForwardModel | None = None) -> Read[S]:
    """Validate a document for a ``model``, by default its own. Raises :class:`ConfigError`: every fault, in order."""
    require_kind(kind, document)
    faults: list[Fault] = []
    section = document.data.get("model")
    built = (model, dict(section or {})) if model else read_model(section, base, document, faults)
    parameters = document.data.get("parameters")
    model = built[0].with_parameters(parameters if isinstance(parameters, dict) else ()) if built else None
    for key, names in model.known_by.items() if model else ():
        if document.data["model"].get(key) is not None and parameters and all(name in parameters for name in names):
            words = f"not read, for it says {' and '.join(names)}, which are parameters; leave it out, or change these"
            faults.append(document.fault(("model", key), words, at_key=True))
    file = check(kind, document.data, (), document, faults, context_of(document, base, model))
    if file is None or built is None or model is None or faults:
        raise ConfigError(in_order(faults))
    return Read(file, model, document, built[1])


def context_of(document: Document, base: Path, model: ForwardModel | None) -> Context:
    """What is known of the model; where its settings are at fault, units are those of default settings."""
    section, data = document.data.get("model"), document.data.get("data")
    context = Context(base, model)
    if model is None and isinstance(section, dict):
        built = read_model({"name": section.get("name")}, base, document, [])
        context.default = built[0] if built else None
    columns = data.get("columns") if isinstance(data, dict) else None
    if isinstance(columns, dict) and (units := context.built or context.default):
        named = [observable for observable in units.observables if observable.name in columns]
        context.observed = named[0] if len(named) == 1 else None
    return context


def in_order(faults: Iterable[Fault]) -> list[Fault]:
    """Each fault once, as the file has them."""
    return sorted(dict.fromkeys(faults), key=lambda fault: (fault.file, fault.line, fault.column))


def values_of(start: GivenStart, entries: Sequence[Entry], document: Document) -> Mapping[str, Any]:
    """The value of each parameter that the start names, or of all where it is a file, in the parameters' units; of a
    summary of data sets, by their names.

    Raises :class:`ConfigError`: a parameter that is not estimated, a unit that does not fit, a file that is no result.
    """
    units = {e.parameter.name: e.parameter.unit for e in entries if isinstance(e, Uncertain)}
    where = ("assimilation", "start", "from")
    if isinstance(start.place, Path):
        with document.placing(*where), retold(DataError, ConfigError):
            if of_sets := read_centres(start.place, units):
                return of_sets
            members = read_members(start.place, {name: (unit, "") for name, unit in units.items()})
        return {name: float(np.median(values)) for name, values in members.items()}
    values, faults = {}, list[Fault]()
    for name, text in start.place.items():
        with document.collecting(faults, *where, name):
            if name not in units:
                raise UnitError(f"not estimated, it has no prior{suggest(name, units)}")
            values[name] = parse_quantity(text, units[name])
    if faults:
        raise ConfigError(faults)
    return values
