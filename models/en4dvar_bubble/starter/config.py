"""A starter configuration as text, from data files and what their columns mean."""

import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from en4dvar.assembly.build import build_one
from en4dvar.assembly.reading import find_files, with_parts
from en4dvar.config import resolve
from en4dvar.config.document import parse_document
from en4dvar.inputs.implausible import step_doubts
from en4dvar.inputs.matfile import indexed
from en4dvar.inputs.parts import ANY, Column, DataFile, Layout, TimeStep
from en4dvar.inputs.readers import AGAIN, BELOW, CLIPPED, FAR, LEVEL, ODD, Readings, read_series
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.files import expanded, path_from
from en4dvar.plumbing.units import UnitError, convert, parse_quantity, parse_unit
from en4dvar_bubble.starter.elsewhere import Entry, known, scale_of
from en4dvar_bubble.starter.grouped import grouped, parted
from en4dvar_bubble.starter.look import Start, usable
from en4dvar_bubble.starter.proposal import Proposal, propose, with_columns

SCHEMA_FILE = "en4dvar.schema.json"
_PLAIN = re.compile(r"([A-Za-z_]|\.{0,2}/)([\w ./*-]*[\w./*])?")
_WORDS = ("true", "false", "null", "yes", "no", "on", "off")
FRAMES = re.compile(r"(?i)(frame|bild|image|index|#|n$|nr).*")
DIAMETER = re.compile(r"(?i)(d|(.*[\W_])?diam\w*|.*durchmesser)([ _(\[].*)?$")
AREA = re.compile(r"(?i)(?!.*(rad(ius|ii)|diam|durchm|(\b|_)r(\b|_)))((.*[\W_])?area|.*fl(ä|ae)che)([ _(\[].*)?$")
EACH_ROW = (
    "each row is taken for the next frame: one that has no row, as where no bubble was seen, makes all "
    "later times too early; give a column of times or of frames, or write NaN in its row"
)
OF_AREA = "of an area the radius is √(area/π): write a column of it"
_REST = re.compile(r"(?i)(.*\.)?r_?eq")
LENGTHS, TIMES = ("nm", "um", "mm", "m"), ("ns", "us", "ms", "s")
ODD_SCALE = 50.0  # of the median of all files: bubbles of one experiment are closer
_DELAY = re.compile(r"(?i)(.*\.)?((trigger|pulse|camera|laser)[ _-]?)?(delay|trigger|time[ _]?zero|t[ _]?zero|t_?0)")
AT_REST = (0.02, 0.9)  # of R_max
PIXELS = re.compile(r"(?i)(?<![a-z])(px|pix|pixels?)(?![a-z])|_(px|pix)")


@dataclass(frozen=True)
class Source:
    """How the data are read: ``path`` as the file says it, the column (or constant step) of times, that of radii.

    ``errors``: columns of the standard deviations of radii and times, where the file states them. ``step_unit``: that
    of a constant step which is a scalar of the file. ``rate``: of the frames, that the times are compared with.
    """

    path: str
    time: tuple[str, str] | None
    time_step: str | None
    radius: tuple[str, str]
    layout: Layout = ANY
    errors: tuple[str, ...] = ()
    step_unit: str | None = None
    rate: str | None = None
    observable: str = "radius"

    @property
    def layout_entries(self) -> list[str]:
        """What is said about the layout, line by line."""
        told = {part.name: getattr(self.layout, part.name) for part in fields(Layout) if part.name != "since"}
        lines = [f"  {name}: {quoted(it)}" for name, it in told.items() if it is not None and it != getattr(ANY, name)]
        since = self.layout.since
        return lines + [f"  since: {since.text}"] * (since != ANY.since)


# the table that 'en4dvar track' writes: its columns say their units
TRACKED = Source("", ("t_us", "us"), None, ("R_um", "um"), errors=("R_std_um", "t_std_us"))
TRACKED_COMMON = "R_common_um"  # the scalar that holds the std of what moves all radii alike
TRACKED_SHAPE = "R_shape_common"  # and that of the factor by which a lasting shape does


def quoted(text: str) -> str:
    """``text`` as a YAML scalar that is read as text, also inside braces."""
    plain = _PLAIN.fullmatch(text) and text.lower() not in _WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def braced(**texts: str | None) -> str:
    """Keys and texts, but for those that are None, as a YAML mapping on one line."""
    return f"{{{', '.join(f'{key}: {quoted(text)}' for key, text in texts.items() if text is not None)}}}"


def yaml_text(name: str, source: Source, proposal: Proposal, command: str) -> str:
    """The whole configuration with comments."""
    page = _environment().get_template("configuration.yaml.j2")
    return page.render(schema=SCHEMA_FILE, command=command, name=name, source=source, proposal=proposal, braced=braced)


