"""Commands that tell what there is: ``en4dvar models`` and ``en4dvar schema``."""

from pathlib import Path

import click

from en4dvar.commands.common import deliver, echo


@click.command()
def models() -> None:
    """List the models with their observables, parameters, units and settings.

    \b
    Example:
      en4dvar models | less
    """
    from en4dvar.commands.listing import model_listing

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
