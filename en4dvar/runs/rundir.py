"""The run directory: one run at a time, which files a run wrote, and an earlier result kept until the new one is whole.

``.en4dvar-files`` lists what a run wrote, so that replacing it removes that and nothing else. A run with ``--force``
works in ``.en4dvar-next`` and takes the place of the earlier files when it is complete; where that is interrupted, the
next run there finishes it, and commands that read say so and read nothing.

The directory may be a stranger's: every name, of the list or of ours, goes through
:func:`en4dvar.plumbing.files.inside`.
"""

import itertools
import os
import re
import shlex
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from en4dvar.executor.processes import end_unguarded
from en4dvar.plumbing.called import ELSEWHERE, advised, note
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside, make_folder, refused, remove_file, replace_file, write_text
from en4dvar.results.kinds import KINDS, LISTING, kind_named, lines_of_list
from en4dvar.results.store import COMPLETE, NEXT, require_settled
from en4dvar.runs.interrupt import begun
from en4dvar.runs.lock import LOCK, locked

OLD = ".en4dvar-old"
FOLDERS = ("figures", "pages", "checkpoints")
PARTIAL = re.compile(r"\..+\.\d+\.tmp")  # of en4dvar.plumbing.files, left by a process that was killed
LOG = "run.log"
OF_EVERY_RUN = ("config.yaml", "config.resolved.yaml", LOG)
GIVEN = "data.csv"  # readings that a script handed over, written before its run begins
BESIDE = re.compile(r"data(\..+)?\.csv")  # these, and further arrays
Mode = Literal["new", "force", "resume", "report", "beside"]


