"""Commands about what is installed: ``en4dvar models``, ``schema`` and ``warm-up``; and what application packages add
to the command line by entry points: subcommands, and forms of a simulation.

Group ``en4dvar.commands``, name → click command. ``en4dvar --help`` must stay quick and must not fail because of a
package, so help reads the command's docstring from its source; only invoking a command imports it.

Group ``en4dvar.simulate``, name → function: ``movie`` makes ``en4dvar simulate --movie FILE --movie-set KEY=VALUE …``
of ``movie(config, times, out, settings, seed)``, which writes FILE and returns what is said of it. Nothing is imported
before such an option is used.
"""

import ast
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from en4dvar.commands.common import deliver, echo, parted
from en4dvar.plumbing.errors import En4dvarError, retold
from en4dvar.plumbing.installed import installed

COMMANDS = "en4dvar.commands"
FORMS = "en4dvar.simulate"
WARM_UP = "en4dvar.warm_up"
"""Entry points whose value is a function without arguments: what is compiled, in words → a small call that does."""


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


@cache
def about(entry: EntryPoint) -> str:
    """First sentence of the function's docstring, read without importing; its package where that cannot be found."""
    top, *rest = entry.module.split(".")
    spec, unknown = find_spec(top), f"From {top}."
    if spec is None or spec.origin is None:
        return unknown
    base = Path(spec.origin).parent.joinpath(*rest)
    files = (base.with_suffix(".py"), base / "__init__.py") if rest else (Path(spec.origin),)
    try:
        source = next(file for file in files if file.is_file()).read_text(encoding="utf-8")
        functions = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))
        help_text = next(ast.get_docstring(f) or "" for f in functions if f.name == entry.attr)
    except (OSError, ValueError, SyntaxError, StopIteration):
        return unknown
    return " ".join(help_text.partition("\n\n")[0].split()) or unknown


class WithForms(click.Command):
    """A command with two options for each form: its file, and its settings."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        own = super().get_params(ctx)
        options = {option for parameter in own for option in parameter.opts}
        added = [o for entry in installed(FORMS).values() for o in _options(entry) if not options.intersection(o.opts)]
        return [*own[:-1], *added, own[-1]]  # --help stays the last


def _options(entry: EntryPoint) -> list[click.Option]:
    name = entry.name
    return [
        click.Option([f"--{name}"], metavar="FILE", type=click.Path(path_type=Path), help=about(entry)),
        click.Option([f"--{name}-set"], metavar="KEY=VALUE", multiple=True, help=f"Set a value of the {name}."),
    ]


def asked(options: Mapping[str, Any]) -> dict[str, tuple[EntryPoint, Path, dict[str, str]]]:
    """Form → its writer, file, settings. Raises :class:`click.UsageError`: settings without file, or not KEY=VALUE."""
    answers = {}
    for name, entry in installed(FORMS).items():
        out, texts = options.get(name), options.get(f"{name}_set", ())
        if texts and out is None:
            raise click.UsageError(f"--{name}-set needs --{name} FILE")
        if out is not None:
            answers[name] = entry, out, {key: value.strip() for key, value in parted(texts, f"--{name}-set").items()}
    return answers


@click.command()
def models() -> None:
    """List models with observables, parameters, units and settings.

    \b
    Example:
      en4dvar models | less
    """
    from en4dvar.config.models import model_listing

    echo(model_listing())


@click.command()
@click.option("--out", type=click.Path(path_type=Path), help="JSON file to write; default standard output.")
def schema(out: Path | None) -> None:
    """Print the JSON schema of configuration files.

    An editor completes and checks what you type if the first line of a configuration names it:
    # yaml-language-server: $schema=en4dvar.schema.json

    \b
    Example:
      en4dvar schema --out en4dvar.schema.json
    """
    from en4dvar.config.json_schema import schema_text

    deliver(schema_text(), out, "schema")


@click.command("warm-up")
def warm_up() -> None:
    """Compile now what is otherwise compiled at first use.

    Each kind of equations, and each method with compiled loops, is used once on a tiny problem.

    \b
    Example:
      en4dvar warm-up  # in an image, or before a batch of jobs
    """
    from en4dvar.plumbing.compiled import KERNELS, compilations

    for what, call in examples():
        before, start = compilations(), time.perf_counter()
        call()
        took = f"compiled in {time.perf_counter() - start:.1f} s" if compilations() > before else "there already"
        echo(f"{what}: {took}")
    echo(f"compiled code is kept below {os.path.commonpath([kernel.stats.cache_path for kernel in KERNELS])}")


def examples() -> Iterator[tuple[str, Callable[[], object]]]:
    """Names of kernels, each with a call that compiles it. Raises :class:`En4dvarError`: a package is at fault."""
    declared = [rival for entry in installed(WARM_UP).values() for rival in getattr(entry, "rivals", (entry,))]
    for entry in declared:
        name = entry.name
        calls = loaded(entry, f"warm-up of {name!r}")()
        if not isinstance(calls, Mapping):
            raise En4dvarError(f"warm-up of {name!r}: {entry.value} must return a dict of calls, not {calls!r}")
        yield from calls.items()
