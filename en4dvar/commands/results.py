"""Commands that read run directories: ``en4dvar report``, ``en4dvar rerun`` and ``en4dvar compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from en4dvar.commands.common import (
    Failed,
    ask,
    deliver,
    echo,
    folder_of,
    from_here,
    refuse_to_replace,
    tell,
    trust_option,
    workers_option,
)

MOST_ROWS = 60  # of estimates on the terminal


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option("--dataset", "datasets", multiple=True, metavar="NAME", help="A page for this data set, too.")
@click.option(
    "--figures", is_flag=True, help="Also keep the figures as PDF and PNG: of these data sets, or of all pages."
)
def report(run_dir: Path, datasets: tuple[str, ...], figures: bool) -> None:
    """Write the report of a finished run again, from its netCDF files.

    In a campaign of many data sets only those with the gravest warnings have a page of their own; --dataset (any
    number of times) adds one.

    \b
    Example:
      en4dvar report runs/quickstart --figures
    """
    from en4dvar.executor import available_cores
    from en4dvar.runs.engine import write_report

    echo(f"report: {write_report(run_dir, datasets, available_cores(), figures)}")


@click.command()
@click.argument("run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR RUN_DIR...")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the results; default compare_... beside the first."
)
@click.option("--no-report", is_flag=True, help="Print the tables only.")
@click.option("--stored", is_flag=True, help="Take the evidences stored in the results; run nothing.")
@workers_option
@trust_option
def compare(
    run_dirs: tuple[Path, ...], out: Path | None, no_report: bool, stored: bool, workers: int | None, trust: bool
) -> None:
    """Compare runs: posteriors over each other and, on the same data, evidence and model probabilities.

    Evidences are sampled with forward runs if the model is cheap. Code outside the current folder and installed
    packages is run only with --trust.

    The runs may be laws on the same data or different gels. Writes compare.html, a figure (PNG, PDF) and CSV tables.
    For sequences, a table of their evidences is printed.

    \b
    Example:
      en4dvar compare runs/neo_hookean runs/quadratic
    """
    from en4dvar.report.compare import compare_runs, comparison_table, estimates_table, with_evidences
    from en4dvar.results.series_file import series_file

    if any(map(series_file, run_dirs)):
        from en4dvar.report.compare_cycles import compare_sequences, sequences_table

        echo(sequences_table(compare_sequences(run_dirs)))
        return
    comparison = compare_runs(run_dirs)
    if not (stored or comparison.incomparable):
        from en4dvar.runs.evidence_run import sampled_evidences

        evidences = [sampled_evidences(run_dir, workers, trust, None, tell) for run_dir in run_dirs]
        comparison = with_evidences(comparison, evidences)
    if len(comparison.estimates) <= MOST_ROWS:
        echo(f"{estimates_table(comparison)}\n")
    echo(comparison_table(comparison))
    if not no_report:
        from en4dvar.report.overlay import write_comparison

        page = write_comparison(comparison, out or folder_of("compare", run_dirs))
        echo(f"report: {page if out else from_here(page)}")


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option(
    "--csv", "kind", flag_value="csv", default="csv", help="Summary: one line per data set and parameter (default)."
)
@click.option("--members", "kind", flag_value="members", help="CSV of the posterior members.")
@click.option("--latex", "kind", flag_value="latex", help="Table for a paper (package booktabs).")
@click.option("--netcdf", "kind", flag_value="netcdf", help="Say where posterior.nc is, which needs no export.")
@click.option("--out", type=click.Path(path_type=Path), help="File to write; default standard output.")
@click.option("--force", is_flag=True, help="Replace that file.")
def export(run_dir: Path, kind: Literal["csv", "latex", "members", "netcdf"], out: Path | None, force: bool) -> None:
    """Write a table of a run as CSV or LaTeX, in display units.

    For a sequence or a twin experiment, --csv holds the state in time and --latex the last analysis.

    \b
    Example:
      en4dvar export runs/quickstart --latex --out table.tex
    """
    from en4dvar.report.export import export_table, posterior_file
    from en4dvar.results.run_results import LackingError
    from en4dvar.results.series_file import series_file

    cycles = series_file(run_dir)
    if kind == "netcdf" and cycles:
        echo(f"{cycles} is netCDF as it is: xarray.open_dataset({str(cycles)!r}); nothing to export")
        return
    if kind == "netcdf":
        path = posterior_file(run_dir)
        echo(f"{path} follows the ArviZ schema as it is: arviz.from_netcdf({str(path)!r}); nothing to export")
        return
    if cycles:
        from en4dvar.report.export_cycles import cycles_table

        text = cycles_table(cycles, kind)
    else:
        try:
            text = export_table(run_dir, kind)
        except LackingError as error:
            if isinstance(error.rest, str):
                refuse_to_replace(out, force)
                deliver(error.rest, out, "table")
            raise
    refuse_to_replace(out, force)
    deliver(text, out, "table")


@click.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
@workers_option
@trust_option
def rerun(run_dir: Path, workers: int | None, trust: bool) -> None:
    """Repeat a run from what its result files record, and compare to the last bit. Nothing is written.

    Configuration, seed and observations are those in the files; the data of a sequence are read again. It says if a bit
    differs, or if anything that decides the bits has changed since (versions, sources, processor, data files); the
    exit code is 1 if a bit differs. A law or model outside the current folder and installed packages is run only if
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
