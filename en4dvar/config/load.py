"""From a YAML file to a frozen :class:`Config`, or every fault of the file at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from en4dvar.config import schema
from en4dvar.config.data import DataPlan, read_data
from en4dvar.config.document import Document, override, read_document
from en4dvar.config.initial_state import Perturbed, read_initial_state
from en4dvar.config.models import read_model
from en4dvar.config.parameters import Entry, Fixed, read_parameters
from en4dvar.config.validate import check
from en4dvar.errors import ConfigError, Fault
from en4dvar.forward import ForwardModel, Observable
from en4dvar.problem import AssimilationSettings
from en4dvar.state import Array
from en4dvar.units import UnitError, parse_quantity


@dataclass(frozen=True)
class Config:
    """A validated configuration. Nothing of the data files has been read yet."""

    document: Document
    name: str
    seed: int
    model: ForwardModel
    observable: Observable
    parameters: tuple[Entry, ...]
    data: DataPlan | None
    assimilation: AssimilationSettings
    weights: Literal["sum", "mean"]
    execution: schema.Execution
    report: bool
    directory: Path
    simulate_times: Array | None
    resolved: str
    initial_state: tuple[Perturbed, ...] = ()

    @property
    def text(self) -> str:
        """The file, verbatim."""
        return self.document.text


def load_config(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Config:
    """Read and validate a configuration.

    Parameters
    ----------
    path: the YAML file; paths inside it are relative to its folder.
    overrides: values for dotted keys such as ``"assimilation.members"``; text is read as YAML.

    Raises
    ------
    ConfigError: carries every fault found, with file, line and column.
    """
    path = Path(path)
    return resolve(override(read_document(path), overrides or {}), path.resolve().parent)


def resolve(document: Document, base: Path) -> Config:
    """Validate a document whose relative paths start at ``base``. Raises :class:`ConfigError`."""
    if "twin" in document.data:
        raise ConfigError([document.fault(("twin",), "a twin experiment: it can be run and validated", at_key=True)])
    faults: list[Fault] = []
    top = check(schema.Schema, document.data, (), document, faults)
    model_section = document.data.get("model")
    found = read_model(model_section, base, document, faults) if isinstance(model_section, dict) else None
    section = document.data.get("assimilation", {})
    assimilation = check(schema.Assimilation, section, ("assimilation",), document, faults)
    if assimilation and assimilation.model_dump()["refine"] == "mcmc" and find_spec("emcee") is None:
        message = "mcmc needs emcee; install the extra: pip install 'en4dvar[mcmc]'"
        faults.append(document.fault(("assimilation", "refine"), message))
    section = document.data.get("data")
    data = check(schema.Data, section, ("data",), document, faults) if section is not None else None
    if found is None:
        raise ConfigError(_unique(faults))
    model, model_resolved = found
    raw_parameters = document.data.get("parameters")
    entries = read_parameters(raw_parameters, model, document, faults) if isinstance(raw_parameters, dict) else ()
    raw_state = document.data.get("initial_state")
    perturbed = read_initial_state(raw_state, model, document, faults) if isinstance(raw_state, dict) else ()
    plan = read_data(data, base, model, document, faults) if data else None
    times = _grid(top.simulate.times, model.time_unit, document, faults) if top and top.simulate else None
    if faults or top is None or assimilation is None:
        raise ConfigError(_unique(faults))
    options = assimilation.model_dump()
    weights = options.pop("weights")
    return Config(
        document=document,
        name=top.name,
        seed=top.seed,
        model=model,
        observable=plan.observable if plan else model.observables[0],
        parameters=entries,
        data=plan,
        assimilation=AssimilationSettings(**options),
        weights=weights,
        execution=top.execution,
        report=top.output.report,
        directory=top.output.directory or Path("runs") / top.name,
        simulate_times=times,
        resolved=_resolved(top, base, data, model_resolved, entries, assimilation),
        initial_state=perturbed,
    )


def time_grid(start: str | float, end: str | float, step: str | float, unit: str) -> Array:
    """Instants (K,) from ``start`` to ``end``, both included. Raises :class:`UnitError`."""
    first = 0.0 if start == "start" else parse_quantity(start, unit)
    last, width = parse_quantity(end, unit), parse_quantity(step, unit)
    if not width > 0 or not last > first:
        raise UnitError(f"no instants from {first:g} to {last:g} {unit} in steps of {width:g} {unit}")
    count = int(np.floor((last - first) / width * (1 + 1e-9))) + 1
    if not 3 <= count <= 1_000_000:
        raise UnitError(f"{count} instants; give between 3 and a million")
    return np.asarray(first + width * np.arange(count), dtype=float)


def _grid(times: schema.Times, unit: str, document: Document, faults: list[Fault]) -> Array | None:
    try:
        return time_grid(times.start, times.end, times.step, unit)
    except UnitError as error:
        faults.append(document.fault(("simulate", "times"), str(error)))
        return None


def _unique(faults: list[Fault]) -> list[Fault]:
    return sorted(dict.fromkeys(faults), key=lambda f: (f.file, f.line, f.column))


def _resolved(
    top: schema.Schema,
    base: Path,
    data: schema.Data | None,
    model: dict[str, Any],
    entries: tuple[Entry, ...],
    assimilation: schema.Section,
) -> str:
    """The configuration with overrides and defaults written out and paths absolute, as YAML that loads again."""
    content = top.model_dump(mode="json", by_alias=True, exclude_none=True)
    content["model"] = model
    content["assimilation"] = assimilation.model_dump(mode="json")
    given = top.parameters
    for entry in entries:
        if isinstance(entry, Fixed) and entry.parameter.name not in given:
            unit = entry.parameter.unit
            content["parameters"][entry.parameter.name] = f"{entry.value!r} {unit}" if unit != "1" else entry.value
    if data:
        paths = [data.path] if isinstance(data.path, str) else data.path
        absolute = [str(base / p) for p in paths]
        content["data"] = data.model_dump(mode="json", by_alias=True, exclude_none=True)
        content["data"]["path"] = absolute[0] if len(absolute) == 1 else absolute
        if isinstance(covariance := content["data"]["error"].get("covariance"), dict):
            covariance["path"] = str(base / Path(str(covariance["path"])).expanduser())
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120)
