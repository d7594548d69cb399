"""``en4dvar population``: how much a parameter varies between the data sets of finished runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click


@click.command()
@click.argument("run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR [RUN_DIR...]")
@click.option(
    "--of", "names", multiple=True, required=True, metavar="NAME",
    help="A parameter that varies from data set to data set about a common mean, e.g. G; any number of times.",
)  # fmt: skip
@click.option(
    "--mean-std", type=click.FloatRange(min=0, min_open=True), default=1.0, show_default=True,
    help="Hyperprior of the mean: normal about the prior's, with so many of its standard deviations.",
)  # fmt: skip
@click.option(
    "--spread", type=click.FloatRange(min=0, min_open=True), default=0.5, show_default=True,
    help="Hyperprior of the spread: half-normal, with so many of the prior's standard deviations.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the result; default: that of the first run.")
@click.option("--workers", type=click.IntRange(min=1), help="Parallel workers; the numbers do not depend on it.")
@click.option("--trust", is_flag=True, help="Run code that the files name, wherever it lies: read it before.")
def population(
    run_dirs: tuple[Path, ...], names: tuple[str, ...], mean_std: float, spread: float, out: Path | None,
    workers: int | None, trust: bool,
) -> None:  # fmt: skip
    """Estimate the mean of parameters over data sets and how much they vary: the gel behind its bubbles.

    Takes finished runs of the same parameters, with at least three data sets together. Unlike stacked posteriors it
    counts the prior once. Writes population.nc, .csv, .tex and a page.

    \b
    Example:
      en4dvar population runs/twelve_bubbles --of G --of mu
    """
    from en4dvar.population import HyperPrior
    from en4dvar.report.population import population_lines
    from en4dvar.runs.population_run import population as estimate

    def ask(question: str) -> bool:
        return sys.stdin.isatty() and click.confirm(question)

    found, page = estimate(
        run_dirs, names, out or run_dirs[0], hyper=HyperPrior(mean_std, spread), workers=workers, trust=trust, ask=ask,
        tell=lambda words: click.echo(words, err=True),
    )  # fmt: skip
    click.echo("\n".join(population_lines(found)))
    for caution in found.cautions:
        click.echo(f"{caution.kind}: {caution}", err=True)
    click.echo(f"report: {page if out else os.path.relpath(page)}")
