"""YAML → validated, frozen settings; errors as ``file:line:col: path: message``, all at once."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from en4dvar.config.design import time_grid
from en4dvar.config.document import Document, Source, document_from
from en4dvar.config.kinds import SequenceConfig, TwinConfig, resolve_sequence, resolve_twin
from en4dvar.config.load import Config, load_config, resolve
from en4dvar.plumbing.errors import ConfigError

__all__ = [
    "AnyConfig", "Config", "SequenceConfig", "TwinConfig", "load_any", "load_config", "load_sequence", "load_twin",
    "loaded", "resolve", "resolve_any", "resolve_sequence", "time_grid",
]  # fmt: skip

Loaded = TypeVar("Loaded", Config, TwinConfig, SequenceConfig)
AnyConfig = Config | TwinConfig | SequenceConfig


def load_any(source: Source, overrides: Mapping[str, Any] | None = None) -> AnyConfig:
    """A twin experiment or a sequence where the file has a section ``twin:`` or ``sequence:``, else an estimation."""
    return resolve_any(*document_from(source, overrides))


def resolve_any(document: Document, base: Path) -> AnyConfig:
    """:func:`load_any` of a document that has been read; ``base`` is where its relative paths start."""
    if "sequence" in document.data and "twin" not in document.data:
        return resolve_sequence(document, base)
    return resolve_twin(document, base) if "twin" in document.data else resolve(document, base)


def load_twin(source: Source, overrides: Mapping[str, Any] | None = None) -> TwinConfig:
    """The counterpart of :func:`load_config` for a twin experiment. Raises :class:`ConfigError`."""
    return resolve_twin(*document_from(source, overrides))


def load_sequence(source: Source, overrides: Mapping[str, Any] | None = None) -> SequenceConfig:
    """The counterpart of :func:`load_config` for a sequence. Raises :class:`ConfigError`."""
    return resolve_sequence(*document_from(source, overrides))


def loaded(config: Loaded | Source, load: Callable[..., Loaded], overrides: Mapping[str, Any] | None) -> Loaded:
    """A configuration that is loaded already, or by ``load`` with ``overrides``. Raises :class:`ConfigError`: both."""
    if isinstance(config, str | Path | Mapping):
        return load(config, overrides)
    if overrides:
        raise ConfigError(f"overrides apply to a file or dict; give them to {load.__name__} instead")
    return config
