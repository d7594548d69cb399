"""Commands that tell what there is: ``en4dvar models``."""

from __future__ import annotations

import click


@click.command()
def models() -> None:
    """List the models with their observables, parameters, units and settings.

    \b
    Example:
      en4dvar models | less
    """
    from en4dvar.listing import model_listing

    click.echo(model_listing())
