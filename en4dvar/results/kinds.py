"""The kinds of runs, and of which one a finished run is."""

import shlex
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside, open_plain
from en4dvar.plumbing.hints import listed

LISTING = ".en4dvar-files"  # in a run directory: what the run has written, or will
KINDS = {  # name → its declaration, imported when it is wanted
    "estimate": "en4dvar.runs.runner:EstimateKind",
    "sequence": "en4dvar.runs.cycles:SequenceKind",
    "twin": "en4dvar.runs.cycles:TwinKind",
    "design": "en4dvar.runs.design_run:DesignKind",
    "sweep-twin": "en4dvar.runs.twin_sweep:SweepKind",
    "calibrate": "en4dvar.runs.calibration_run:CalibrationKind",
    "joint": "en4dvar.runs.together:JointKind",
    "population": "en4dvar.runs.together:PopulationKind",
}


def kind_named(name: str) -> Any:
    """The declaration of a kind, a :class:`~en4dvar.runs.engine.Kind`. Raises :class:`KeyError`."""
    return resolve_name(KINDS[name])


def kind_in(folder: Path) -> Any:
    """The kind of the finished run in ``folder``; that of an estimate where there is no result of another kind."""
    for kind in map(kind_named, KINDS):  # that of an estimate first
        tables = kind.files if kind.result.endswith(".csv") else ()  # another's sweep.csv stands alone
        if all((folder / name).is_file() for name in (kind.result, *tables) if "/" not in name):
            return kind
    return kind_named("estimate")


def require_no_other(folder: Path) -> None:
    """Raise :class:`OutputError`, which says what reads it, where ``folder`` holds a finished run of another kind than
    an estimate; and where it holds a run that has no result yet, how it is continued.
    """
    kind = kind_in(folder)
    if kind is kind_named("estimate"):
        require_result(folder)
        return
    tables = [str(folder / name) for name in (*kind.files, *kind.pages) if name.endswith(".csv")]
    where = f"; its numbers are in {' and '.join(tables)}" if tables else ""
    read = f"; it is read by {listed(f'en4dvar {command}' for command in kind.readers)}" if kind.readers else ""
    raise OutputError(f"{folder}: holds a run of the kind {kind.name}, and no posterior.nc of an estimate{where}{read}")


def require_result(folder: Path) -> None:
    """Raise :class:`OutputError` where a run has begun in ``folder``, and what it is known by is not there."""
    listed = lines_of_list(folder)
    kind = next((kind for kind in map(kind_named, KINDS) if kind.result in listed), None)
    if kind is None or (folder / kind.result).exists():
        return
    words = f"a run of the kind {kind.name} without a result: it was stopped, has failed or is at work"
    how = "the command of the first line of its run.log with --resume" if "run.log" in listed else "its command"
    raise OutputError(f"{folder}: holds {words}; to continue it, repeat {how}")


def lines_of_list(work: Path) -> tuple[str, ...]:
    """The list of ``work`` as it is written. Raises :class:`OutputError`."""
    if work.is_file():
        of = f"; 'en4dvar run {shlex.quote(str(work))}' makes one" if work.suffix in (".yaml", ".yml") else ""
        raise OutputError(f"{work}: a file, not the directory of a run{of}")
    listing = inside(work, LISTING)
    try:
        with open_plain(listing) as file:
            return tuple(file.read().decode("utf-8").splitlines())
    except FileNotFoundError:
        return ()
    except UnicodeDecodeError:
        raise OutputError(f"{listing}: damaged; it is not a list of files") from None
