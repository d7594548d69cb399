"""Forms of a simulation that application packages add: entry points of group ``en4dvar.simulate``, name → function.

``movie`` makes ``en4dvar simulate --movie FILE --movie-set KEY=VALUE …`` of ``movie(config, times, out, settings,
seed)``, which writes FILE and returns what is said of it. Nothing is imported before such an option is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from en4dvar.commands.common import parted
from en4dvar.commands.plugin_commands import about, loaded
from en4dvar.plumbing.installed import installed

if TYPE_CHECKING:
    from en4dvar.config import Config
    from en4dvar.model.state import Array

GROUP = "en4dvar.simulate"


class WithForms(click.Command):
    """A command with two options for each form: its file, and its settings."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        own = super().get_params(ctx)
        options = {option for parameter in own for option in parameter.opts}
        added = [o for entry in installed(GROUP).values() for o in _options(entry) if not options.intersection(o.opts)]
        return [*own[:-1], *added, own[-1]]  # --help stays the last


def _options(entry: EntryPoint) -> list[click.Option]:
    name = entry.name
    return [
        click.Option([f"--{name}"], metavar="FILE", type=click.Path(path_type=Path), help=about(entry)),
        click.Option([f"--{name}-set"], metavar="KEY=VALUE", multiple=True, help=f"Set a value of the {name}."),
    ]


def asked(options: Mapping[str, Any]) -> dict[str, tuple[Path, dict[str, str]]]:
    """Form → file and settings. Raises :class:`click.UsageError`: settings without a file, or not KEY=VALUE."""
    answers = {}
    for name in installed(GROUP):
        out, texts = options.get(name), options.get(f"{name}_set", ())
        if texts and out is None:
            raise click.UsageError(f"--{name}-set needs --{name} FILE")
        if out is not None:
            answers[name] = out, {key: value.strip() for key, value in parted(texts, f"--{name}-set").items()}
    return answers


def write_form(
    name: str, config: Config, times: Array | None, out: Path, settings: Mapping[str, str], seed: int
) -> str:
    """Write a form and return the sentence about its file. Raises :class:`En4dvarError`: the form cannot be loaded, or
    refuses.
    """
    return str(loaded(installed(GROUP)[name], f"--{name}")(config, times, out, settings, seed))
