"""Where a result comes from: versions, platform, commit, configuration; as attributes of the file that holds it."""

import os
import platform
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

PACKAGES = ("en4dvar", "numpy", "scipy", "numba", "xarray", "netCDF4", "pydantic", "matplotlib")


def provenance(config_text: str, config_path: str | Path | None = None, command: str = "") -> dict[str, str]:
    """ACDD and provenance attributes for :meth:`en4dvar.report.result.Result.from_analysis`.

    ``config_text``: the configuration, verbatim. ``config_path``: the file it was read from; the commit of the
    repository that tracks it is recorded. ``command``: what the user typed, for ``history``.

    Nothing here fails: what cannot be found out (no git, an installed package) is left as an empty string.
    """
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    versions = package_versions(PACKAGES)
    return {
        "date_created": now,
        "history": f"{now} {command or 'en4dvar'} (en4dvar {versions.get('en4dvar', 'unknown')})",
        "institution": os.environ.get("EN4DVAR_INSTITUTION", ""),
        "configuration": config_text,
        "configuration_file": Path(config_path).name if config_path else "",
        "configuration_git_commit": git_commit(Path(config_path)) if config_path else "",
        "git_commit": _own_commit(),
        "package_versions": ", ".join(f"{name} {v}" for name, v in versions.items()),
        "python_version": platform.python_version(),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": f"{cpu_model()}, {os.cpu_count()} logical cores",
    }


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Versions of those packages that are installed."""
    versions = {}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = _version(name)
    return versions


_version = cache(metadata.version)  # modules stay what they were when they were imported


@cache
def _own_commit() -> str:
    return git_commit(Path(__file__))


def git_commit(path: Path) -> str:
    """Commit of the repository that tracks ``path``, with ``+changes`` where the work tree differs; "" if none."""
    folder = path.resolve().parent
    if not path.exists() or not _git(folder, "ls-files", "--error-unmatch", path.name):
        return ""
    commit = _git(folder, "rev-parse", "HEAD")
    changed = commit and _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}+changes" if changed else commit


def _git(folder: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
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
