"""``en4dvar init``: a first configuration for radius histories. Heavy imports stay inside the command."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from en4dvar_bubble.commands import completed_law

if TYPE_CHECKING:
    from en4dvar.inputs.asked import Layout
    from en4dvar.inputs.contents import Contents
    from en4dvar_bubble.starter.proposal import Proposal

_TIME = re.compile(r"(?i)t|time|t[ _(\[].*|time[ _(\[].*")
_STEP = re.compile(r"(?i)delta_?t|dt|t_?step|time_?step")
_PIXEL = re.compile(r"(?i)delta_?x|dx|pixel_?size|(um|m)_?per_?(px|pixel)|px_?2_?(um|m)")
_RADIUS = re.compile(r"(?i)r|radius|radii|rnew|roft|r[ _(\[].*|radius[ _(\[].*")


@click.command()
@click.argument("unnamed", nargs=-1, metavar="")
@click.option(
    "--data",
    metavar="PATH",
    type=click.Path(),
    help="CSV, Excel, .mat file, folder or pattern; without it, an empty starter.",
)
@click.option("--movie", type=click.Path(path_type=Path), help="Movie to read first, as 'en4dvar track' does.")
@click.option("--pixel", metavar="LENGTH", help="Size of a pixel of the movie, e.g. '2.76 um'.")
@click.option("--frame-rate", metavar="RATE", help="Frame rate of the movie, or of the data's, e.g. '270 kHz'.")
@click.option("--exposure", metavar="TIME", help="Exposure of a frame of the movie, e.g. '500 ns'.")
@click.option("--flashes", metavar="TIMES", help="Flashes of one exposure of the movie, as '0 us, 2 us, 4 us'.")
@click.option("--raw", metavar="WxHxBITS", help="Shape of the frames of a movie without header, e.g. 512x128x8.")
@click.option("--corrections", metavar="FILE", type=click.Path(), help="Frames of the movie corrected by hand.")
@click.option("--example", type=click.Choice(["quickstart"]), help="An example and its synthetic data instead.")
@click.option("--time-unit", metavar="UNIT", help="Unit of the times in the file, e.g. us.")
@click.option("--radius-unit", metavar="UNIT", help="Unit of the radii in the file, e.g. um.")
@click.option("--time-column", metavar="NAME", help="Column of times, if its name does not tell.")
@click.option("--radius-column", metavar="NAME", help="Column of radii, if its name does not tell.")
@click.option("--time-step", metavar="TIME", help="Constant time step instead of a column, e.g. '3.7 us'.")
@click.option("--by", metavar="NAME", help="Column that says which bubble a row belongs to.")
@click.option("--sheet", metavar="SHEET", help="Sheet of a workbook or a range of it, e.g. 'Film 3!A3:D40'.")
@click.option("--unsorted", type=click.Choice(["refuse", "sort"]), help="What to do if times do not increase.")
@click.option(
    "--repeated", type=click.Choice(["refuse", "average"]), help="What to do with several readings of a time."
)
@click.option("--start", type=click.Choice(["acoustic", "laser"]), help="Start; default: what the data suggest.")
@click.option("--law", metavar="LAW", shell_complete=completed_law, help="Constitutive law, see 'en4dvar laws'.")
@click.option("--out", type=click.Path(path_type=Path), help="YAML file to write; default <name of the data>.yaml.")
@click.option("--force", is_flag=True, help="Replace that file.")
def init(
    unnamed: tuple[str, ...],
    data: str | None,
    movie: Path | None,
    frame_rate: str | None,
    example: str | None,
    time_unit: str | None,
    radius_unit: str | None,
    time_column: str | None,
    radius_column: str | None,
    time_step: str | None,
    by: str | None,
    sheet: str | None,
    unsorted: str | None,
    repeated: str | None,
    start: Literal["acoustic", "laser"] | None,
    law: str | None,
    out: Path | None,
    force: bool,
    **of_movie: str | None,
) -> None:
    """Write a commented starter configuration for bubble radius data, proposed from what they show.

    Units are never guessed: give them, or answer the questions on a terminal.

    \b
    Example:
      en4dvar init --data bubble.csv --time-unit us --radius-unit um
      en4dvar init --movie bubble.mp4 --pixel '2.76 um' --frame-rate '270 kHz'
    """
    if unnamed:  # a file alone, or what a shell makes of a pattern
        several = len(unnamed) > 1 or data is not None
        wanted = "'FOLDER/*.csv' (a folder, or a pattern in quotes)" if several else shlex.quote(unnamed[0])
        raise click.UsageError(f"{unnamed[0]}: data are named by --data {wanted}")
    if movie is not None and (data is not None or example is not None):
        raise click.UsageError("--movie makes the data; not together with --data or --example")
    if movie is None and (given := [f"--{name}" for name, text in of_movie.items() if text is not None]):
        raise click.UsageError(f"{given[0]} needs a --movie")
    if example is not None:
        if data is not None or out is not None:
            raise click.UsageError("--example comes with its own data and file names")
        _write_example(example, force)
        return
    from en4dvar.config.json_schema import schema_text
    from en4dvar.errors import OutputError
    from en4dvar.files import write_text
    from en4dvar.inputs.asked import Layout
    from en4dvar_bubble.starter.config import propose_config, run_name
    from en4dvar_bubble.starter.page import SCHEMA_FILE, Source, yaml_text
    from en4dvar_bubble.starter.proposal import starter

    name = run_name(str(out or data or movie or "bubble"))  # a file that is called my_gel is run as my_gel
    words = shlex.join(["en4dvar", *sys.argv[1:]])
    target = out or Path(f"{name}.yaml")
    if target.exists() and not force:
        raise OutputError(f"{target}: exists; give --force to replace it, or another --out")
    if not target.absolute().parent.is_dir():
        raise OutputError(f"{target}: the folder {target.parent} does not exist")
    if movie is not None:
        data = str(_tracked(movie, target, {**of_movie, "frame-rate": frame_rate}, force))
    if data is None:
        proposal = starter(start or "acoustic", law)
        text = yaml_text(name, Source("bubble.csv", ("t_us", "us"), None, ("R_um", "um")), proposal, words)
    else:
        stated = {"by": by, "sheet": sheet, "unsorted": unsorted, "repeated": repeated}
        layout = Layout(**{name: it for name, it in stated.items() if it is not None})  # type: ignore[arg-type]
        asked = _Asked(
            time_unit, radius_unit, time_column, radius_column, time_step, frame_rate if movie is None else None
        )
        columns = _columns_of(data, asked, layout)
        proposed = propose_config(data, **columns, start=start, law=law, folder=target.parent, name=name, command=words)
        text, proposal = proposed.text, proposed.proposal
    write_text(target, text)
    write_text(target.parent / SCHEMA_FILE, schema_text())
    _tell(target, proposal, example_only=data is None)


def _tracked(movie: Path, target: Path, options: Mapping[str, str | None], force: bool) -> Path:
    """The table of a movie beside the configuration ``target``, by the command ``track`` of whoever provides it."""
    context = click.get_current_context()
    root = context.find_root()
    command = root.command.get_command(root, "track") if isinstance(root.command, click.Group) else None
    if command is None:
        raise click.UsageError("the command 'track', which reads movies, is not installed")
    table = target.with_suffix(".csv")
    given = [word for name, text in options.items() if text is not None for word in (f"--{name}", text)]
    words = ["--out", str(table), *given, *["--force"] * force, "--", str(movie)]
    with command.make_context("track", words, parent=context) as inner:
        inner.command.invoke(inner)
    return table


def _write_example(name: str, force: bool) -> None:
    from en4dvar.config.json_schema import schema_text
    from en4dvar.files import write_text
    from en4dvar_bubble.examples import write_example
    from en4dvar_bubble.starter.page import SCHEMA_FILE

    file = write_example(name, Path(), force)
    write_text(Path(SCHEMA_FILE), schema_text())  # that the first line of the configuration names
    click.echo(f"configuration: {file}, its data are synthetic")
    click.echo(f"next: en4dvar validate {file}, then en4dvar run {file}")


@dataclass(frozen=True)
class _Asked:
    """What the options say about the columns."""

    time_unit: str | None
    radius_unit: str | None
    time_column: str | None
    radius_column: str | None
    time_step: str | None
    rate: str | None


def _columns_of(data: str, asked: _Asked, layout: Layout) -> dict[str, Any]:
    """Columns and units for ``propose_config``: by option, by a telling name, or asked for.

    Raises one :class:`ConfigError` that names every option to add.
    """
    from en4dvar.config.find_files import find_files
    from en4dvar.errors import ConfigError
    from en4dvar.units import convert
    from en4dvar_bubble.starter.page import TRACKED, TRACKED_COLUMNS
    from en4dvar_bubble.starter.summaries import summary_rows

    files = list(find_files(Path.cwd(), [data]).values())
    first, contents, layout = _first_with_columns(files, layout)
    shown = {name: f"{len(v)} values, {_range(v)}" for name, v in contents.columns.items()}
    commas = ", decimal commas" if layout.decimal == "," else ""
    one_of = f"; one of {len(files)} files" if len(files) > 1 else ""
    columns = "; ".join(f"{name} ({words})" for name, words in shown.items())
    click.echo(f"{first}{commas}: {columns}{one_of}", err=True)
    if contents.scalars:
        told = ", ".join(f"{name} {value:g}" for name, value in contents.scalars.items())
        click.echo(f"others in the file: {told}", err=True)
    if {*TRACKED_COLUMNS} <= shown.keys() and asked == _Asked(*[None] * 6):
        return {"radius": TRACKED.radius, "time": TRACKED.time, "layout": layout, "errors": TRACKED.errors}
    time, radius, missing = _columns(asked, shown)
    time_unit, radius_unit = asked.time_unit, asked.radius_unit
    step = None if time or asked.time_step else _only(_STEP, contents.scalars)
    if step is not None:
        missing = [option for option in missing if "time" not in option]
    if _interactive():
        missing = []
        radius = radius or _ask_column("radii", shown)
        if step is not None:
            time_unit = time_unit or _ask_unit(step, {step: f"{contents.scalars[step]:g}"}, "s", "us, ms or s")
        elif asked.time_step is None:
            time = time or _ask_column("times", shown)
            time_unit = time_unit or _ask_unit(time, shown, "s", "us, ms or s")
        radius_unit = radius_unit or _ask_unit(radius, shown, "m", "um, mm or m")
    needed = [*missing]
    needed += ["--time-unit UNIT (e.g. us)"] * (time_unit is None and asked.time_step is None)
    needed += [f"--radius-unit UNIT (e.g. um{_pixel(contents.scalars)})"] * (radius_unit is None)
    if missing and (rows := summary_rows(contents.columns)):
        raise ConfigError(f"{first}: {rows}")
    if needed:
        message = f"{first}: columns with numbers: {', '.join(shown) or 'none'}; units are never guessed: add "
        raise ConfigError("\n".join([*(contents.others.values() if missing else ()), message + ", ".join(needed)]))
    convert(1.0, str(radius_unit), "m")
    if asked.time_step is not None:
        return {"radius": (radius, radius_unit), "time_step": asked.time_step, "layout": layout}
    convert(1.0, str(time_unit), "s")
    if step is not None:
        return {"radius": (radius, radius_unit), "time_step": step, "step_unit": time_unit, "layout": layout}
    return {"radius": (radius, radius_unit), "time": (time, time_unit), "rate": asked.rate, "layout": layout}


def _pixel(scalars: Mapping[str, float]) -> str:
    """What the unit of radii in pixels may be, by a scalar of the file whose name says so."""
    name = _only(_PIXEL, scalars)
    return "" if name is None else f"; where radii are pixels and {name} is the size of one in m, '{scalars[name]:g}*m'"


def _first_with_columns(files: Sequence[Path], layout: Layout) -> tuple[Path, Contents, Layout]:
    """The first file that holds columns of numbers, and with its decimal sign. Raises :class:`DataError`: none does."""
    from en4dvar.errors import DataError
    from en4dvar.inputs.contents import read_contents

    points, commas = (replace(layout, decimal=sign) for sign in (".", ","))

    faults: list[str] = []
    for file in files:
        try:
            contents, with_commas = (read_contents(file, one) for one in (points, commas))
        except DataError as error:
            faults.append(str(error))
            continue
        if len(with_commas.columns) > len(contents.columns):
            return file, with_commas, commas
        if contents.columns:
            return file, contents, points
        faults.append(next(iter(contents.others.values()), f"{file}: no column holds numbers"))
    raise DataError("\n".join(faults))


def _columns(asked: _Asked, shown: Mapping[str, str]) -> tuple[str | None, str | None, list[str]]:
    """Columns of times and radii by option, else by name where one name alone fits; options that are missing."""
    time, radius = asked.time_column, asked.radius_column
    if time is None and asked.time_step is None:
        time = _only(_TIME, shown)
    radius = radius or _only(_RADIUS, shown)
    if len(shown) == 2 and asked.time_step is None:  # of two columns, one tells what the other is
        first, second = shown
        other = {first: second, second: first}
        time, radius = time or other.get(radius or ""), radius or other.get(time or "")
    missing = ["--time-column NAME"] * (time is None and asked.time_step is None)
    missing += ["--radius-column NAME"] * (radius is None)
    return time, radius, missing


def _only(pattern: re.Pattern[str], names: Iterable[str]) -> str | None:
    fitting = [name for name in names if pattern.fullmatch(name.rpartition(".")[2])]
    return fitting[0] if len(fitting) == 1 else None


def _interactive() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()


def _ask_column(what: str, shown: Mapping[str, str]) -> str:
    return str(click.prompt(f"Column of {what}", type=click.Choice(list(shown)), err=True))


def _ask_unit(column: str | None, shown: Mapping[str, str], dimension: str, examples: str) -> str:
    from en4dvar.units import UnitError, convert

    while True:
        unit = str(click.prompt(f"Unit of {column} ({shown.get(str(column), '')}), e.g. {examples}", err=True))
        try:
            convert(1.0, unit, dimension)
        except UnitError as error:
            click.echo(str(error), err=True)
        else:
            return unit


def _range(values: Any) -> str:
    import numpy as np

    finite = values[np.isfinite(values)]
    return f"{finite.min():g} to {finite.max():g}" if len(finite) else "none of them finite"


def _tell(target: Path, proposal: Proposal, example_only: bool) -> None:
    for line in proposal.remarks:
        click.echo(line)
    for warning in proposal.warnings:
        click.echo(f"warning: {warning}", err=True)
    file = shlex.quote(str(target))
    click.echo(f"configuration: {target}")
    if example_only:
        click.echo("every value in it is an example; with --data FILE it is proposed from your data")
    click.echo(f"next: en4dvar validate {file} --plot, then en4dvar run {file}")
