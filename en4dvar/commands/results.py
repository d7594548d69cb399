"""Commands that read run directories: ``en4dvar report``, ``rerun``, ``compare`` and ``export``; and those that make
one estimate of finished runs: ``en4dvar joint`` and ``population``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from en4dvar.commands.common import (
    Failed,
    Number,
    ask,
    continuable,
    deliver,
    echo,
    folder_of,
    from_here,
    tell,
    trust_option,
    workers_option,
)  # fmt: skip
from en4dvar.plumbing.errors import OutputError

if TYPE_CHECKING:
    from en4dvar.plumbing.caution import Caution
    from en4dvar.report.populations import PopulationsCompared

Known = Mapping[str, Mapping[str, str]]  # run → parameter → a median known from elsewhere
Told = tuple[str, "tuple[Caution, ...]", Path]  # of an estimate: table, warnings, page
MOST_ROWS = 60  # of estimates on the terminal


def _numbers(text: str | None) -> tuple[float, ...]:
    """Numbers between commas. Raises :class:`click.BadParameter`."""
    try:
        return tuple(map(float, text.split(","))) if text else ()
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of numbers such as 5,7.5,10") from None


def _medians(texts: Sequence[str]) -> Known:
    """Run → parameter → value with a standard deviation, as typed. Raises :class:`click.BadParameter`."""
    medians: dict[str, dict[str, str]] = {}
    for text in texts:
        run, _, rest = text.rpartition(":")
        name, _, value = rest.partition("=")
        if not (run and name and value):
            raise click.BadParameter(f"{text!r} is no median such as 'gel_5:G=5.1 ± 0.2 kPa'")
        if medians.setdefault(run, {}).setdefault(name.strip(), value.strip()) != value.strip():
            raise click.BadParameter(f"{run}:{name.strip()} is given two values")
    return medians


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option("--dataset", "datasets", multiple=True, metavar="NAME", help="Also write a page for this data set.")
@click.option(
    "--figures", is_flag=True, help="Also keep the figures as PDF and PNG, of these data sets or of all pages."
)
def report(run_dir: Path, datasets: tuple[str, ...], figures: bool) -> None:
    """Write the report of a finished run again, from its files.

    In a campaign of many data sets only those with the gravest warnings have their own page; --dataset (any number
    of times) adds one.

    \b
    Example:
      en4dvar report runs/quickstart --figures
    """
    from en4dvar.executor import available_cores
    from en4dvar.runs.engine import write_report

    echo(f"report: {run_dir / write_report(run_dir, datasets, available_cores(), figures).name}")


@click.command()
@click.argument("run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR RUN_DIR...")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the results; default compare_... beside the first."
)
@click.option("--no-report", is_flag=True, help="Print the tables only.")
@click.option("--stored", is_flag=True, help="Use the evidences stored in the results; run nothing.")
@click.option(
    "--against", metavar="A,B,...", callback=lambda _, __, text: _numbers(text),
    help="A number for each run, in their order, e.g. concentrations; fits a line to the populations' medians.",
)  # fmt: skip
@click.option(
    "--apart", multiple=True, metavar="NAME",
    help="A common quantity of which each population has its own value, e.g. rho; any number of times.",
)  # fmt: skip
@click.option(
    "--known", multiple=True, metavar="RUN:NAME=VALUE", callback=lambda _, __, texts: _medians(texts),
    help="A median known from elsewhere, e.g. from a rheometer: 'gel_5:G=5.1 ± 0.2 kPa'. It calibrates what the "
    "populations have in common; any number of times.",
)  # fmt: skip
@workers_option
@trust_option
def compare(
    run_dirs: tuple[Path, ...], out: Path | None, no_report: bool, stored: bool, against: tuple[float, ...],
    apart: tuple[str, ...], known: Known, workers: int | None, trust: bool,
) -> None:  # fmt: skip
    """Compare runs: posteriors and, on the same data, evidence.

    Posteriors are drawn over each other. On the same data, evidences give the probabilities of the models.

    For runs of different data that end with populations (or folders of 'en4dvar population') only the medians are
    compared: by how much one is larger, and how surely. What all have in common cancels.

    Evidences are sampled with forward runs if the model is cheap. Code outside the current folder and installed
    packages runs only with --trust.

    The runs may be models on the same data or different materials. Writes compare.html, a figure (PNG, PDF) and CSV
    tables. For sequences, it prints a table of their evidences.

    \b
    Example:
      en4dvar compare runs/neo_hookean runs/quadratic
      en4dvar compare runs/gel_5 runs/gel_8 runs/gel_10 --against 5,8,10
    """
    from en4dvar.report.populations import write_populations
    from en4dvar.results.run_results import has_results
    from en4dvar.results.series_file import series_file

    if any(map(series_file, run_dirs)):
        from en4dvar.report.sequence import compare_sequences, sequences_table

        echo(sequences_table(compare_sequences(run_dirs)))
        return
    of = _populations(run_dirs, against, apart, known, not any(map(has_results, run_dirs)))
    write = partial(write_populations, of) if of else _compared(run_dirs, stored, workers, trust)
    if not no_report:
        page = write(out or folder_of("compare", run_dirs))
        echo(f"report: {page if out else from_here(page)}")


def _compared(run_dirs: tuple[Path, ...], stored: bool, workers: int | None, trust: bool) -> Callable[[Path], Path]:
    """What writes the page of the runs side by side, which are told on standard output."""
    from en4dvar.report import compare as side_by_side

    comparison = side_by_side.compare_runs(run_dirs)
    if not (stored or comparison.incomparable):
        from en4dvar.runs.finished import sampled_evidences

        evidences = [sampled_evidences(run_dir, workers, trust, tell) for run_dir in run_dirs]
        comparison = side_by_side.with_evidences(comparison, evidences)
    if 0 < len(comparison.estimates) <= MOST_ROWS:
        echo(f"{side_by_side.estimates_table(comparison)}\n")
    echo(side_by_side.comparison_table(comparison))
    return partial(side_by_side.write_comparison, comparison)


def _populations(
    run_dirs: tuple[Path, ...], against: tuple[float, ...], apart: tuple[str, ...], known: Known, alone: bool
) -> PopulationsCompared | None:
    """The populations of the runs side by side, told on standard output; None where there are none to compare.

    ``alone``: the folders hold nothing else. Raises :class:`OutputError`: they cannot be compared, and nothing else
    can be, or options ask for it.
    """
    from en4dvar.report.populations import compare_populations, medians_table, sentences
    from en4dvar.results.together import POPULATION

    held = all((run_dir / POPULATION).is_file() for run_dir in run_dirs)
    asked = (held and alone) or against or apart or known
    if not (asked or held):
        return None
    try:
        of = compare_populations(run_dirs, against, apart, known=known)
    except OutputError as error:
        if asked:
            raise
        echo(f"populations are not compared: {error}", err=True)
        return None
    echo("\n".join([medians_table(of), "", *sentences(of), ""]))
    return of


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option(
    "--csv", "kind", flag_value="csv", default="csv", help="Summary: one line per data set and parameter (default)."
)
@click.option("--members", "kind", flag_value="members", help="CSV of the posterior members.")
@click.option("--latex", "kind", flag_value="latex", help="Table for a paper (package booktabs).")
@click.option("--netcdf", "kind", flag_value="netcdf", help="Say where posterior.nc is; it needs no export.")
@click.option("--out", type=click.Path(path_type=Path), help="File to write; default standard output.")
@click.option("--force", is_flag=True, help="Replace that file.")
def export(run_dir: Path, kind: Literal["csv", "latex", "members", "netcdf"], out: Path | None, force: bool) -> None:
    """Write a table of a run as CSV or LaTeX, in display units.

    For a sequence or a twin experiment, --csv holds the state in time and --latex the last analysis.

    \b
    Example:
      en4dvar export runs/quickstart --latex --out table.tex
    """
    from en4dvar.report.export import export_table
    from en4dvar.report.sequence import cycles_table
    from en4dvar.results.run_results import LackingError
    from en4dvar.results.series_file import series_file
    from en4dvar.results.store import posterior_file

    cycles = series_file(run_dir)
    if kind == "netcdf":
        path = cycles or posterior_file(run_dir)
        known = ("is netCDF", "xarray.open_dataset") if cycles else ("follows the ArviZ schema", "arviz.from_netcdf")
        echo(f"{path} {known[0]} as it is: {known[1]}({str(path)!r}); nothing to export")
        return
    results = [path for suffix in ("nc", "pack") for path in run_dir.glob(f"*.{suffix}")]
    try:
        text = cycles_table(cycles, kind) if cycles else export_table(run_dir, kind)
    except LackingError as error:
        if isinstance(error.rest, str):
            deliver(error.rest, out, "table", force, results)
        raise
    deliver(text, out, "table", force, results)


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
@workers_option
@trust_option
def rerun(run_dir: Path, workers: int | None, trust: bool) -> None:
    """Repeat a run from its result files, and compare every bit.

    Nothing is written. Configuration, seed and observations are those in the files; the data of a sequence are read
    again. It says if a bit differs (exit code 1), or if anything that decides the bits has changed since (versions,
    sources, processor, data files). A law or model outside the current folder and installed packages runs only if
    you agree when asked, or with --trust.

    \b
    Example:
      en4dvar rerun runs/quickstart
    """
    from en4dvar.runs.rerun import rerun as repeat

    repeated = repeat(run_dir, workers, trust=trust, ask=ask)
    echo(str(repeated))
    if not repeated.same:
        raise Failed("the run is not reproduced", 1)


def several_runs(command: Callable[..., Told]) -> Callable[..., None]:
    """The arguments RUN_DIR, and the options that estimates of finished runs together have in common.

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
    @click.option("--force", is_flag=True, help="Begin anew; an earlier result is replaced in any case.")
    @click.option(
        "--resume", is_flag=True,
        help="Keep a result that is whole; an interrupted estimate continues in any case, to the same numbers.",
    )  # fmt: skip
    @workers_option
    @trust_option
    @functools.wraps(command)
    def with_runs(
        run_dirs: tuple[Path, ...], out: Path | None, workers: int | None, trust: bool, force: bool, resume: bool,
        **options: Any,
    ) -> None:  # fmt: skip
        how = {"workers": workers, "trust": trust, "ask": ask, "tell": tell, "force": force, "resume": resume}
        folder = out or folder_of(kind, run_dirs)
        with continuable():
            table, cautions, page = command(run_dirs, folder, how, **options)
        echo(table)
        for caution in cautions:
            echo(f"{caution.kind}: {caution}", err=True)
        echo(f"report: {page if out else from_here(page)}")

    return with_runs


