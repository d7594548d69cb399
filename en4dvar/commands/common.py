"""Parts that several commands share: the CONFIG argument with its options, and how an error of ours is told."""

from __future__ import annotations

import functools
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from en4dvar.config import Config

LONGEST = 120  # name of a folder


class Failed(click.ClickException):
    """An error told on standard error, without a traceback, with an exit code of ours."""

    def __init__(self, message: str, exit_code: int):
        super().__init__(message)
        vars(self)["exit_code"] = exit_code  # which click declares for the class

    def show(self, file: IO[Any] | None = None) -> None:
        try:
            click.echo(printable(self.message), file=file, err=file is None)
        except OSError:  # the terminal is gone, or the disk of the log is full: the exit code says it all the same
            give_up_output()


def give_up_output() -> None:
    """Discard everything that is still to be written to standard output and error."""
    with suppress(OSError, ValueError):  # a stream without a file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def printable(text: str) -> str:
    """Lines without what a terminal would obey: names and values come from files of anybody."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


def echo(text: str, err: bool = False) -> None:
    """Print :func:`printable` lines."""
    click.echo(printable(text), err=err)


def from_here(path: Path) -> str:
    """A path as seen from the working directory; from another drive it stays as it is."""
    try:
        return os.path.relpath(path)
    except ValueError:
        return str(path)


def parted(items: Iterable[str], option: str) -> dict[str, str]:
    """Dotted keys → values of ``items`` KEY=VALUE, given with an ``option``."""
    settings = {}
    for item in items:
        key, equals, value = item.partition("=")
        if not equals:
            raise click.BadParameter(f"{item!r} is not KEY=VALUE", param_hint=option)
        settings[key.strip()] = value
    return settings


@dataclass(frozen=True)
class Source:
    """The configuration that a command was given: its file, and what --data and --set change in it."""

    path: Path
    data: str | None
    settings: tuple[str, ...]

    def load(self) -> Config:
        """The configuration of an estimation. Raises :class:`ConfigError`."""
        from en4dvar.config import load_config

        return load_config(self.path, self.overrides())

    def overrides(self, **special: Any) -> dict[str, Any]:
        """Dotted keys → values of --set and --data; ``special`` are further keys, left out where None."""
        overrides: dict[str, Any] = {**parted(self.settings, "--set")}
        # A path on the command line is relative to the shell's folder, one in the file to the file's.
        special["data.path"] = [str(Path(self.data).absolute())] if self.data else None
        return overrides | {key: value for key, value in special.items() if value is not None}


def folder_of(kind: str, run_dirs: Sequence[Path]) -> Path:
    """Where what a command makes of several runs goes unless told: a folder beside the first, named after them all.

    Raises :class:`OutputError` where it would be a link to elsewhere.
    """
    from en4dvar.plumbing.files import inside

    names = [run_dir.resolve().name for run_dir in run_dirs]
    names = names if len(set(names)) == len(names) else [str(run_dir) for run_dir in run_dirs]
    named = "_".join(re.sub(r"[^\w.+-]", "_", name) for name in names)
    return inside(run_dirs[0].absolute().parent, f"{kind}_{named}"[:LONGEST])


def require_words(words: Sequence[str]) -> None:
    """Raise :class:`click.UsageError` for an empty word, which would be as if it had not been given, or a folder."""
    for before, word in zip(("", *words), words, strict=False):
        if re.fullmatch(r"(--[\w-]+=)?", word):
            why = "nothing is given; is a variable of the shell not set, or did a command in it fail?"
            raise click.UsageError(f"{word or before}: {why}" if word or before else why)


class Number(click.FloatRange):
    """A finite number in a range: what is not a number compares as if it were within."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


