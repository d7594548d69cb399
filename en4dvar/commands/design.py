"""``en4dvar design``: what experiments would tell, before they are made."""

from pathlib import Path

import click

from en4dvar.commands.common import Source, command_line, config_options, continuable, echo


@click.command()
@config_options
@click.option(
    "--after", metavar="RUN_DIR", type=click.Path(path_type=Path), help="Finished run whose posterior is the prior."
)
@click.option("--out", type=click.Path(path_type=Path), help="Directory of the result; default runs/<name>_design.")
@click.option("--force", is_flag=True, help="Replace an earlier result in the directory.")
@click.option("--resume", is_flag=True, help="Go on with an interrupted comparison; the numbers are the same.")
def design(source: Source, after: Path | None, out: Path | None, force: bool, resume: bool) -> None:
    """Compare planned experiments by the information they are expected to give.

    The configuration is that of 'run'; its data file need not exist. A 'design:' section says when readings are
    taken, which settings can be changed, and which parameters are asked about. Writes design.nc, designs.csv and a
    page.

    \b
    Example:
      en4dvar design configs/lotka_volterra_design.yaml
    """
    from en4dvar.report.design import design_table, remarks
    from en4dvar.runs.design_run import run_design
    from en4dvar.runs.progress import counted

    with continuable(), counted("designs") as on_design:
        plan, directory = run_design(
            source.path, overrides=source.overrides(), after=after, out=out, force=force, resume=resume,
            on_design=on_design, command=command_line(),
        )  # fmt: skip
    echo(design_table(plan))
    for remark in remarks(plan):
        echo(f"note: {remark}", err=True)
    echo(f"report: {directory / 'design.html'}")
