"""Subcommands that application packages add: entry points of group ``en4dvar.commands``, name → click command.

``en4dvar --help`` must stay quick and must not fail because of a package, so help reads the command's docstring from
its source; only invoking a command imports it.
"""

import ast
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from en4dvar.plumbing.errors import En4dvarError, retold

GROUP = "en4dvar.commands"


class PluginCommand(click.Command):
    """Stands for a command until it is invoked."""

    def __init__(self, entry: EntryPoint):
        super().__init__(entry.name, short_help=about(entry))
        self.entry = entry

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Import the command and let it take over. Raises :class:`En4dvarError` where that fails."""
        command = loaded(self.entry, f"command {self.name!r}")
        if not isinstance(command, click.Command):
            raise En4dvarError(f"command {self.name!r}: {self.entry.value} is not a click command")
        return command.make_context(info_name, args, parent, **extra)


def loaded(entry: EntryPoint, what: str) -> Any:
    """What an entry point leads to. Raises :class:`En4dvarError`, which says of ``what``, where it cannot be loaded."""
    with retold((ImportError, AttributeError), En4dvarError, f"{what} ({entry.value}) cannot be loaded: "):
        return entry.load()


def about(entry: EntryPoint) -> str:
    """First sentence of the function's docstring, read without importing; its package where that cannot be found."""
    return _first_sentence(entry) or f"From {entry.module.partition('.')[0]}."


def _first_sentence(entry: EntryPoint) -> str:
    top, *rest = entry.module.split(".")
    spec = find_spec(top)
    if spec is None or spec.origin is None:
        return ""
    base = Path(spec.origin).parent.joinpath(*rest)
    files = (base.with_suffix(".py"), base / "__init__.py") if rest else (Path(spec.origin),)
    try:
        source = next(file for file in files if file.is_file()).read_text(encoding="utf-8")
        functions = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))
        help_text = next(ast.get_docstring(f) or "" for f in functions if f.name == entry.attr)
    except (OSError, ValueError, SyntaxError, StopIteration):
        return ""
    return " ".join(help_text.partition("\n\n")[0].split())