@cache
def _environment() -> Environment:
    environment = Environment(loader=PackageLoader(__package__, "."), undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = environment.keep_trailing_newline = True
    environment.filters |= {"quoted": quoted, "in_shell": shlex.quote, "section": _section}
    return environment


def _section(entries: Sequence[Entry]) -> str:
    bare = [f"  {entry.key}: {entry.value}".rstrip() for entry in entries]
    width = max(len(line) for line in bare if len(line) < 72)
    return "\n".join(
        f"{line.ljust(width)} # {entry.comment}" if entry.comment else line
        for line, entry in zip(bare, entries, strict=True)
    )


@dataclass(frozen=True)
class Proposed:
    """``text``: the YAML file. ``proposal``: what went into it, what the data show and what to mind."""

    text: str
    proposal: Proposal


def propose_config(
    data: str | Path, *, radius: tuple[str, str], time: tuple[str, str] | None = None, time_step: str | None = None,
    layout: Layout = ANY, start: Start | None = None, law: str | None = None, folder: str | Path = ".",
    name: str | None = None, errors: tuple[str, ...] = (), command: str = "en4dvar_bubble.starter.propose_config",
    step_unit: str | None = None, rate: str | None = None, medium: str = "gel", groups: str | None = None,
) -> Proposed:  # fmt: skip
    """A commented configuration for radius histories that loads and whose data can be read.

    Parameters
    ----------
    data: a CSV or ``.mat`` file, a folder or a pattern, relative to the current folder.
    radius, time: name of the column and its unit, never guessed; ``time_step`` instead of ``time``: a quantity such
        as ``"3.7 us"``, or with ``step_unit`` the name of a scalar of the file.
    layout: decimal sign, sheet, column that says which data set a row belongs to, what is done with disorder.
    start, law: instead of what the data suggest.
    folder: where the file will be; the path of the data inside it is relative to this folder.
    name: of the run, whose results go to ``runs/<name>``; default: that of the data.
    rate: of the camera's frames, e.g. ``"270 kHz"``, that the times are compared with.
    medium: for density and speed of sound, as :func:`en4dvar_bubble.starter.elsewhere.known` takes it.
    groups: which gel or day each data set is of: a column of the data, or a table, as ``gels.csv`` or ``gels.csv:gel``;
        default: its folder.
    errors: columns of the standard deviations of radii and times, in the units of ``radius`` and ``time``.
    command: told in the head of the file.

    Raises
    ------
    DataError: no usable file, no bubble in any (of several, those that are of no use are named among the warnings), or
    data sets that suggest different starts. ConfigError: unknown law, or neither ``time`` nor ``time_step``. UnitError:
    a unit that is not of its kind.
    """
    if (time is None) == (time_step is None):
        raise ConfigError("give either the column of times and its unit, or a constant time step")
    known(medium)
    if layout.since.kind in ("minimum", "trough", "fall"):
        start = start or "laser"  # behind a collapse a bubble is released from its maximum
    source = Source(path_from(Path(folder), str(data)), time, time_step, radius, layout, errors, step_unit, rate)
    files = with_parts(
        find_files(Path.cwd(), [str(data)]), Column(*source.radius, "m"), layout, time[0] if time else None
    )
    readings, unusable = histories(files, replace(source, layout=replace(layout, outliers="leave out")))
    if len(unusable) > len(readings):
        names = " and ".join(repr(name) for name in (*(time or ())[:1], radius[0]))
        unusable.append(
            f"{len(unusable)} of {len(files)} files are left out: all files of a folder are read by the same names "
            f"and units, here {names}; write the others under these names, in the same units, and propose again"
        )
    common = _largest(readings, TRACKED_COMMON) if errors else 0.0
    delay, delays = _delays(readings, source)
    proposal = propose(
        {name: (series.times - delays.get(name, 0.0), series.values) for name, series in readings.items()},
        start,
        law,
        medium,
        grouped(files, data, groups, layout),
        scale_of(_largest(readings, TRACKED_SHAPE)),
        convert(common, source.radius[1], "m"),
    )
    odd = [words for name, series in readings.items() for words in _left_out(name, series)]
    if any(ODD.keys() & series.left_out.keys() for series in readings.values()):
        source = replace(source, layout=replace(layout, outliers="leave out"))
    proposal = _with_delay(_with_rest(proposal, readings, source.radius[1]), delay)
    if errors:
        proposal = with_columns(proposal, errors, f"{common:g} {source.radius[1]}" if common > 0 else "")
    told = (*proposal.warnings, *odd, *doubts(source), *scales(readings, source), *_steps(readings, source), *unusable)
    proposal = replace(proposal, warnings=told)
    name = name or run_name(str(data))
    config = resolve(parse_document(yaml_text(name, source, proposal, command)), Path(folder).absolute())
    _, unbuilt = usable(proposal.datasets, lambda dataset: build_one(config, dataset, files[dataset]))
    proposal = replace(proposal, warnings=(*proposal.warnings, *unbuilt))
    return Proposed(yaml_text(name, source, proposal, command), proposal)


def _largest(readings: Mapping[str, Readings], name: str) -> float:
    return max(series.scalars.get(name, 0.0) for series in readings.values())


def histories(files: Mapping[str, DataFile], source: Source) -> tuple[dict[str, Readings], list[str]]:
    """Readings in s and m of each data set, and why others cannot be used. Raises :class:`DataError`: none can be used.
    :class:`UnitError`: a unit that is not of its kind.
    """
    time, radius = _times(source), Column(*source.radius, "m", True)

    def read(name: str) -> Readings:
        return read_series(files[name].path, time, radius, source.layout, part=files[name].part)

    return usable(files, read, "{error}")


def _times(source: Source) -> Column | TimeStep:
    if source.step_unit is not None:
        return TimeStep(Column(source.time_step or "", source.step_unit, "s"))
    if source.time_step:
        return TimeStep(value=parse_quantity(source.time_step, "s", "us"))
    rate = None if source.rate is None else parse_quantity(source.rate, "Hz", "kHz")
    return Column(*(source.time or ("", "s")), "s", rate=rate)


def _left_out(name: str, series: Readings) -> list[str]:
    """That readings of a data set were left out, and which."""
    words = []
    if none := series.left_out.get(BELOW):
        which = "reading of 0 or below is a frame" if len(none) == 1 else "readings of 0 or below are frames"
        words.append(f"{name}: {len(none)} {which} without a bubble, left out")
    for reason, why in ((FAR, "too far from the neighbours"), *((it, it) for it in (AGAIN, CLIPPED, LEVEL))):
        if far := [f"{1e6 * time:.6g}" for time in series.left_out.get(reason, ())]:
            told = f"{', '.join(far[:6])}{' …' * (len(far) > 6)} us"
            which = f"reading at {told} is" if len(far) == 1 else f"{len(far)} readings at {told} are"
            words.append(f"{name}: the {which} {why}, and left out (data.outliers)")
    return words


def scales(readings: Mapping[str, Readings], source: Source) -> list[str]:
    """Data sets of three or more whose largest radius, or time between readings, is of another order than the median
    of all, and the units that would make them alike."""
    sizes = {name: np.array([it.values.max(), np.median(np.diff(it.times))]) for name, it in readings.items()}
    usual = np.median(list(sizes.values()), axis=0)
    of_time = source.time[1] if source.time else "s"
    kinds = (("largest radius", source.radius[1], LENGTHS), ("time between readings", of_time, TIMES))
    words = []
    for name, size in sizes.items() if len(sizes) > 2 else ():
        for (what, unit, others), ratio in zip(kinds, usual / size, strict=True):
            if abs(math.log10(ratio)) > math.log10(ODD_SCALE):
                times = f"{ratio:.0f} times smaller" if ratio > 1 else f"{1 / ratio:.0f} times larger"
                alike = [it for it in others if abs(math.log10(convert(1.0, it, unit) / ratio)) < 0.5]
                hint = f"; is it in {alike[0]}, not in {unit}?" if alike else ""
                words.append(f"{name}: the {what} is {times} than the median of all files{hint}")
    return words


def _steps(readings: Mapping[str, Readings], source: Source) -> list[str]:
    """Where the times of a data set contradict the file's step or the rate given, or are no frames of a film."""
    time = _times(source)
    if not isinstance(time, Column):
        return []
    told = []
    for name, series in readings.items():
        words = step_doubts(series.times, "s", time.unit, series.scalars, time.rate)
        told += [step.words if len(readings) == 1 else f"{name}: {step.words}" for step in words]
    return told


def _delays(readings: Mapping[str, Readings], source: Source) -> tuple[dict[str, str], dict[str, float]]:
    """The scalar that every file states of its trigger, with its unit, and its value (s) in each; none where a reading
    lies before it, or several bubbles' tops agree better without it.
    """
    scalars = [series.scalars.keys() for series in readings.values()]
    names = {name for of_file in scalars for name in of_file if _DELAY.fullmatch(without_unit(name, "s"))}
    if len(names) != 1 or source.time is None or not all(names <= of_file for of_file in scalars):
        return {}, {}
    (name,) = names
    unit = unit_in(name, "s") or source.time[1]
    delays = {key: convert(series.scalars[name], unit, "s") for key, series in readings.items()}
    tops = {key: float(series.times[np.argmax(series.values)]) for key, series in readings.items()}
    apart = np.ptp([tops[key] - delays[key] for key in tops]) > np.ptp(list(tops.values()))
    if apart or any(series.times[0] < delays[key] for key, series in readings.items()):
        return {}, {}
    return {"from_file": name, "unit": unit}, delays


def _with_delay(proposal: Proposal, delay: Mapping[str, str]) -> Proposal:
    """With the clock of each file that begins at its ``delay``, unless it begins at the file's own top."""
    words = "the delay that each file states; what is added to it puts the R_max of the guess on that of the data"
    lines = list(proposal.data)
    for i, line in enumerate(lines):
        if delay and line.key == "time_zero" and line.value != "top":
            plus = None if line.value == "file" else line.value
            lines[i] = replace(line, value=braced(**delay, plus=plus), comment=words)
    return replace(proposal, data=tuple(lines))


def _with_rest(proposal: Proposal, readings: Mapping[str, Readings], unit: str) -> Proposal:
    """The radius at rest of the files, where every one has such a scalar that suits its readings in their unit."""
    names = {name for series in readings.values() for name in series.scalars if _REST.fullmatch(without_unit(name))}
    names = {name for name in names if not indexed(name)[1]} or names  # of expts(1).Req, … one that means each its own
    if len(names) != 1:
        return proposal
    (name,) = names
    stated = unit_in(name, "m")
    unit = stated or unit.removeprefix("0.5*")  # of diameters; what is called a radius is none
    for series in readings.values():
        value = series.scalars.get(name, float("nan"))
        share = convert(value, unit, "m") / float(series.values.max())
        if not AT_REST[0] < share < AT_REST[1]:
            like = "" if stated else ", like its radii,"
            words = f"{name} {value:g} of the file is not used: in {unit}{like} it is no plausible R_eq"
            return replace(proposal, warnings=(*proposal.warnings, words))
    words = f"from the file, in the unit of its readings; without it G is uncertain; is it really in {unit}?"
    words = "from the file; without it G is uncertain" if stated else words
    entry = Entry("R_eq", braced(from_file=name, unit=unit), words)
    lines = tuple(entry if line.key == "R_eq" else line for line in proposal.parameters)
    return replace(proposal, parameters=lines)


def doubts(source: Source) -> list[str]:
    """Where the name of a column says something else than its unit, or than what it is used for."""
    words = []
    for what, kind, column in (("times", "s", source.time), ("radii", "m", source.radius)):
        if column is None:
            words += [EACH_ROW] * (source.step_unit is None)  # else the file states it, as one that keeps all frames
            continue
        name, unit = column
        diameter, pixels, scaled = bool(DIAMETER.match(name)), PIXELS.search(name), "*" in unit
        if pixels and not scaled:
            size = f"{'half ' * diameter}the size of one"
            words.append(f"{name!r} seems to hold pixels; if so, give --pixel with {size} instead of a unit")
        if what == "times" and FRAMES.fullmatch(name) and not scaled:
            words.append(f"{name!r} seems to count frames; if so, give --frame-rate instead of a unit")
        if what == "radii" and diameter and scaled and not unit.startswith("0.5*"):
            words.append(f"{name!r} seems to hold diameters; if so, {unit} must be half the size of a pixel: is it?")
        if what == "radii" and diameter and not scaled and not pixels:
            words.append(f"{name!r} seems to hold diameters; if so, give half their unit, --radius-unit '0.5*{unit}'")
        if what == "radii" and AREA.match(name):
            words.append(f"{name!r} seems to hold areas; {OF_AREA}")
        named = None if diameter and scaled else unit_in(name, kind)
        if named and parse_unit(named) != parse_unit(unit):
            words.append(f"the name of column {name!r} says {named}, but its unit is given as {unit}")
    return words


def unit_in(name: str | None, kind: str) -> str | None:
    """The unit of such a kind that a column's name ends in, as ``t_us``, ``R [um]``; None where it names none."""
    ending = parted((name or "").rpartition(".")[2])[1]
    try:
        return ending if ending and convert(1.0, ending, kind) else None
    except UnitError:
        return None


def without_unit(name: str, kind: str = "m") -> str:
    """A column's name without what :func:`unit_in` reads."""
    last = name.rpartition(".")[2]
    return parted(last)[0] if unit_in(name, kind) else last


def run_name(data: str) -> str:
    """Name of a run from the path of its data (or of its file): letters, digits, dots and dashes."""
    path = expanded(data).absolute()
    stem = path.parent.name if any(sign in path.name for sign in "*?[") else path.name if path.is_dir() else path.stem
    return re.sub(r"[^\w.+-]", "_", stem).lstrip(".-+") or "bubble"
