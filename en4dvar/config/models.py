"""From the ``model:`` section to a forward model: by entry point (group ``en4dvar.models``) or ``package:object``."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from en4dvar.commands.hints import suggest
from en4dvar.config.document import Document
from en4dvar.config.validate import check
from en4dvar.errors import ConfigError, En4dvarError, Fault
from en4dvar.forward import ForwardModel

GROUP = "en4dvar.models"


def find_model(name: str) -> type[ForwardModel]:
    """The model class called ``name``. Raises :class:`ConfigError`."""
    found: Any
    try:
        if ":" in name:
            module, _, attribute = name.partition(":")
            found = getattr(import_module(module), attribute)
        else:
            registered = {e.name: e for e in entry_points(group=GROUP)}
            if name not in registered:
                raise ConfigError(f"unknown model {name!r}{suggest(name, registered)}; or write package:object")
            found = registered[name].load()
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"model {name!r} cannot be loaded: {error}") from error
    if not (isinstance(found, type) and issubclass(found, ForwardModel)):
        raise ConfigError(f"{name!r} is not a subclass of en4dvar.ForwardModel")
    if not hasattr(found, "Settings") or not hasattr(found, "from_settings"):
        raise ConfigError(f"{name!r} cannot be used from YAML: it lacks Settings and from_settings")
    return found


def read_model(
    raw: Mapping[str, Any], base: Path, document: Document, faults: list[Fault]
) -> tuple[ForwardModel, dict[str, Any]] | None:
    """The model and its resolved section (defaults filled in), or None with the faults appended.

    Paths in a model's settings are relative to ``base``, given to pydantic as validation context ``{"base": base}``.
    """
    name = raw.get("name")
    if not isinstance(name, str):
        faults.append(document.fault(("model", "name"), "name the model, e.g. name: bubble"))
        return None
    try:
        kind: Any = find_model(name)
    except ConfigError as error:
        faults.append(document.fault(("model", "name"), str(error)))
        return None
    options = {key: value for key, value in raw.items() if key != "name"}
    settings: BaseModel | None = check(kind.Settings, options, ("model",), document, faults, {"base": base})
    if settings is None:
        return None
    try:
        model: ForwardModel = kind.from_settings(settings)
    except (En4dvarError, ValueError) as error:
        faults.append(document.fault(("model",), str(error)))
        return None
    return model, {"name": name, **settings.model_dump(mode="json", by_alias=True)}