def config_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The argument CONFIG with --data and --set, which the command gets as one :class:`Source`."""

    @click.argument("config", type=click.Path(path_type=Path))
    @click.argument("more", nargs=-1, metavar="")
    @click.option(
        "--data", metavar="FILE", type=click.Path(), help="Data file, folder or pattern instead of data.path."
    )
    @click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="KEY=VALUE",
        help="Set a value, e.g. assimilation.members=96; any number of times.",
    )
    @functools.wraps(command)
    def with_source(
        config: Path, more: tuple[str, ...], data: str | None, settings: tuple[str, ...], **options: Any
    ) -> Any:
        if more:  # what a shell makes of a pattern
            raise click.UsageError(
                f"{more[0]}: there is one configuration; many data files are named by --data 'FOLDER/*.csv' (a folder, "
                "or a pattern in quotes), and a value with spaces stands in quotes"
            )
        return command(Source(config, data, settings), **options)

    return with_source


workers_option = click.option(
    "--workers", type=click.IntRange(min=1), help="Parallel workers; results do not depend on their number."
)
trust_option = click.option(
    "--trust", is_flag=True, help="Run code that the files name, wherever it is; read it first."
)


def ask(question: str) -> bool:
    """True if the user says yes; nobody does where there is no terminal."""
    return sys.stdin.isatty() and click.confirm(question, err=True)


tell = functools.partial(echo, err=True)  # which step is being done


def refuse_to_replace(force: bool, *outs: Path | None, read: Sequence[str | Path | None] = ()) -> None:
    """Raise :class:`OutputError` where one of ``outs`` exists and is not to be replaced, is the same as another, or is
    what is ``read``: readings, a movie or a result, which nobody can make again, are lost otherwise. A text stands for
    data files, as ``data.path`` does.
    """
    from en4dvar.plumbing.errors import DataError, OutputError

    sources, places = {os.path.realpath(path) for path in read if isinstance(path, Path)}, set()
    there = any(out.exists() for out in outs if out)
    for text in dict.fromkeys(text for text in read if there and isinstance(text, str)):
        from en4dvar.assembly.reading import find_files

        with suppress(DataError):
            sources.update(map(os.path.realpath, find_files(Path(), [text]).values()))
    for out in filter(None, outs):
        if there and os.path.realpath(out) in sources:
            raise OutputError(f"{out}: is what the command reads, and is not replaced; give another name")
        if out.exists() and not force:
            raise OutputError(f"{out}: exists; give --force to replace it, or another name")
        if (place := os.path.realpath(out)) in places:
            raise OutputError(f"{out}: is to hold two things; give one of them another name")
        places.add(place)


def deliver(text: str, out: Path | None, what: str, force: bool = True, read: Sequence[Path] = ()) -> None:
    """Write to the file ``out``, which is none that was ``read``, and say ``what`` is there, or print. Raises
    :class:`OutputError`.
    """
    from en4dvar.plumbing.files import write_text

    refuse_to_replace(force, out, read=read)
    if out is None:
        click.echo(text, nl=False)
    elif what:
        echo(f"{what}: {write_text(out, text)}")
    else:
        write_text(out, text)


def command_line(without: tuple[str, ...] = (), also: tuple[str, ...] = ()) -> str:
    """The command as typed, with the program's name as it is installed; some words left out, others added."""
    return shlex.join(["en4dvar", *(word for word in sys.argv[1:] if word not in without), *also])


def to_continue(kept: object) -> Failed:
    """The last words of a command that was stopped: what is kept of its run, if one has begun, and what to type."""
    again = command_line(without=("--force", "--resume"), also=("--resume",))
    return Failed(f"{kept}\nto continue: {again}" if kept else "interrupted", 130)


@contextmanager
def continuable() -> Iterator[str]:
    """Within, an interrupt says what is kept of the run and what to type next; gives the command as typed."""
    from en4dvar.runs.interrupt import begun

    try:
        yield command_line()
    except KeyboardInterrupt as interrupt:
        if kept := begun(interrupt):
            raise to_continue(kept) from None
        raise Failed(f"interrupted before the run began\nto run it: {command_line()}", 130) from None
