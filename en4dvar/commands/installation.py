"""Commands about what is installed: ``en4dvar models``, ``en4dvar schema`` and ``en4dvar warm-up``."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import click

from en4dvar.commands.common import deliver, echo
from en4dvar.commands.plugins import loaded
from en4dvar.plumbing.installed import installed

WARM_UP = "en4dvar.warm_up"
"""Entry points whose value is a function without arguments: what is compiled, in words → a small call that does."""


@click.command()
def models() -> None:
    """List the models with their observables, parameters, units and settings.

    \b
    Example:
      en4dvar models | less
    """
    from en4dvar.config.models import model_listing

    echo(model_listing())


@click.command()
@click.option("--out", type=click.Path(path_type=Path), help="JSON file to write; default standard output.")
def schema(out: Path | None) -> None:
    """Print the JSON schema of configuration files: completion and checks in an editor.

    Name it in the first line of a configuration:  # yaml-language-server: $schema=en4dvar.schema.json

    \b
    Example:
      en4dvar schema --out en4dvar.schema.json
    """
    from en4dvar.config.json_schema import schema_text

    deliver(schema_text(), out, "schema")


@click.command("warm-up")
def warm_up() -> None:
    """Compile now what is otherwise compiled at first use: for images, clusters and first runs.

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
    for name, entry in installed(WARM_UP).items():
        yield from loaded(entry, f"warm-up of {name!r}")().items()
