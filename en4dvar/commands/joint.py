"""``en4dvar joint``: data sets of finished runs estimated together."""

from pathlib import Path
from typing import Any

import click

from en4dvar.commands.common import Told, several_runs


@click.command()
@click.option(
    "--share", "names", multiple=True, metavar="NAME",
    help="A parameter that has one value in all data sets, e.g. G; default: what their configurations share.",
)  # fmt: skip
@several_runs("joint")
def joint(runs: tuple[Path, ...], out: Path, how: dict[str, Any], names: tuple[str, ...]) -> Told:
    """Estimate data sets together that share parameters: samples of one material, records of one instrument.

    Takes finished runs, any of which may be a campaign; their models, windows and errors may differ.
    Each data set has its own values of what is not shared. Writes joint.nc, joint.csv and a page.

    \b
    Example:
      en4dvar joint runs/twelve_bubbles --share G --share mu
    """
    from en4dvar.report.joint import joint_table
    from en4dvar.runs.together import join

    result, page = join(runs, names, out, **how)
    return joint_table(result), result.cautions, page