@dataclass(frozen=True)
class RunDirectory:
    """``path`` as the user named it; files are written to ``work``, which is ``home`` or ``home/.en4dvar-next``.
    ``home`` is ``path`` from the root on: a model may change the current directory. ``resumed``: a run was there.
    """

    path: Path
    home: Path
    work: Path
    resumed: bool

    @classmethod
    @contextmanager
    def open(cls, path: str | Path, mode: Mode = "new", files: Sequence[str] = ()) -> "Iterator[RunDirectory]":
        """Lock ``path`` for a new run, one that replaces an earlier run, the rest of one, or its report; ``beside`` for
        files that stand beside whatever is there, such as the result of an estimate of several runs.

        ``files``: what the run will write (relative names, ``*`` stands for any text). ``resume`` of what is missing or
        empty is a new run: that of a batch job which was killed before it began. A new run that fails before it has
        written a file leaves nothing behind, unless it was interrupted and can be resumed.

        Raises :class:`OutputError`: the directory is in use; it is not empty (``new``) or holds no run (``resume``); it
        cannot be written, or holds a foreign file where the run would write its own, or a link.
        """
        end_unguarded()
        path = Path(path)
        home = path.absolute()
        if mode == "resume":
            note_beginning(path)
        if mode == "report" and not path.is_dir():
            raise OutputError(f"{path}: no such run directory")
        with ExitStack() as held:
            with refused(path, "cannot be used as run directory"):
                if not home.is_dir():
                    home.mkdir(parents=True)
                    held.callback(_remove_if_empty, home)
                held.enter_context(locked(home))
                resumed = mode in ("report", "beside") or (mode == "resume" and holds_run(home))
                work = _opened(path, mode) if resumed else _prepare(path, mode)  # which tell the path as it was given
                directory = cls(path, home, work.absolute(), resumed)
                if mode == "beside":
                    directory._refuse_foreign(files)
                elif not resumed:
                    directory._refuse_foreign((*OF_EVERY_RUN, *files))
                    write_list(directory.work, ())
                elif mode == "resume" and files and not {*files}.intersection(lines_of_list(work)):
                    for name in lines_of_list(work):
                        if not (name in OF_EVERY_RUN or "/" in name or BESIDE.fullmatch(name)):
                            words = f"holds {name} of another command; give {advised(*ELSEWHERE)}"
                            raise OutputError(f"{path}: {words}")
            try:
                yield directory
            except BaseException as error:
                if not begun(error):
                    directory._withdraw()
                raise

    def at(self, name: str) -> Path:
        """Where the run writes a file. Raises :class:`OutputError` as :func:`~en4dvar.plumbing.files.inside`."""
        return inside(self.work, name)

    def claim(self, *names: str) -> None:
        """List files (relative names) as written by this run.

        ``*`` in a name stands for any text: of 10⁵ checkpoints a few are there at a time. Raises :class:`OutputError`
        where there is such a file that no run wrote.
        """
        known = lines_of_list(self.work)
        for name in names:
            self.at(name)  # refuses a link
        if new := [name for name in names if name not in known]:
            self._refuse_foreign([name for name in new if name != LOG])  # which is open by then
            write_list(self.work, [*known, *dict.fromkeys(new)])

    def _refuse_foreign(self, names: Iterable[str]) -> None:
        """Raise :class:`OutputError` where a run would replace a file that none wrote."""
        listed = set(listed_files(self.home))
        for name in names:
            for file in matching(self.home, name):
                if file not in listed:
                    raise OutputError(
                        f"{self.path}: {file} was not written by a run and would be replaced; move it away"
                    )

    def folder(self, name: str) -> Path:
        """Make the folder ``name``. Raises :class:`OutputError`."""
        return make_folder(self.at(name))

    def remove(self, name: str) -> None:
        """Remove a file if it is there. Raises :class:`OutputError`."""
        remove_file(self.at(name))

    def publish(self) -> None:
        """The run is complete: where it replaces an earlier one, take its place. Raises :class:`OutputError`."""
        if names := [name for name in listed_files(self.work) if self.at(name).exists()]:
            write_list(self.work, names)
        else:
            self.remove(LISTING)
        if self.work != self.home:
            write_text(self.at(COMPLETE), "")
            with refused(self.path, "cannot be replaced"):
                replace_earlier_run(self.home)

    def _withdraw(self) -> None:
        """Take back what :meth:`open` made, where the run has claimed nothing."""
        with suppress(OSError, OutputError):
            if self.resumed or any(self.at(name).exists() for name in listed_files(self.work)):
                return
            for name in (LOG, LISTING):  # the list last: by it the rest is known as a run's
                self.at(name).unlink(missing_ok=True)
            if self.work != self.home:
                remove_folder(self.work)


def holds_run(path: Path) -> bool:
    """Whether a run has begun in a directory."""
    return (path / LISTING).exists() or (path / NEXT / LISTING).exists()


def note_beginning(path: Path) -> None:
    """Tell who asked that a run be resumed where none has begun: that of a batch job which was killed before."""
    if not holds_run(path):
        note(f"{path} holds no run yet; this one begins")


def _opened(path: Path, mode: Mode) -> Path:
    """The folder of the run that is there, to write to. Raises :class:`OutputError`."""
    if mode in ("report", "beside"):
        require_settled(path)
        work = path
    else:
        finish_replacement(path)
        work = inside(path, NEXT) if (path / NEXT / LISTING).exists() else path
    if mode != "beside" and not (work / LISTING).exists():
        raise OutputError(f"{path}: holds no run")
    remove_partial(work)
    return work


def _prepare(path: Path, mode: Mode) -> Path:
    """The folder of a new run, to write to. Raises :class:`OutputError`."""
    finish_replacement(path)
    listed = listed_files(path)
    others = {p.name for p in path.iterdir() if not (PARTIAL.fullmatch(p.name) or BESIDE.fullmatch(p.name))}
    others -= {LOCK}
    if mode == "resume" and others:
        raise OutputError(f"{path}: holds no run")
    if mode == "new" and (listed or others - {LISTING}):  # an empty list is of a run that was killed before it began
        raise OutputError(_occupied(path, listed))
    following = inside(path, NEXT)
    remove_folder(following)  # of a run that was given up
    remove_partial(path)
    work = path
    if any((path / name).exists() for name in listed):
        work = following
        work.mkdir()
    return work


