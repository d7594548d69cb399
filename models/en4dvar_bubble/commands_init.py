"""``en4dvar init``: a first configuration for radius histories. Heavy imports stay inside the command."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import click

from en4dvar.commands.common import Failed, command_line, echo, from_here, refuse_to_replace
from en4dvar.inputs.formats import Disorder, Format, Repeated
from en4dvar.plumbing.errors import En4dvarError, OutputError, retold
from en4dvar_bubble.commands import completed_law

if TYPE_CHECKING:
    from en4dvar.inputs.parts import Layout
    from en4dvar_bubble.starter.asked import Asked
    from en4dvar_bubble.starter.proposal import Proposal
    from en4dvar_bubble.starter.summaries import Summaries

_OF_MOVIE = ("pixel", "frame_rate", "exposure", "flashes", "raw", "corrections", "bubble", "region", "mask")
_OF_LAYOUT = ("by", "sheet", "unsorted", "repeated", "format", "since")
_OF_COLUMNS = ("time_unit", "radius_unit", "time_column", "radius_column", "time_step", "frame_rate", "pixel")
_KEY = re.compile(rf"data\.({'|'.join(_OF_LAYOUT)})\b(?:: (\w+|'[^']+'))?")
_MOVIES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg", ".gif", ".mp4", ".avi", ".mov", ".mkv", ".cine")


@click.command()
@click.argument("unnamed", nargs=-1, metavar="")
@click.option(
    "--data",
    metavar="PATH",
    type=click.Path(),
    help="CSV, Excel, .mat file, folder or pattern; without it, an empty starter.",
)
@click.option("--movie", type=click.Path(path_type=Path), help="Movie to read first, as 'en4dvar track' does.")
@click.option("--pixel", metavar="LENGTH", help="Size of a pixel, e.g. '2.76 um': of the movie, or of radii in pixels.")
@click.option("--frame-rate", metavar="RATE", help="Frame rate, e.g. '270 kHz': of the movie, or of times in frames.")
@click.option("--exposure", metavar="TIME", help="Exposure of a frame of the movie, e.g. '500 ns'.")
@click.option("--flashes", metavar="TIMES", help="Flashes of one exposure of the movie, as '0 us, 2 us, 4 us'.")
@click.option("--raw", metavar="WxHxBITS", help="Shape of the frames of a movie without header, e.g. 512x128x8.")
@click.option("--corrections", metavar="FILE", type=click.Path(), help="Frames of the movie corrected by hand.")
@click.option("--bubble", metavar="X,Y", help="A point inside the bubble to follow in the movie (pixels).")
@click.option("--region", metavar="X,Y,WIDTH,HEIGHT", help="Part of the movie's frames to look at (pixels).")
@click.option("--mask", metavar="FILE", type=click.Path(), help="Picture; its black parts are ignored in the movie.")
@click.option("--example", type=click.Choice(["quickstart"]), help="An example and its synthetic data instead.")
@click.option("--time-unit", metavar="UNIT", help="Unit of the times in the file, e.g. us, or frame.")
@click.option("--radius-unit", metavar="UNIT", help="Unit of the radii in the file, e.g. um.")
@click.option("--time-column", metavar="NAME", help="Column of times, if its name does not tell.")
@click.option("--radius-column", metavar="NAME", help="Column of radii, if its name does not tell.")
@click.option("--time-step", metavar="TIME", help="Constant time step instead of a column, e.g. '3.7 us'.")
@click.option("--by", metavar="NAME", help="Column that says which bubble a row belongs to.")
@click.option(
    "--groups",
    metavar="NAME",
    help="Gel, day or concentration of each bubble: a column of the data, or a table of files (gels.csv, or "
    "gels.csv:COLUMN).",
)
@click.option("--format", type=click.Choice(get_args(Format)), help="Format of the data, if their name does not tell.")
@click.option("--sheet", metavar="SHEET", help="Sheet of a workbook or a range of it, e.g. 'Film 3!A3:D40'.")
@click.option("--unsorted", type=click.Choice(get_args(Disorder)), help="What to do if times do not increase.")
@click.option("--repeated", type=click.Choice(get_args(Repeated)), help="What to do with several readings of a time.")
@click.option(
    "--since",
    metavar="INSTANT",
    help="Leave out readings before, e.g., 'trough 1' (the first collapse) or '60 us'.",
)
@click.option("--start", type=click.Choice(["acoustic", "laser"]), help="Start; default: what the data suggest.")
@click.option("--law", metavar="LAW", shell_complete=completed_law, help="Constitutive law, see 'en4dvar laws'.")
@click.option(
    "--medium",
    default="gel",
    show_default=True,
    help="water, polyacrylamide, agarose, gelatin, peg, … or with a concentration, 'agarose 1 %': density and speed of "
    "sound, and how well they are known.",
)
@click.option("--out", type=click.Path(path_type=Path), help="YAML file to write; default <name of the data>.yaml.")
@click.option("--force", is_flag=True, help="Replace that file.")
def init(
    unnamed: tuple[str, ...], data: str | None, movie: Path | None, example: str | None,
    start: Literal["acoustic", "laser"] | None, law: str | None, medium: str, out: Path | None, force: bool,
    **options: str | None,
) -> None:  # fmt: skip
    """Propose a commented configuration from bubble radius data.

    Units are never guessed: give them, or answer the questions on a terminal.

    \b
    Example:
      en4dvar init --data bubble.csv --time-unit us --radius-unit um
      en4dvar init --data tracked.csv --pixel '2.76 um' --frame-rate '270 kHz'
      en4dvar init --movie bubble.mp4 --pixel '2.76 um' --frame-rate '270 kHz'
    """
    if unnamed:  # a file alone, or what a shell makes of a pattern
        several = len(unnamed) > 1 or data is not None
        wanted = "'FOLDER/*.csv' (a folder, or a pattern in quotes)" if several else shlex.quote(unnamed[0])
        raise click.UsageError(f"{unnamed[0]}: data are named by --data {wanted}")
    if movie is not None and (data is not None or example is not None):
        raise click.UsageError("--movie makes the data; not together with --data or --example")
    of_movie = {name: text for name in _OF_MOVIE if (text := options[name]) is not None}
    if movie is None:
        _refuse_alone(of_movie, () if data is None else ("pixel", "frame_rate"), "a --movie")
        _refuse_alone(options, _OF_MOVIE if data is None else options, "--data")
    if example is not None:
        if any(it is not None for it in (data, out, start, law)):
            raise click.UsageError("--example comes with its own data, start, law and file names")
        _write_example(example, force)
        return
    from en4dvar.config.json_schema import schema_text
    from en4dvar.plumbing.files import write_text
    from en4dvar_bubble.starter.config import SCHEMA_FILE, Source, propose_config, run_name, yaml_text
    from en4dvar_bubble.starter.proposal import starter
    from en4dvar_bubble.starter.summaries import propose_from_times, source_of

    name = run_name(str(out or data or movie or "bubble"))  # a file that is called my_gel is run as my_gel
    words = command_line()
    target = out or Path(f"{name}.yaml")
    refuse_to_replace(force, target, read=[data, movie])
    if not target.absolute().parent.is_dir():
        raise OutputError(f"{target}: the folder {target.parent} does not exist")
    if movie is not None:
        data, options = str(_tracked(movie, target, of_movie, force)), {**options, "pixel": None, "frame_rate": None}
    if data is None:
        proposal = starter(start or "acoustic", law)
        text = yaml_text(name, Source("bubble.csv", ("t_us", "us"), None, ("R_um", "um")), proposal, words)
    else:
        with _in_words_of_options():
            layout = _layout(options)
            columns = _columns_of(data, options, layout)
            if isinstance(columns, dict):
                proposed = propose_config(
                    data,
                    **columns,
                    start=start,
                    law=law,
                    medium=medium,
                    folder=target.parent,
                    name=name,
                    command=words,
                    groups=options["groups"],
                )
                text, proposal = proposed.text, proposed.proposal
            else:
                proposal = propose_from_times(columns, law, medium)
                text = yaml_text(name, source_of(_table_beside(target, data, columns.table, force)), proposal, words)
    write_text(target, text)
    write_text(target.parent / SCHEMA_FILE, schema_text())
    _tell(target, proposal, example_only=data is None)


def _refuse_alone(options: Mapping[str, str | None], allowed: Collection[str], wanted: str) -> None:
    """Raise :class:`click.UsageError` for an option that is given and not allowed without what is wanted."""
    for name, text in options.items():
        if text is not None and name not in allowed:
            raise click.UsageError(f"--{name.replace('_', '-')} needs {wanted}")


def _layout(options: Mapping[str, str | None]) -> Layout:
    """How the data are laid out. Raises :class:`UnitError`: ``--since`` is no instant."""
    from en4dvar.inputs.parts import Layout
    from en4dvar.inputs.window import parse_instant
    from en4dvar.plumbing.units import UnitError

    told: dict[str, Any] = {key: it for key in _OF_LAYOUT if (it := options[key]) is not None}
    if "since" in told:
        with retold(UnitError, UnitError, "--since: "):
            told["since"] = parse_instant(told["since"], "s")
    return Layout(**told)


@contextmanager
def _in_words_of_options() -> Iterator[None]:
    """Within, an error names options of this command where it names keys of a configuration, and what to type next."""
    try:
        yield
    except En4dvarError as error:
        words, advice = _with_options(str(error)), re.search(rf"\({_KEY.pattern}", str(error))
        if advice is not None:
            value = (advice[2] or "").strip("'") or ("NAME" if advice[1] == "by" else advice[1].upper())
            words += f"\nnext: {command_line(also=(f'--{advice[1]}', value))}"
        raise Failed(words, error.exit_code) from None


def _with_options(words: str) -> str:
    """``words`` with the option of this command for each key of a configuration."""
    return _KEY.sub(lambda key: f"--{key[1]}{' ' * bool(key[2])}{key[2] or ''}", words)


def _tracked(movie: Path, target: Path, options: Mapping[str, str], force: bool) -> Path:
    """The table of a movie beside the configuration ``target``, by the command ``track`` of whoever provides it."""
    context = click.get_current_context()
    root = context.find_root()
    command = root.command.get_command(root, "track") if isinstance(root.command, click.Group) else None
    if command is None:
        raise click.UsageError("the command 'track', which reads movies, is not installed")
    table = target.with_suffix(".csv")
    scales = [word for name, text in options.items() for word in (f"--{name.replace('_', '-')}", text)]
    words = ["--out", str(table), *scales, *["--force"] * force, "--", str(movie)]
    try:
        with command.make_context("track", words, parent=context) as inner:
            inner.command.invoke(inner)
    except click.UsageError as error:
        raise click.UsageError(error.format_message(), context) from None
    return table


def _table_beside(target: Path, data: str, text: str, force: bool) -> str:
    """Write the table of the bubbles beside the configuration ``target``; its name. Raises :class:`OutputError`."""
    from en4dvar.plumbing.files import write_text

    table = target.with_name(f"{target.stem}_bubbles.csv")
    refuse_to_replace(force, table)
    write_text(table, text)
    echo(f"table: {table}, a row a bubble of {data}")
    return table.name


def _write_example(name: str, force: bool) -> None:
    from en4dvar.config.json_schema import schema_text
    from en4dvar.plumbing.files import write_text
    from en4dvar_bubble.examples import write_example
    from en4dvar_bubble.starter.config import SCHEMA_FILE

    file = write_example(name, Path(), force)
    write_text(Path(SCHEMA_FILE), schema_text())  # that the first line of the configuration names
    echo(f"configuration: {file}, its data are synthetic")
    echo(f"next: en4dvar validate {file}, then en4dvar run {file}")


def _columns_of(data: str, options: Mapping[str, str | None], layout: Layout) -> dict[str, Any] | Summaries:
    """Columns and units for ``propose_config``, or a row a bubble. Raises :class:`ConfigError` with all it lacks."""
    from en4dvar.assembly.reading import find_files
    from en4dvar_bubble.starter.asked import Asked, first_with_columns
    from en4dvar_bubble.starter.summaries import summaries

    _refuse_movie(Path(data))

    def left_out(table: Path) -> None:
        echo(f"{from_here(table)}: the truths of a simulated campaign are no data set, and left out", err=True)

    files = list(find_files(Path.cwd(), [data], left_out).values())
    first, contents, layout = first_with_columns(files, layout)
    asked = Asked(contents, **{key: options[key] for key in _OF_COLUMNS})
    commas = ", decimal commas" if layout.decimal == "," else ""
    one_of = f"; one of {len(files)} files" if len(files) > 1 else ""
    echo(f"{first}{commas}: {'; '.join(map(asked.shown, contents.columns))}{one_of}", err=True)
    if contents.scalars:
        told = ", ".join(f"{name} {value:g}" for name, value in contents.scalars.items())
        echo(f"others in the file: {told}", err=True)
    if contents.unsure:
        name, number = next(iter(contents.unsure.items()))
        words = f"whether {number} in column {name!r} is {number.replace(',', '.')}, as it is read, or "
        words += f"{number.replace(',', '')}; if commas separate thousands, delete them from the file"
        echo(f"warning: {first}: no number tells {words}", err=True)
    asked = asked.by_names()
    if not asked.complete_columns and (rows := summaries(contents.columns)) is not None:
        if options["since"] is not None:
            raise click.UsageError(f"{first} has a row a bubble, no readings that --since could leave out")
        return rows
    if _interactive():
        asked = _answered(asked)
    if needed := asked.needed():
        again = command_line(also=tuple(word for option, value, _ in needed for word in (option, value)))
        raise asked.incomplete(first, f"next: {again}")
    for words in asked.unused:
        echo(f"warning: {words}", err=True)
    return {**asked.columns(), "layout": layout}


def _refuse_movie(path: Path) -> None:
    """Raise :class:`click.UsageError` for a movie, or a folder of its frames, which is read in another way."""
    named = [path] if not path.is_dir() else [p for p in path.iterdir() if not p.name.startswith(".")]
    if named and all(p.suffix.lower() in _MOVIES for p in named):
        again = shlex.join(["en4dvar", "init", "--movie", str(path), "--pixel", "LENGTH", "--frame-rate", "RATE"])
        raise click.UsageError(f"{path} is a movie, which --movie reads\nnext: {again}")


def _interactive() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()


def _answered(asked: Asked) -> Asked:
    """With the columns and units that the options and names do not tell, as the user answers."""
    columns = click.Choice(list(asked.contents.columns))
    while needed := asked.needed():
        match needed[0][0]:
            case "--time-column":
                asked = replace(asked, time_column=click.prompt("Column of times", type=columns, err=True)).of_camera()
            case "--radius-column":
                asked = replace(asked, radius_column=click.prompt("Column of radii", type=columns, err=True))
            case "--time-unit" | "--frame-rate":
                unit = _ask_unit(asked.shown(str(asked.time_column or asked.step)), "s", "us, ms, s or 1/(270*kHz)")
                asked = replace(asked, time_unit=unit)
            case _:
                unit = _ask_unit(asked.shown(str(asked.radius_column)), "m", "um, mm, m, or 2.76*um for pixels")
                asked = replace(asked, radius_unit=unit)
    return asked


def _ask_unit(column: str, dimension: str, examples: str) -> str:
    from en4dvar.plumbing.units import UnitError, convert

    def known(unit: str) -> str:
        with retold(UnitError, click.UsageError):  # which is told, and the question asked again
            convert(1.0, unit, dimension)
        return unit

    return str(click.prompt(f"Unit of {column}, e.g. {examples}", err=True, value_proc=known))


def _tell(target: Path, proposal: Proposal, example_only: bool) -> None:
    for line in proposal.remarks:
        echo(line)
    for warning in proposal.warnings:
        echo(f"warning: {_with_options(warning)}", err=True)
    file = shlex.quote(str(target))
    echo(f"configuration: {target}")
    if example_only:
        echo("every value in it is an example; with --data FILE it is proposed from your data")
    echo(f"next: en4dvar validate {file} --plot, then en4dvar run {file}")
