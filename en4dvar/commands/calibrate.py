"""``en4dvar calibrate``: are the intervals of a configuration right?"""

from pathlib import Path

import click

from en4dvar.commands.common import Source, command_line, config_options, continuable, echo, note_beginning, parted


@click.command()
@config_options
@click.option("--sets", type=click.IntRange(min=2), default=200, show_default=True, help="Number of synthetic sets.")
@click.option(
    "--made-with", "made", multiple=True, metavar="KEY=VALUE",
    help="Make the readings, not the estimates, with another value; any number of times."
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder; default runs/<name>_calibration.")
@click.option("--force", is_flag=True, help="Replace an earlier calibration, once this one is complete.")
@click.option("--resume", is_flag=True, help="Go on with an interrupted one, or with more sets.")
@click.option("--workers", type=click.IntRange(min=1), help="Parallel workers; the numbers do not depend on it.")
def calibrate(
    source: Source, sets: int, made: tuple[str, ...], out: Path | None, force: bool, resume: bool, workers: int | None
) -> None:
    """Make synthetic data sets by the configuration itself, estimate them, and test the ranks of the truths.

    Truths are drawn from the priors, readings from the model with the errors of the file, at the times of its data. Of
    a correct posterior 90 % intervals hold nine truths in ten. With --made-with the readings are made otherwise, which
    shows what a wrong assumption would do. Writes calibration.csv and a page.

    \b
    Example:
      en4dvar calibrate configs/quickstart.yaml --sets 100
    """
    from en4dvar.runs.calibration_run import calibrate as conduct
    from en4dvar.runs.progress import counted

    if out is not None:
        note_beginning(out, resume)
    overrides = source.overrides(**{"execution.workers": workers})
    with continuable(), counted("sets") as progress:
        result = conduct(
            source.path, sets, overrides=overrides, made_with=parted(made, "--made-with"), out=out, force=force,
            resume=resume, progress=progress, command=command_line(),
        )  # fmt: skip
    echo(str(result))
    for remark in result.remarks:
        echo(f"note: {remark}", err=True)
    echo(f"report: {result.directory / 'calibration.html'}")
