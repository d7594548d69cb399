"""The kinds of runs, and of which one a finished run is."""

from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.hints import listed

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
    kinds = map(kind_named, KINDS)  # that of an estimate first
    return next((kind for kind in kinds if (folder / kind.result).is_file()), kind_named("estimate"))


def require_no_other(folder: Path) -> None:
    """Raise :class:`OutputError`, which says what reads it, where ``folder`` holds a finished run of another kind than
    an estimate.
    """
    kind = kind_in(folder)
    if kind is kind_named("estimate"):
        return
    tables = [str(folder / name) for name in (*kind.files, *kind.pages) if name.endswith(".csv")]
    if not all((folder / name).is_file() for name in kind.files if name.endswith(".csv")):  # another's sweep.csv
        return
    where = f"; its numbers are in {' and '.join(tables)}" if tables else ""
    read = f"; it is read by {listed(f'en4dvar {command}' for command in kind.readers)}" if kind.readers else ""
    raise OutputError(f"{folder}: holds a run of the kind {kind.name}, and no posterior.nc of an estimate{where}{read}")
