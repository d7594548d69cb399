"""What decides the numbers of a run, as text that can be compared: a run is continued only where it agrees.

Configuration (without ``execution`` and ``output``, which never change the numbers), versions of the numerical
packages, sources of the framework and of the model, files that the model's settings name, content of the data files.
"""

import difflib
import functools
import inspect
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from en4dvar.inputs.parts import DataFile
from en4dvar.model.forward import ForwardModel
from en4dvar.results.checkpoint import FOLDER, digest, file_digest
from en4dvar.results.provenance import package_versions

IDENTITY = f"{FOLDER}/run"  # in a run directory
PACKAGES = ("en4dvar", "numpy", "scipy", "numba", "llvmlite")
_NO_NUMBERS = ("execution", "output")
_PRIOR_FILES = ("prior", "prior_correlation")  # sections that name files


@dataclass(frozen=True)
class Identity:
    """``settings``: all but the data, as YAML; ``data``: name of the data set → SHA-256 of its file."""

    settings: str
    data: tuple[tuple[str, str], ...]

    def of_dataset(self, name: str) -> str:
        """Fingerprint of one data set's result."""
        return digest(f"{self.settings}\n{name}: {self.content[name]}".encode())

    @functools.cached_property
    def content(self) -> Mapping[str, str]:
        """``data`` by name."""
        return dict(self.data)

    def difference(self, earlier: "Identity", retried: frozenset[str]) -> str:
        """Unified diff from ``earlier`` to this, "" where they agree. Files of ``retried`` data sets may differ."""
        if self == earlier:
            return ""

        def lines(identity: Identity) -> list[str]:
            data = [f"{name}: {'' if name in retried else content}" for name, content in identity.data]
            return [*identity.settings.splitlines(), "data files:", *data]

        return "\n".join(difflib.unified_diff(lines(earlier), lines(self), "earlier run", "now", lineterm="", n=1))


def identity(resolved: str, model: ForwardModel, data: Mapping[str, DataFile]) -> Identity:
    """The identity of a run of the resolved configuration (YAML) on ``data`` (name → where it is)."""
    content = yaml.safe_load(resolved)
    settings = {key: value for key, value in content.items() if key not in _NO_NUMBERS}
    software = {"python": f"{sys.version_info.major}.{sys.version_info.minor}", **package_versions(PACKAGES)}
    section = content.get("data") or {}
    stated = [part.get(key) for part in (section, *section.get("series", {}).values()) for key in ("error", "weights")]
    sources = {"en4dvar": source_digest("en4dvar"), **_packages_of(model)}
    named = [content["model"], stated, *(content.get(key) for key in _PRIOR_FILES)]
    sources |= {str(path): file_digest(path) for path in _paths(named)}
    text = yaml.safe_dump(
        {**settings, "software": software, "sources": sources}, sort_keys=False, allow_unicode=True, width=120
    )
    return Identity(text, tuple((name, digest_of(file.paths)) for name, file in data.items()))


def digest_of(paths: Sequence[Path]) -> str:
    """SHA-256 of a file, of several that of their digests."""
    digests = list(map(file_digest, paths))
    return digests[0] if len(digests) == 1 else digest("\n".join(digests).encode())


@functools.cache  # the code that runs is that of the first import
def source_digest(module: str) -> str:
    """SHA-256 over the Python files of the package (or the file of the module) that holds ``module``."""
    top = sys.modules[module.partition(".")[0]]
    if hasattr(top, "__path__"):
        files = sorted(file for folder in top.__path__ for file in Path(folder).rglob("*.py"))
        return digest("\n".join(f"{file.name} {file_digest(file)}" for file in files).encode())
    return file_digest(Path(getattr(top, "__file__", None) or ""))


def _packages_of(model: ForwardModel) -> dict[str, str]:
    """Top-level package (or module) → digest of what defines the model's class and its bases outside the framework."""
    tops = (kind.__module__.partition(".")[0] for kind in type(model).__mro__ if inspect.getmodule(kind))
    return {top: source_digest(top) for top in tops if top not in ("en4dvar", "builtins", "abc", "typing")}


def _paths(value: Any) -> Iterator[Path]:
    """Files named anywhere in a section, e.g. a tabulated pressure or the file of a user's own law."""
    if isinstance(value, Mapping):
        value = [*value.values()]
    if isinstance(value, list):
        for item in value:
            yield from _paths(item)
    elif isinstance(value, str):
        for text in (value, value.rpartition(":")[0]):  # also file:object
            if os.path.isfile(text):
                yield Path(text)
        if " " in value:  # a command
            yield from (Path(word) for word in value.split() if os.path.isabs(word) and os.path.isfile(word))
