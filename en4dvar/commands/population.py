"""``en4dvar population``: how much a parameter varies between the data sets of finished runs."""

from pathlib import Path
from typing import Any

import click

from en4dvar.commands.common import Told, several_runs


@click.command()
@click.option(
    "--of", "names", multiple=True, required=True, metavar="NAME",
    help="A parameter that varies from data set to data set about a common mean, e.g. G; any number of times.",
)  # fmt: skip
@click.option(
    "--mean-std", type=click.FloatRange(min=0, min_open=True), show_default="as in the run's population:, or 1",
    help="Hyperprior of the mean: normal about that of the prior; its std as a multiple of the prior's.",
)  # fmt: skip
@click.option(
    "--spread", type=click.FloatRange(min=0, min_open=True), show_default="as in the run's population:, or 0.5",
    help="Hyperprior of the spread: half-normal; its std as a multiple of the prior's.",
)  # fmt: skip
@click.option(
    "--odd", type=click.FloatRange(min=0, max=1, max_open=True), show_default="as in the run's population:, or 0.05",
    help="Probability that a data set is odd: of another population, in all parameters or in one.",
)  # fmt: skip
@several_runs("population")
def population(
    runs: tuple[Path, ...], out: Path, how: dict[str, Any], names: tuple[str, ...], **hyper: float | None
) -> Told:
    """Estimate the mean of parameters over data sets and how much they vary: a material behind its samples.

    Takes finished runs of the same parameters, with at least three data sets together, whatever their errors. Unlike
    stacked posteriors it counts the prior once. Constants of the medium and of the camera that are estimated have one
    value in all data sets. Writes population.nc, .csv, .tex and a page.

    \b
    Example:
      en4dvar population runs/twelve_bubbles --of G --of mu
    """
    from en4dvar.report.population import population_lines
    from en4dvar.runs.together import population as estimate

    changed = {name: value for name, value in hyper.items() if value is not None}
    result, page = estimate(runs, names, out, hyper=changed, **how)
    return "\n".join(population_lines(result)), result.cautions, page
