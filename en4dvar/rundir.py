"""The run directory: which files a run wrote there, so that ``--force`` removes those and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from en4dvar.errors import OutputError
from en4dvar.files import write_text

LISTING = ".en4dvar-files"
FIXED = ("config.yaml", "config.resolved.yaml", "posterior.nc", "run.log", "report.html", "summary.csv")
FOLDERS = ("datasets", "figures")


@dataclass(frozen=True)
class RunDirectory:
    """A directory that one run writes to; ``.en4dvar-files`` lists what it wrote."""

    path: Path

    @classmethod
    def create(cls, path: str | Path, force: bool = False) -> RunDirectory:
        """Make ``path`` ready for a run.

        With ``force`` the files of an earlier run are removed; files that no run wrote stay.

        Raises
        ------
        OutputError: the directory is not empty (without ``force``), cannot be written, or holds a foreign file where
            the run would write its own.
        """
        path = Path(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()):
                if not force:
                    raise OutputError(f"{path}: not empty; give --force to replace an earlier run, or another --out")
                _remove_earlier_run(path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be used as run directory: {error.strerror or error}") from None
        foreign = [name for name in FIXED if (path / name).exists()]
        if foreign:
            raise OutputError(f"{path}: {foreign[0]} was not written by a run and would be replaced; move it away")
        directory = cls(path)
        directory.claim()
        return directory

    def claim(self, *names: str) -> Path:
        """List files (relative names) as written by this run; returns the path of the last one."""
        listed = dict.fromkeys([*self.files(), *names])
        write_text(self.path / LISTING, "".join(f"{name}\n" for name in listed))
        return self.path / names[-1] if names else self.path

    def folder(self, name: str) -> Path:
        """Make the folder ``name``. Raises :class:`OutputError`."""
        try:
            (self.path / name).mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.path / name}: cannot be created: {error.strerror}") from None
        return self.path / name

    def claim_folder(self, name: str, before: frozenset[Path]) -> None:
        """List the files of folder ``name`` that were not there ``before``."""
        self.claim(*sorted(p.relative_to(self.path).as_posix() for p in self.listing(name) - before))

    def listing(self, name: str) -> frozenset[Path]:
        """The files of folder ``name`` now."""
        return frozenset(p for p in (self.path / name).glob("*") if p.is_file())

    def files(self) -> list[str]:
        """Relative names of what the run wrote."""
        listing = self.path / LISTING
        return listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []


def _remove_earlier_run(path: Path) -> None:
    root = path.resolve()
    for name in RunDirectory(path).files():
        file = (root / name).resolve()
        if file.is_relative_to(root) and file.is_file():
            file.unlink()
    (path / LISTING).unlink(missing_ok=True)
    for folder in FOLDERS:
        if (path / folder).is_dir() and not any((path / folder).iterdir()):
            (path / folder).rmdir()