@click.command()
@click.option(
    "--share", "names", multiple=True, metavar="NAME",
    help="A parameter with one value in all data sets, e.g. G; default: what their configurations share.",
)  # fmt: skip
@click.option(
    "--apart", multiple=True, metavar="NAME",
    help="A constant of medium or camera of which each data set has its own value, e.g. p_inf; any number of times.",
)  # fmt: skip
@several_runs
def joint(
    runs: tuple[Path, ...], out: Path, how: dict[str, Any], names: tuple[str, ...], apart: tuple[str, ...]
) -> Told:
    """Estimate data sets together that share parameters.

    They are, for example, samples of one material or records of one instrument. Takes finished runs of different
    readings, any of which may be a campaign; models, windows and errors may differ. Estimated constants of the
    medium and the camera have one value in all, except those --apart. Each data set has its own values of what is
    not shared. Writes joint.nc, joint.csv and a page.

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
    "--mean-std", type=Number(min=0, min_open=True), show_default="as in the run's population:, or 1",
    help="Hyperprior of the mean: normal about the prior's mean; its std as a multiple of the prior's.",
)  # fmt: skip
@click.option(
    "--spread", type=Number(min=0, min_open=True), show_default="as in the run's population:, or 0.5",
    help="Hyperprior of the spread: half-normal; its std as a multiple of the prior's.",
)  # fmt: skip
@click.option(
    "--odd", type=Number(min=0, max=1, max_open=True), show_default="as in the run's population:, or 0.05",
    help="Probability that a data set is odd, i.e. of another population, in all parameters or in one.",
)  # fmt: skip
@several_runs
def population(
    runs: tuple[Path, ...], out: Path, how: dict[str, Any], names: tuple[str, ...], **hyper: float | None
) -> Told:
    """Estimate how parameters vary over data sets, and their mean.

    The data sets are samples of one material. Takes finished runs of the same parameters, with at least three data
    sets in all, whatever their errors. Unlike stacked posteriors it counts the prior once. Estimated constants of
    the medium and the camera have one value in all data sets. Writes population.nc, .csv, .tex and a page.

    \b
    Example:
      en4dvar population runs/twelve_bubbles --of G --of mu
    """
    from en4dvar.report.together import population_lines
    from en4dvar.runs.together import population as estimate

    changed = {name: value for name, value in hyper.items() if value is not None}
    result, page = estimate(runs, names, out, hyper=changed, **how)
    return "\n".join(population_lines(result)), result.cautions, page
