"""Commands that read run directories: ``en4dvar report`` and ``en4dvar compare``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
def report(run_dir: Path) -> None:
    """Write the report and figures of a finished run again, from its netCDF files.

    \b
    Example:
      en4dvar report runs/quickstart
    """
    from en4dvar.runner import report as write_report

    click.echo(f"report: {write_report(run_dir)}")


@click.command()
@click.argument("run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR RUN_DIR...")
def compare(run_dirs: tuple[Path, ...]) -> None:
    """Compare models on the same data: evidence, model probabilities, fit, information.

    \b
    Example:
      en4dvar compare runs/neo_hookean runs/quadratic
    """
    from en4dvar.compare import compare, comparison_table

    click.echo(comparison_table(compare(run_dirs)))
