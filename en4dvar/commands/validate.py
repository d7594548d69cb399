"""``en4dvar validate``."""

from __future__ import annotations

import click

from en4dvar.commands.common import config_options, load_any


@click.command()
@config_options
def validate(config: str, data: str | None, settings: tuple[str, ...]) -> None:
    """Check a configuration and its data without running; tell what would be estimated.

    \b
    Example:
      en4dvar validate configs/quickstart.yaml
    """
    loaded = load_any(config, data, settings)
    from en4dvar.config import TwinConfig

    if isinstance(loaded, TwinConfig):
        from en4dvar.twin_run import twin_summary

        click.echo(twin_summary(loaded))
        return
    from en4dvar.build import build
    from en4dvar.describe import problem_summary

    click.echo(problem_summary(loaded, build(loaded)))
