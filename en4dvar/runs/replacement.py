"""The files of a run directory: the list of what a run wrote, and a new run's taking the place of an earlier one's.

The directory may be a stranger's: every name, of the list or of ours, goes through
:func:`en4dvar.plumbing.files.inside`.
"""

import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside, open_plain, replace_file, write_text
from en4dvar.results.store import COMPLETE, NEXT

LISTING = ".en4dvar-files"
OLD = ".en4dvar-old"
FOLDERS = ("datasets", "figures", "pages", "checkpoints")
PARTIAL = re.compile(r"\..+\.\d+\.tmp")  # of en4dvar.plumbing.files, left by a process that was killed


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
    _remove(path, set(listed_files(path)) - set(names))
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


def _remove(path: Path, names: Iterable[str]) -> None:
    for name in names:
        if (file := inside(path, name)).is_file():
            file.unlink()
    for name in FOLDERS:
        if (folder := inside(path, name)).is_dir() and not any(folder.iterdir()):
            folder.rmdir()


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
    return tuple(name for line in lines_of_list(work) for name in _named(work, line))


def _named(work: Path, line: str) -> list[str]:
    """What a line of the list stands for: a file, or with ``*`` those of a folder that are there."""
    inside(work, line)
    return matching(work, line) if "*" in line else [line]


def matching(work: Path, name: str) -> list[str]:
    """The files in ``work`` that a name of a list stands for, ``*`` for any text. Raises :class:`OutputError`."""
    place = inside(work, name)
    if "*" not in name:
        return [place.relative_to(work).as_posix()] * os.path.lexists(place)
    there = (file for file in work.glob(name) if file.is_symlink() or not file.is_dir())
    return sorted(file.relative_to(work).as_posix() for file in there)


def lines_of_list(work: Path) -> tuple[str, ...]:
    """The list of ``work`` as it is written. Raises :class:`OutputError`."""
    listing = inside(work, LISTING)
    try:
        with open_plain(listing) as file:
            return tuple(file.read().decode("utf-8").splitlines())
    except FileNotFoundError:
        return ()
    except UnicodeDecodeError:
        raise OutputError(f"{listing}: damaged; it is not a list of files") from None
