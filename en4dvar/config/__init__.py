"""YAML → validated, frozen settings; errors as ``file:line:col: path: message``, all at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from en4dvar.config.document import Document, document_from, override
from en4dvar.config.load import Config, load_config, resolve
from en4dvar.config.times import time_grid
from en4dvar.config.twin import TwinConfig, resolve_twin
from en4dvar.errors import ConfigError, Fault

__all__ = ["Config", "TwinConfig", "load_any", "load_config", "load_twin", "resolve", "resolve_any", "time_grid"]


def load_any(source: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> Config | TwinConfig:
    """A twin experiment where the file has a ``twin:`` section, else what :func:`load_config` gives."""
    document, base = document_from(source)
    return resolve_any(override(document, overrides or {}), base)


def resolve_any(document: Document, base: Path) -> Config | TwinConfig:
    """As :func:`load_any`, of a document that has been read; ``base`` is where its relative paths start."""
    return resolve_twin(document, base) if "twin" in document.data else resolve(document, base)


def load_twin(source: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> TwinConfig:
    """As :func:`load_config`, for a twin experiment. Raises :class:`ConfigError`."""
    config = load_any(source, overrides)
    if not isinstance(config, TwinConfig):
        raise ConfigError([Fault("not a twin experiment: it has no twin: section", file=config.document.file)])
    return config
