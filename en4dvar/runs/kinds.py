"""Every kind of run of the framework; a module is imported when its kind is wanted."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from en4dvar.runs.kind import Kind

KINDS = {
    "estimate": "en4dvar.runs.runner:EstimateKind",
    "sequence": "en4dvar.runs.sequence_run:SequenceKind",
    "twin": "en4dvar.runs.twin_run:TwinKind",
    "design": "en4dvar.runs.design_run:DesignKind",
    "sweep-twin": "en4dvar.runs.twin_sweep:SweepKind",
    "calibrate": "en4dvar.runs.calibration_run:CalibrationKind",
    "joint": "en4dvar.runs.joint_run:JointKind",
    "population": "en4dvar.runs.population_run:PopulationKind",
}


def kind_named(name: str) -> type[Kind]:
    """The declaration of a kind. Raises :class:`KeyError`."""
    module, _, attribute = KINDS[name].partition(":")
    declared: type[Kind] = getattr(import_module(module), attribute)
    return declared


def kind_in(folder: Path) -> type[Kind]:
    """The kind of the finished run in ``folder``; that of an estimate where there is no result of another kind."""
    others = (kind_named(name) for name in KINDS if name != "estimate")
    estimate = kind_named("estimate")
    if (folder / estimate.result).exists():
        return estimate
    return next((kind for kind in others if (folder / kind.result).is_file()), estimate)
