"""A starter configuration as text, from data files and what their columns mean."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from en4dvar.config import resolve
from en4dvar.config.document import parse_document
from en4dvar.errors import ConfigError
from en4dvar.inputs.build import build, find_files
from en4dvar.inputs.readers import Column, Step, read_series
from en4dvar.inputs.units import parse_quantity
from en4dvar.state import Array
from en4dvar_bubble.starter.look import Start
from en4dvar_bubble.starter.page import Source, yaml_text
from en4dvar_bubble.starter.proposal import Proposal, propose


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
    start: Start | None = None,
    law: str | None = None,
    folder: str | Path = ".",
    name: str | None = None,
    command: str = "en4dvar_bubble.starter.propose_config",
) -> Proposed:
    """A commented configuration for radius histories that loads and whose data can be read.

    Parameters
    ----------
    data: a CSV or ``.mat`` file, a folder or a pattern, relative to the current folder.
    radius, time: name of the column and its unit, never guessed; ``time_step`` instead of ``time``: a quantity such
        as ``"3.7 us"``.
    start, law: instead of what the data suggest.
    folder: where the file will be; the path of the data inside it is relative to this folder.
    name: of the run, whose results go to ``runs/<name>``; default: that of the data.
    command: told in the head of the file.

    Raises
    ------
    DataError: no data, no bubble in them, or data sets that suggest different starts. ConfigError: unknown law, or
    neither ``time`` nor ``time_step``. UnitError: a unit that is not of its kind.
    """
    if (time is None) == (time_step is None):
        raise ConfigError("give either the column of times and its unit, or a constant time step")
    source = Source(path_from(Path(folder), str(data)), time, time_step, radius)
    files = find_files(Path.cwd(), [str(data)])
    proposal = propose(histories(files, source), start, law)
    text = yaml_text(name or run_name(str(data)), source, proposal, command)
    build(resolve(parse_document(text), Path(folder).absolute()))
    return Proposed(text, proposal)


def histories(files: Mapping[str, Path], source: Source) -> dict[str, tuple[Array, Array]]:
    """Times (K,) s and radii (K,) m of each file. Raises :class:`DataError`, :class:`UnitError`."""
    step = Step(value=parse_quantity(source.time_step, "s")) if source.time_step else None
    time = step or Column(*(source.time or ("", "s")), "s")
    found = {name: read_series(file, time, Column(*source.radius, "m")) for name, file in files.items()}
    return {name: (series.times, series.values) for name, series in found.items()}


def path_from(folder: Path, data: str) -> str:
    """``data`` as a file in ``folder`` says it: relative where both share more than the root."""
    path, here = Path(data).expanduser().absolute(), folder.absolute()
    near = path.parts[:2] == here.parts[:2] and len(here.parts) > 1
    return Path(os.path.relpath(path, here)).as_posix() if near else path.as_posix()


def run_name(data: str) -> str:
    """Name of a run from the path of its data (or of its file): letters, digits, dots and dashes."""
    path = Path(data).expanduser().absolute()
    stem = path.parent.name if any(sign in path.name for sign in "*?[") else path.name if path.is_dir() else path.stem
    return re.sub(r"[^\w.+-]", "_", stem).lstrip(".-+") or "bubble"
