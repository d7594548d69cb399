"""Where a result comes from: versions, platform, commit, configuration, as attributes of the file that holds it; and
what decides the numbers of a run, as text that must agree where a run is continued: configuration (without
``execution`` and ``output``, which never change the numbers), versions of the numerical packages, sources of the
framework and of the model, files that the model's settings name, content of the data files.
"""

import difflib
import functools
import inspect
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from en4dvar.config.document import yaml_text
from en4dvar.inputs.parts import DataFile
from en4dvar.model.forward import ForwardModel
from en4dvar.plumbing.called import ELSEWHERE, advised
from en4dvar.plumbing.errors import OutputError
from en4dvar.results.checkpoint import FOLDER, digest, file_digest

PACKAGES = ("en4dvar", "numpy", "scipy", "numba", "xarray", "netCDF4", "pydantic", "matplotlib")


def provenance(config_text: str, config_path: str | Path | None = None, command: str = "") -> dict[str, str]:
    """ACDD and provenance attributes of a result; what cannot be found out (no git, an installed package) is "".

    ``config_text``: the configuration, verbatim; ``config_path``: its file, of which the commit is recorded;
    ``command``: what the user typed, for ``history``.
    """
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    versions = package_versions(PACKAGES)
    return {
        "date_created": now,
        "history": f"{now} {portable(command) or 'en4dvar'} (en4dvar {versions.get('en4dvar', 'unknown')})",
        "institution": os.environ.get("EN4DVAR_INSTITUTION", ""),
        "configuration": config_text,
        "configuration_file": Path(config_path).name if config_path else "",
        "configuration_git_commit": git_commit(Path(config_path)) if config_path else "",
        "git_commit": _kept_commit(Path(__file__)),
        "package_versions": ", ".join(f"{name} {v}" for name, v in versions.items()),
        "python_version": platform.python_version(),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": f"{cpu_model()}, {os.cpu_count()} logical cores",
    }


def portable(command: str) -> str:
    """A command as a file holds it that others get: of paths that begin at the root of this machine the names alone.

    >>> portable("en4dvar run /home/me/gel.yaml --data '/home/my films/*.csv' --set a.path=/data/x/y.csv")
    "en4dvar run gel.yaml --data '*.csv' --set a.path=y.csv"
    >>> portable("en4dvar run ../gel.yaml --scheduler tcp://10.0.0.1:8786 --set a=/tmp")
    'en4dvar run ../gel.yaml --scheduler tcp://10.0.0.1:8786 --set a=/tmp'
    """
    return _WORD.sub(lambda word: _FOLDERS.sub("", word[0]), command)


_WORD = re.compile(r"'[^']*'|[^\s']+")
_FOLDERS = re.compile(r"(?<![^\s=\[,'])(?:[A-Za-z]:)?[\\/](?:[^\\/,']+[\\/])+(?=[^\\/])")


def package_versions(names: Iterable[str]) -> dict[str, str]:
    versions = {}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = _version(name)
    return versions


_version = cache(metadata.version)  # modules stay what they were when they were imported


def git_commit(path: Path) -> str:
    """Commit of the repository that tracks ``path``, with ``+changes`` where the work tree differs; "" if none."""
    folder = path.resolve().parent
    if not path.exists() or not _git(folder, "ls-files", "--error-unmatch", path.name):
        return ""
    commit = _git(folder, "rev-parse", "HEAD")
    changed = commit and _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}+changes" if changed else commit


_kept_commit = cache(git_commit)  # of this package, as it was imported


def _git(folder: Path, *arguments: str) -> str:
    try:
        words = ["git", "-C", str(folder), *arguments]
        done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def cpu_model() -> str:
    """Name of the processor, as the operating system tells it."""
    with suppress(OSError):  # /proc is Linux's
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


IDENTITY = f"{FOLDER}/run"  # in a run directory
NUMERICAL = ("en4dvar", "numpy", "scipy", "numba", "llvmlite")
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
        return dict(self.data)

    def difference(self, earlier: "Identity", retried: frozenset[str]) -> str:
        """Unified diff from ``earlier`` to this, "" where they agree. Files of ``retried`` data sets may differ."""

        def lines(identity: Identity) -> list[str]:
            data = [f"{name}: {'' if name in retried else content}" for name, content in identity.data]
            return [*identity.settings.splitlines(), "data files:", *data]

        return "\n".join(difflib.unified_diff(lines(earlier), lines(self), "earlier run", "now", lineterm="", n=1))

    def require_same(self, earlier: "Identity | None", path: Path, retried: frozenset[str] = frozenset()) -> None:
        """Raise :class:`OutputError` where the run in ``path`` was another one, with what :meth:`difference` says."""
        if earlier is not None and (difference := self.difference(earlier, retried)):
            raise OutputError(
                f"{path}: the run cannot be resumed to the same result, for this has changed:\n{difference}\n"
                f"give {advised('--force')} to compute everything again, or {advised(*ELSEWHERE)}"
            )


def identity(resolved: str, model: ForwardModel, data: Mapping[str, DataFile]) -> Identity:
    """The identity of a run of the resolved configuration (YAML) on ``data`` (name → where it is)."""
    content = yaml.load(resolved, getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # the same, a tenth of the time
    settings = {key: value for key, value in content.items() if key not in _NO_NUMBERS}
    software = {"python": f"{sys.version_info.major}.{sys.version_info.minor}", **package_versions(NUMERICAL)}
    section = content.get("data") or {}
    stated = [part.get(key) for part in (section, *section.get("series", {}).values()) for key in ("error", "weights")]
    defining = (kind.__module__.partition(".")[0] for kind in type(model).__mro__ if inspect.getmodule(kind))
    tops = dict.fromkeys(("en4dvar", *(top for top in defining if top not in ("builtins", "abc", "typing"))))
    sources = {top: source_digest(top) for top in tops}
    named = [content["model"], stated, *(content.get(key) for key in _PRIOR_FILES)]
    sources |= {str(path): file_digest(path) for path in _paths(named)}
    settings |= {"software": software, "sources": sources}
    text = yaml_text(settings)
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