def _occupied(path: Path, listed: Sequence[str]) -> str:
    """What is in the directory, and what can be typed."""
    named = path if path.name not in ("", "..") else path.resolve()
    beside = next(p for i in itertools.count(2) if not (p := named.parent / f"{named.name or 'run'}_{i}").exists())
    another = f"{advised('--out', 'the directory')} {shlex.quote(str(beside))} keeps both"
    force = f"{advised('--force')} replaces it, {another}"
    if not listed:
        return f"{path}: not empty, and not of a run; {another}"
    held = [path / name for name in listed if "/" not in name and (path / name).is_file()]
    ends = [kind_named(name).result for name in KINDS]  # each written as a run ends
    ended = [file.stat().st_mtime for file in held if file.suffix == ".nc" or file.name in ends]
    if not ended or (path / NEXT / LISTING).exists():
        return f"{path}: not empty: a run; {advised('--resume')} continues it if it has not ended, {force}"
    when = datetime.fromtimestamp(max(ended)).strftime("%Y-%m-%d %H:%M")
    to_read = next((f", see {file}" for file in held if file.suffix == ".html"), "")
    return f"{path}: not empty: a finished run of {when}{to_read}; {force}"


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


# The list of what a run wrote, and a new run's taking the place of an earlier one's


def finish_replacement(path: Path) -> None:
    """Put in place what an earlier run had completed, and clear away what it had not begun."""
    following = inside(path, NEXT)
    remove_folder(inside(path, OLD))
    if (following / COMPLETE).exists():
        replace_earlier_run(path)
    if not (following / LISTING).exists():  # of a run that ended before it began
        remove_folder(following)


def replace_earlier_run(path: Path) -> None:
    """Move the files of ``.en4dvar-next`` into place. Can be repeated after it was interrupted anywhere."""
    following = inside(path, NEXT)
    names = listed_files(following)
    targets = [inside(path, name) for name in names]
    for file in (inside(path, name) for name in set(listed_files(path)) - set(names)):
        if file.is_file():
            file.unlink()
    for folder in (inside(path, name) for name in FOLDERS):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    for name, target in zip(names, targets, strict=True):
        if (following / name).exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            replace_file(following / name, target)
    write_list(path, names)
    replace_file(following, path / OLD)  # at once: half of this folder would look like an interrupted run
    remove_folder(path / OLD)


def remove_folder(folder: Path) -> None:
    """Remove a folder and what is in it, if it is there; links in it are removed, not followed."""
    if folder.is_dir():
        shutil.rmtree(folder)


def remove_partial(work: Path) -> None:
    """Remove what a process that was killed had half written."""
    for folder in (work, *(inside(work, name) for name in FOLDERS)):
        for file in folder.glob(".*.tmp"):
            if PARTIAL.fullmatch(file.name):
                file.unlink()


def write_list(work: Path, names: Iterable[str]) -> None:
    """List the files of a run. Raises :class:`OutputError`."""
    write_text(work / LISTING, "".join(f"{name}\n" for name in names))


def listed_files(work: Path) -> tuple[str, ...]:
    """The files that the list of ``work`` names, each of a place in ``work``. Raises :class:`OutputError`."""
    names: list[str] = []
    for line in lines_of_list(work):
        inside(work, line)
        names += matching(work, line) if "*" in line else [line]  # those of a folder that are there
    return tuple(names)


def matching(work: Path, name: str) -> list[str]:
    """The files in ``work`` that a name of a list stands for, ``*`` for any text. Raises :class:`OutputError`."""
    place = inside(work, name)
    if "*" not in name:
        return [place.relative_to(work).as_posix()] * os.path.lexists(place)
    there = (file for file in work.glob(name) if file.is_symlink() or not file.is_dir())
    return sorted(file.relative_to(work).as_posix() for file in there)
