"""``en4dvar track``. Heavy imports stay inside the command."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from en4dvar.commands.common import echo

PIXELS = (1e-9, 1e-3)  # m

if TYPE_CHECKING:
    from en4dvar_movie.frames import Movie
    from en4dvar_movie.table import Scale


@click.command()
@click.argument("movie", type=click.Path(path_type=Path))
@click.option("--pixel", metavar="LENGTH", help="Size of a pixel, e.g. '2.76 um'; needed if the file does not tell.")
@click.option("--frame-rate", metavar="RATE", help="Frame rate, e.g. '270 kHz'; needed if the file does not tell.")
@click.option("--exposure", metavar="TIME", help="Exposure of a frame or length of a flash, e.g. '500 ns'.")
@click.option("--flashes", metavar="TIMES", help="Flashes of one exposure, as '0 us, 2 us, 4 us': nested circles.")
@click.option("--raw", metavar="WxHxBITS", help="Shape of the frames of a file without header, e.g. 512x128x8.")
@click.option(
    "--corrections",
    type=click.Path(path_type=Path),
    help="Text file: FRAME out, FRAME ok, or FRAME X Y RADIUS (pixels).",
)
@click.option("--bubble", metavar="X,Y", help="A point inside the bubble to follow, in any frame (pixels).")
@click.option("--region", metavar="X,Y,WIDTH,HEIGHT", help="Part of the frames to look at (pixels).")
@click.option("--mask", type=click.Path(path_type=Path), help="Picture of a frame's size; black parts are ignored.")
@click.option("--all", "every", is_flag=True, help="Also write the tables of other bubbles, one file each.")
@click.option("--out", type=click.Path(path_type=Path), help="CSV file to write; default <name of the movie>.csv.")
@click.option("--page", type=click.Path(path_type=Path), help="HTML page to write; default beside the CSV file.")
@click.option("--outlined", type=click.Path(path_type=Path), help="Also write the movie with outlines drawn in.")
@click.option("--force", is_flag=True, help="Replace these files.")
@click.option("--workers", type=click.IntRange(min=1), help="Threads; results do not depend on their number.")
def track(
    movie: Path, pixel: str | None, frame_rate: str | None, exposure: str | None,
    flashes: str | None, raw: str | None, corrections: Path | None, out: Path | None, page: Path | None,
    outlined: Path | None, force: bool, workers: int | None, **choice: Any,
) -> None:  # fmt: skip
    """Read a bubble's radius and its error from each movie frame.

    MOVIE is a TIFF stack, a folder of pictures, an mp4, avi, mov, mkv, gif or cine file, or a raw file with --raw.
    'en4dvar init' and 'en4dvar run' read the table as it is; a page shows every outline and what was left out.

    \b
    Example:
      en4dvar track bubble.mp4 --pixel '2.76 um' --frame-rate '270 kHz' --out bubble.csv
      en4dvar init --data bubble.csv
    """
    from en4dvar.commands.common import command_line, refuse_to_replace
    from en4dvar.executor import available_cores
    from en4dvar.plumbing.errors import OutputError
    from en4dvar.plumbing.files import write_text
    from en4dvar.runs.progress import counted
    from en4dvar_movie.choice import numbers, read_corrections, watched
    from en4dvar_movie.following import MOST
    from en4dvar_movie.frames import IMAGES, TIFF, open_movie, require_suffix, write_movie
    from en4dvar_movie.page import outlined as outlined_frames
    from en4dvar_movie.page import page_text
    from en4dvar_movie.table import other_movie, to_csv
    from en4dvar_movie.tracking import doubted
    from en4dvar_movie.tracking import track as track_movie

    opened, scale = _scaled(open_movie(movie, raw), pixel, frame_rate, exposure, flashes)
    table = out or Path(f"{movie.stem}.csv")
    shown = page or table.with_suffix(".html")
    if outlined:
        require_suffix(outlined)
    more = [table.with_name(f"{table.stem}_{n}{table.suffix}") for n in range(2, MOST + 1)] if choice["every"] else []
    frames = (p for p in movie.glob("*") if p.suffix.lower() in (*TIFF, *IMAGES))  # of a folder
    refuse_to_replace(force, table, shown, outlined, *more, read=[movie, *frames, corrections, choice["mask"]])
    if out is None and (another := other_movie(table, movie)):
        raise OutputError(f"{table}: was read from {another} and is not replaced; give --out another name")
    fixed = read_corrections(corrections) if corrections else {}
    point = None if choice["bubble"] is None else numbers(choice["bubble"], "--bubble", "X,Y")
    part = watched(opened, choice["region"], choice["mask"])
    with counted("frames") as tell:
        progress = (lambda done: tell(done, opened.count)) if tell else (lambda done: None)
        cores = workers or available_cores()
        track = track_movie(opened, cores, fixed, progress, scale.flashes, point, part, scale.exposure)
    for note in (*opened.notes, *track.notes):
        echo(f"note: {note}", err=True)
    words = command_line()
    write_text(table, to_csv(track.readings, scale, str(movie), words))
    for other, readings in zip(more, track.others, strict=False):
        write_text(other, to_csv(readings, scale, str(movie), words))
    write_text(shown, page_text(opened, track, scale, words))
    if outlined:
        pictures = outlined_frames(opened, track)
        write_movie(outlined, pictures, len({r.frame for r in track.readings}), scale.pixel, scale.rate)
    used = [r for r in track.readings if r.used]
    what = "frames" if len(scale.flashes) == 1 else "circles"
    others = "; the others and why: see the page" if len(used) < len(track.readings) else ""
    echo(f"{len(used)} of {len(track.readings)} {what} read{others}")
    if doubtful := doubted(track.readings):
        echo(f"doubtful, and not used until a line of --corrections confirms them: {doubtful}")
    for other, readings in zip(more, track.others, strict=False):
        echo(f"another bubble: {other}, {sum(r.used for r in readings)} {what}")
    echo(f"readings: {table}\npage: {shown}")
    context = click.get_current_context()
    if context.parent in (None, context.find_root()):  # 'init --movie' goes on by itself
        echo(f"next: en4dvar init --data {shlex.quote(str(table))}")


def _scaled(
    movie: "Movie", pixel: str | None, frame_rate: str | None, exposure: str | None, flashes: str | None
) -> "tuple[Movie, Scale]":
    """The movie with its scale. Raises :class:`click.UsageError`, :class:`DataError` where the options cannot be."""
    from en4dvar.plumbing.units import parse_quantity
    from en4dvar_movie.flashes import parse_flashes
    from en4dvar_movie.frames import with_scale
    from en4dvar_movie.table import Scale

    def quantity(text: str | None, unit: str, usual: str, option: str) -> float | None:
        value = None if text is None else parse_quantity(text, unit, usual)
        if value is not None and not value > 0:
            raise click.UsageError(f"{option} must be positive")
        return value

    size, rate = quantity(pixel, "m", "um", "--pixel"), quantity(frame_rate, "Hz", "kHz", "--frame-rate")
    if size and not PIXELS[0] <= size <= PIXELS[1]:
        raise click.UsageError(f"--pixel {pixel}: pixels of 1 nm to 1 mm are read; is the unit right?")
    movie = with_scale(movie, size, rate)
    shutter = quantity(exposure, "s", "us", "--exposure")
    instants = parse_flashes(flashes) if flashes else (0.0,)
    between = f"the {1e6 / movie.rate:g} us between two frames"
    if shutter is not None and shutter * movie.rate > 1.001:
        raise click.UsageError(f"--exposure {exposure} is longer than {between}")
    if instants[-1] - instants[0] >= 1 / movie.rate:
        raise click.UsageError(f"--flashes {flashes}: more than {between}")
    return movie, Scale(movie.pixel, movie.rate, shutter or 0.0, instants)
