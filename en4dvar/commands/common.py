"""What several commands share: the CONFIG argument with its options, and how an error of ours is told."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from en4dvar.config import Config, TwinConfig

F = Callable[..., Any]


class Failed(click.ClickException):
    """An error told on standard error, without a traceback, with an exit code of ours."""

    def __init__(self, message: str, exit_code: int):
        super().__init__(message)
        self.exit_code = exit_code  # type: ignore[misc]

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(self.message, file=file, err=file is None)


def config_options(command: F) -> F:
    """The argument CONFIG with --data and --set."""
    for decorate in (
        click.option(
            "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a value, e.g. assimilation.members=96."
        ),
        click.option("--data", metavar="FILE", help="Data file, folder or pattern instead of data.path."),
        click.argument("config", type=click.Path()),
    ):
        command = decorate(command)
    return command


def load(config: str, data: str | None, settings: tuple[str, ...]) -> Config:
    """The configuration of an estimation. Raises :class:`ConfigError`."""
    from en4dvar.config import load_config

    return load_config(config, overrides(data, settings))


def load_any(config: str, data: str | None, settings: tuple[str, ...], **special: Any) -> Config | TwinConfig:
    """As :func:`load`, or a twin experiment. Raises :class:`ConfigError`."""
    from en4dvar.config import load_any as load

    return load(config, overrides(data, settings, **special))


def overrides(data: str | None, settings: tuple[str, ...], **special: Any) -> dict[str, Any]:
    """``--set`` and ``--data`` as dotted keys → values; ``special`` are further keys, left out where None."""
    found: dict[str, Any] = {}
    for item in settings:
        key, equals, value = item.partition("=")
        if not equals:
            raise click.BadParameter(f"{item!r} is not KEY=VALUE", param_hint="--set")
        found[key.strip()] = value
    # A path on the command line is relative to the shell's folder, one in the file to the file's.
    special["data.path"] = [str(Path(data).absolute())] if data else None
    return found | {key: value for key, value in special.items() if value is not None}


def command_words() -> list[str]:
    """What the user typed, word by word, with the program's name as it is installed."""
    return ["en4dvar", *sys.argv[1:]]


def command_line() -> str:
    """What the user typed, for the history of a file."""
    return shlex.join(command_words())
