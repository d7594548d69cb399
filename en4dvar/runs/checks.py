"""What can be told before a run: every fault of configuration and data at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from en4dvar.config import Config, TwinConfig, load_any, schema
from en4dvar.config.build import build_one, data_files, find_files, inverse_plan, read_observations
from en4dvar.config.data import DataPlan, read_data
from en4dvar.config.document import Document, override, read_document
from en4dvar.config.models import read_model
from en4dvar.config.validate import check
from en4dvar.errors import ConfigError, DataError, Fault


def validate(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Config | TwinConfig:
    """Load a configuration and read its data files; nothing is computed or written.

    Parameters
    ----------
    path: the YAML file; paths inside it are relative to its folder.
    overrides: values for dotted keys such as ``"assimilation.members"``; text is read as YAML.

    Raises
    ------
    ConfigError: every fault of the file *and* of the data files it names, each with file, line and column.
    """
    try:
        config = load_any(path, overrides)
    except ConfigError as error:
        raise ConfigError(_ordered([*error.problems, *_data_faults(Path(path), overrides)])) from None
    if isinstance(config, Config):
        faults = list(_problem_faults(config))
        if faults:
            raise ConfigError(_ordered(faults))
    return config


def _problem_faults(config: Config) -> Iterator[Fault]:
    """What keeps the inverse problems of a valid configuration from being built."""
    try:
        files = data_files(inverse_plan(config))
    except ConfigError as error:
        yield from error.problems
        return
    except DataError as error:
        yield _located(config.document, error)
        return
    for name, file in files.items():
        try:
            build_one(config, name, file)
        except ConfigError as error:
            yield from error.problems
        except DataError as error:
            yield _located(config.document, error)


def _data_faults(path: Path, overrides: Mapping[str, Any] | None) -> Iterator[Fault]:
    """Faults of the data section and its files, for a configuration that has faults elsewhere."""
    try:
        document = override(read_document(path), overrides or {})
    except ConfigError:
        return
    faults: list[Fault] = []
    plan = _plan(document, path.resolve().parent, faults)
    yield from faults
    if plan is None:
        return
    try:
        files = find_files(plan.base, plan.paths)
    except DataError as error:
        yield _located(document, error)
        return
    for name, file in files.items():
        try:
            read_observations(plan, file, name)
        except ConfigError as error:
            yield from error.problems
        except DataError as error:
            yield _located(document, error)


def _plan(document: Document, base: Path, faults: list[Fault]) -> DataPlan | None:
    """How the data would be read, with the model's default settings where those given are at fault."""
    model_section, section = document.data.get("model"), document.data.get("data")
    if not isinstance(model_section, dict) or not isinstance(section, dict):
        return None
    found = read_model(model_section, base, document, []) or read_model(
        {"name": model_section.get("name")}, base, document, []
    )
    data = check(schema.Data, section, ("data",), document, faults)
    return read_data(data, base, found[0], document, faults) if found and data else None


def _located(document: Document, error: DataError) -> Fault:
    """A data file's fault at the place that names the file."""
    return document.fault(("data", "path"), str(error))


def _ordered(faults: Sequence[Fault]) -> list[Fault]:
    return sorted(dict.fromkeys(faults), key=lambda fault: (fault.file, fault.line, fault.column))
