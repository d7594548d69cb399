"""``en4dvar joint``: data sets of finished runs estimated together."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from en4dvar.commands.common import folder_of


@click.command()
@click.argument("run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR [RUN_DIR...]")
@click.option(
    "--share", "names", multiple=True, metavar="NAME",
    help="A parameter that has one value in all data sets, e.g. G; default: what their configurations share.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the result; default joint_... beside.")
@click.option("--workers", type=click.IntRange(min=1), help="Parallel workers; the numbers do not depend on it.")
@click.option("--trust", is_flag=True, help="Run code that the files name, wherever it lies: read it before.")
def joint(
    run_dirs: tuple[Path, ...], names: tuple[str, ...], out: Path | None, workers: int | None, trust: bool
) -> None:
    """Estimate data sets together that share parameters: the bubbles of one gel, the experiments of one pulse.

    Takes finished runs, any of which may be a campaign; their models, windows and errors may differ (laser and
    acoustic bubbles of one gel). What is not shared stays each data set's own. Writes joint.nc, joint.csv and a page.

    \b
    Example:
      en4dvar joint runs/twelve_bubbles --share G --share mu
    """
    from en4dvar.report.joint import joint_table
    from en4dvar.runs.joint_run import join

    def ask(question: str) -> bool:
        return sys.stdin.isatty() and click.confirm(question)

    found, page = join(
        run_dirs, names, out or folder_of("joint", run_dirs), workers=workers, trust=trust, ask=ask,
        tell=lambda words: click.echo(words, err=True),
    )  # fmt: skip
    click.echo(joint_table(found))
    for caution in found.cautions:
        click.echo(f"{caution.kind}: {caution}", err=True)
    click.echo(f"report: {page if out else os.path.relpath(page)}")
