"""Commands that make one estimate of finished runs: ``en4dvar joint`` and ``en4dvar population``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from en4dvar.commands.common import ask, echo, folder_of, from_here, tell, trust_option, workers_option

if TYPE_CHECKING:
    from en4dvar.plumbing.caution import Caution

Told = tuple[str, "tuple[Caution, ...]", Path]  # of an estimate: table, warnings, page


def several_runs(command: Callable[..., Told]) -> Callable[..., None]:
    """The arguments RUN_DIR with --out, --force, --workers and --trust of an estimate of finished runs together.

    It gets the runs, the folder of its result, and keywords of what computes it. What it returns is printed, warnings
    on standard error.
    """
    kind = command.__name__

    @click.argument(
        "run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR [RUN_DIR...]"
    )
    @click.option(
        "--out", type=click.Path(path_type=Path), help=f"Folder of the result; default {kind}_... beside the first."
    )
    @click.option(
        "--force", is_flag=True, expose_value=False, help="As of 'run'; an earlier result is replaced without it too."
    )
    @workers_option
    @trust_option
    @functools.wraps(command)
    def with_runs(
        run_dirs: tuple[Path, ...], out: Path | None, workers: int | None, trust: bool, **options: Any
    ) -> None:
        how = {"workers": workers, "trust": trust, "ask": ask, "tell": tell}
        table, cautions, page = command(run_dirs, out or folder_of(kind, run_dirs), how, **options)
        echo(table)
        for caution in cautions:
            echo(f"{caution.kind}: {caution}", err=True)
        echo(f"report: {page if out else from_here(page)}")

    return with_runs


@click.command()
@click.option(
    "--share", "names", multiple=True, metavar="NAME",
    help="A parameter that has one value in all data sets, e.g. G; default: what their configurations share.",
)  # fmt: skip
@click.option(
    "--apart", multiple=True, metavar="NAME",
    help="A constant of medium or camera of which each data set has a value of its own, e.g. p_inf; any number.",
)  # fmt: skip
@several_runs
def joint(
    runs: tuple[Path, ...], out: Path, how: dict[str, Any], names: tuple[str, ...], apart: tuple[str, ...]
) -> Told:
    """Estimate data sets together that share parameters: samples of one material, records of one instrument.

    Takes finished runs, any of which may be a campaign, of different readings; models, windows and errors may differ.
    Constants of the medium and of the camera that are estimated have one value in all, but for those --apart; each
    data set has its own values of what is not shared. Writes joint.nc, joint.csv and a page.

    \b
    Example:
      en4dvar joint runs/twelve_bubbles --share G --share mu
    """
    from en4dvar.report.together import joint_table
    from en4dvar.runs.together import join

    result, page = join(runs, names, out, apart=apart, **how)
    return joint_table(result), result.cautions, page


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
@several_runs
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
    from en4dvar.report.together import population_lines
    from en4dvar.runs.together import population as estimate

    changed = {name: value for name, value in hyper.items() if value is not None}
    result, page = estimate(runs, names, out, hyper=changed, **how)
    return "\n".join(population_lines(result)), result.cautions, page
