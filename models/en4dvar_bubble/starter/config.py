"""A starter configuration as text, from data files and what their columns mean."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from en4dvar.config import resolve
from en4dvar.config.build import build_one, find_files
from en4dvar.config.document import parse_document
from en4dvar.errors import ConfigError, DataError
from en4dvar.files import expanded
from en4dvar.inputs.readers import Column, TimeStep, read_series
from en4dvar.inputs.text_table import Decimal
from en4dvar.state import Array
from en4dvar.units import UnitError, parse_quantity, parse_unit
from en4dvar_bubble.starter.look import Start
from en4dvar_bubble.starter.page import Source, yaml_text
from en4dvar_bubble.starter.proposal import Proposal, propose, with_columns

_NAMED_UNIT = re.compile(r"[_ \[(/]([a-zA-Zµμ]+)[\])]?$")
_FRAMES = re.compile(r"(?i)(frame|bild|image|index|#|n$|nr)")
_DIAMETER = re.compile(r"(?i)(d|diam\w*|durchmesser)([ _(\[].*)?$")
_PIXELS = re.compile(r"(?i)(?<![a-z])(px|pix|pixels?)(?![a-z])|_(px|pix)")


@dataclass(frozen=True)
class Proposed:
    """``text``: the YAML file. ``proposal``: what went into it, what the data show and what to mind."""

    text: str
    proposal: Proposal


def propose_config(
    data: str | Path,
    *,
    radius: tuple[str, str],
    time: tuple[str, str] | None = None,
    time_step: str | None = None,
    decimal: Decimal = ".",
    start: Start | None = None,
    law: str | None = None,
    folder: str | Path = ".",
    name: str | None = None,
    errors: tuple[str, ...] = (),
    command: str = "en4dvar_bubble.starter.propose_config",
) -> Proposed:
    """A commented configuration for radius histories that loads and whose data can be read.

    Parameters
    ----------
    data: a CSV or ``.mat`` file, a folder or a pattern, relative to the current folder.
    radius, time: name of the column and its unit, never guessed; ``time_step`` instead of ``time``: a quantity such
        as ``"3.7 us"``.
    decimal: decimal sign of the numbers in CSV files.
    start, law: instead of what the data suggest.
    folder: where the file will be; the path of the data inside it is relative to this folder.
    name: of the run, whose results go to ``runs/<name>``; default: that of the data.
    errors: columns of the standard deviations of radii and times, in the units of ``radius`` and ``time``.
    command: told in the head of the file.

    Raises
    ------
    DataError: no usable file (of several, those that are not are named among the warnings), no bubble in them, or data
    sets that suggest different starts. ConfigError: unknown law, or
    neither ``time`` nor ``time_step``. UnitError: a unit that is not of its kind.
    """
    if (time is None) == (time_step is None):
        raise ConfigError("give either the column of times and its unit, or a constant time step")
    source = Source(path_from(Path(folder), str(data)), time, time_step, radius, decimal, errors)
    files = find_files(Path.cwd(), [str(data)])
    found, unusable = histories(files, source)
    proposal = propose(found, start, law)
    if errors:
        proposal = with_columns(proposal, errors)
    proposal = replace(proposal, warnings=(*proposal.warnings, *doubts(source), *unusable))
    text = yaml_text(name or run_name(str(data)), source, proposal, command)
    config = resolve(parse_document(text), Path(folder).absolute())
    for dataset in found:
        build_one(config, dataset, files[dataset])
    return Proposed(text, proposal)


def histories(files: Mapping[str, Path], source: Source) -> tuple[dict[str, tuple[Array, Array]], list[str]]:
    """Times (K,) s and radii (K,) m of each file, and why others cannot be used.

    Raises
    ------
    DataError: none can be used. UnitError: a unit that is not of its kind.
    """
    step = TimeStep(value=parse_quantity(source.time_step, "s")) if source.time_step else None
    time = step or Column(*(source.time or ("", "s")), "s")
    found: dict[str, tuple[Array, Array]] = {}
    unusable: list[str] = []
    for name, file in files.items():
        try:
            series = read_series(file, time, Column(*source.radius, "m", positive=True), decimal=source.decimal)
        except DataError as error:
            unusable.append(str(error))
        else:
            found[name] = (series.times, series.values)
    if not found:
        raise DataError("\n".join(unusable))
    return found, unusable


def doubts(source: Source) -> list[str]:
    """Where the name of a column says something else than its unit, or than what it is used for."""
    found = []
    for what, column in (("times", source.time), ("radii", source.radius)):
        if column is None:
            continue
        name, unit = column
        if _PIXELS.search(name):
            found.append(f"{name!r} seems to hold pixels; convert them to a length (the size of a pixel is no unit)")
        if what == "times" and _FRAMES.match(name):
            found.append(f"{name!r} seems to count frames; then give --time-step with the time between two of them")
        if what == "radii" and _DIAMETER.match(name):
            found.append(f"{name!r} seems to hold diameters; the model's observable is the radius: halve them")
        named = _unit_in(name)
        if named and parse_unit(named).powers == parse_unit(unit).powers and parse_unit(named) != parse_unit(unit):
            found.append(f"the name of column {name!r} says {named}, but its unit is given as {unit}")
    return found


def _unit_in(name: str) -> str:
    """The unit that a column's name ends with, as in ``R_mm`` or ``Time (µs)``; "" where there is none."""
    match = _NAMED_UNIT.search(name)
    try:
        return match[1] if match and parse_unit(match[1]) else ""
    except UnitError:
        return ""


def path_from(folder: Path, data: str) -> str:
    """``data`` as a file in ``folder`` says it: relative where both share more than the root."""
    path, here = expanded(data).absolute(), folder.absolute()
    near = path.parts[:2] == here.parts[:2] and len(here.parts) > 1
    return Path(os.path.relpath(path, here)).as_posix() if near else path.as_posix()


def run_name(data: str) -> str:
    """Name of a run from the path of its data (or of its file): letters, digits, dots and dashes."""
    path = expanded(data).absolute()
    stem = path.parent.name if any(sign in path.name for sign in "*?[") else path.name if path.is_dir() else path.stem
    return re.sub(r"[^\w.+-]", "_", stem).lstrip(".-+") or "bubble"
