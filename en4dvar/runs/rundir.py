"""The run directory: one run at a time, which files a run wrote, and an earlier result kept until the new one is whole.

``.en4dvar-files`` lists what a run wrote, so that replacing it removes that and nothing else. A run with ``--force``
works in ``.en4dvar-next`` and takes the place of the earlier files when it is complete; where that is interrupted, the
next command that opens the directory finishes it.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from en4dvar.errors import OutputError
from en4dvar.files import write_text
from en4dvar.runs.lock import LOCK, locked

LISTING = ".en4dvar-files"
NEXT = ".en4dvar-next"
COMPLETE = ".en4dvar-complete"
OLD = ".en4dvar-old"
FIXED = ("config.yaml", "config.resolved.yaml", "posterior.nc", "twin.nc", "run.log", "report.html", "summary.csv")
FOLDERS = ("datasets", "figures", "checkpoints")
_PARTIAL = re.compile(r"\..+\.\d+\.tmp")  # of en4dvar.files, left by a process that was killed

Mode = Literal["new", "force", "resume", "report"]


@dataclass(frozen=True)
class RunDirectory:
    """``path`` as the user named it; files are written to ``work``, which is ``path`` or ``path/.en4dvar-next``."""

    path: Path
    work: Path

    @classmethod
    @contextmanager
    def open(cls, path: str | Path, mode: Mode = "new") -> Iterator[RunDirectory]:
        """Lock ``path`` for a new run, one that replaces an earlier run, the rest of one, or its report.

        Raises
        ------
        OutputError: the directory is in use; it is not empty (``new``) or holds no run (``resume``); it cannot be
            written, or holds a foreign file where the run would write its own.
        """
        path = Path(path)
        if mode in ("resume", "report") and not path.is_dir():
            raise OutputError(f"{path}: no such run directory")
        with ExitStack() as held:
            try:
                path.mkdir(parents=True, exist_ok=True)
                held.enter_context(locked(path))
                directory = cls(path, _prepare(path, mode))
            except OSError as error:
                raise OutputError(f"{path}: cannot be used as run directory: {error.strerror or error}") from None
            yield directory

    def claim(self, *names: str) -> Path:
        """List files (relative names) as written by this run; returns the path of the last one."""
        known = _listed(self.work)
        if set(names) - set(known):
            _list(self.work, dict.fromkeys([*known, *names]))
        return self.work / names[-1] if names else self.work

    def folder(self, name: str) -> Path:
        """Make the folder ``name``. Raises :class:`OutputError`."""
        try:
            (self.work / name).mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.work / name}: cannot be created: {error.strerror}") from None
        return self.work / name

    @contextmanager
    def claiming(self, *folders: str) -> Iterator[None]:
        """List the files that appear in ``folders`` within, also where that fails."""
        before = self._inside(folders)
        try:
            yield
        finally:
            self.claim(*sorted(p.relative_to(self.work).as_posix() for p in self._inside(folders) - before))

    def _inside(self, folders: Iterable[str]) -> set[Path]:
        return {p for folder in folders for p in (self.work / folder).glob("*") if p.is_file()}

    def remove(self, name: str) -> None:
        """Remove a file if it is there. Raises :class:`OutputError`."""
        try:
            (self.work / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.work / name}: cannot be removed: {error.strerror}") from None

    def publish(self) -> None:
        """The run is complete: where it replaces an earlier one, take its place. Raises :class:`OutputError`."""
        _list(self.work, [name for name in _listed(self.work) if (self.work / name).exists()])
        if self.work != self.path:
            write_text(self.work / COMPLETE, "")
            try:
                _replace_earlier_run(self.path)
            except OSError as error:
                raise OutputError(f"{self.path}: cannot be replaced: {error.strerror or error}") from None


def _prepare(path: Path, mode: Mode) -> Path:
    """The folder to write to. Raises :class:`OutputError`."""
    following = path / NEXT
    _remove_folder(path / OLD)
    if (following / COMPLETE).exists():
        _replace_earlier_run(path)
    if not (following / LISTING).exists():  # of a run that ended before it began
        _remove_folder(following)
    listed = set(_listed(path))
    if mode in ("resume", "report"):
        work = following if mode == "resume" and (following / LISTING).exists() else path
        if not (work / LISTING).exists():
            raise OutputError(f"{path}: holds no run")
        _remove_partial(work)
        return work
    others = [p for p in path.iterdir() if p.name != LOCK and not _PARTIAL.fullmatch(p.name)]
    if mode == "new" and others:
        raise OutputError(
            f"{path}: not empty; give --resume to continue its run, --force to replace it, or another --out"
        )
    foreign = [name for name in FIXED if (path / name).exists() and name not in listed]
    if foreign:
        raise OutputError(f"{path}: {foreign[0]} was not written by a run and would be replaced; move it away")
    _remove_folder(following)  # of a run that was given up
    _remove_partial(path)
    work = path
    if any((path / name).exists() for name in listed):
        work = following
        work.mkdir()
    _list(work, ())
    return work


def _replace_earlier_run(path: Path) -> None:
    """Move the files of ``.en4dvar-next`` into place. Can be repeated after it was interrupted anywhere."""
    following = path / NEXT
    names = _listed(following)
    _remove(path, set(_listed(path)) - set(names))
    for name in names:
        if (following / name).exists():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (following / name).replace(path / name)
    _list(path, names)
    following.rename(path / OLD)  # at once: half of this folder would look like an interrupted run
    _remove_folder(path / OLD)


def _remove_folder(folder: Path) -> None:
    if folder.is_dir():
        shutil.rmtree(folder)


def _remove(path: Path, names: Iterable[str]) -> None:
    root = path.resolve()
    for name in names:
        file = (root / name).resolve()
        if file.is_relative_to(root) and file.is_file():
            file.unlink()
    for folder in FOLDERS:
        if (path / folder).is_dir() and not any((path / folder).iterdir()):
            (path / folder).rmdir()


def _remove_partial(work: Path) -> None:
    for folder in (work, *(work / name for name in FOLDERS)):
        for file in folder.glob(".*.tmp"):
            if _PARTIAL.fullmatch(file.name):
                file.unlink()


def _list(work: Path, names: Iterable[str]) -> None:
    write_text(work / LISTING, "".join(f"{name}\n" for name in names))


def _listed(work: Path) -> tuple[str, ...]:
    try:
        return tuple((work / LISTING).read_text(encoding="utf-8").splitlines())
    except FileNotFoundError:
        return ()
