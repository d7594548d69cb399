"""``en4dvar sweep-twin``: a twin experiment for several settings and seeds."""

from pathlib import Path

import click

from en4dvar.commands.common import Source, command_line, config_options, continuable, echo, note_beginning, parted


@click.command(name="sweep-twin")
@config_options
@click.option(
    "--vary", "varied", multiple=True, required=True, metavar="KEY=[VALUE, …]",
    help="A key and its values; any number of times, for all combinations."
)  # fmt: skip
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    default=5,
    show_default=True,
    help="Number of seeds per combination, from the file's on.",
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the table; default runs/<name>_sweep.")
@click.option("--force", is_flag=True, help="Replace an earlier sweep, once this one is complete.")
@click.option("--resume", is_flag=True, help="Take over finished runs; seeds and values may be added at the end.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes, by default one per core; the same numbers.")
def sweep_twin(
    source: Source, varied: tuple[str, ...], seeds: int, out: Path | None, force: bool, resume: bool,
    workers: int | None,
) -> None:  # fmt: skip
    """Compare settings in twin experiments: RMSE and spread, mean ± standard error over seeds.

    All settings see the same truths and observations. Writes sweep.csv and, with every run, runs.csv.

    \b
    Example:
      en4dvar sweep-twin configs/lorenz96_etkf.yaml --vary 'assimilation.scheme=[etkf, esrf, enkf-n]' --seeds 10
    """
    from en4dvar.runs.twin_sweep import sweep_twin as sweep

    def tell(done: int, of: int) -> None:
        echo(f"{done} of {of} runs", err=True)

    vary = parted(varied, "--vary")
    if out is not None:
        note_beginning(out, resume)
    with continuable():
        result = sweep(
            source.path, vary, seeds, overrides=source.overrides(), out=out, workers=workers, force=force,
            resume=resume, progress=tell, command=command_line(),
        )  # fmt: skip
    echo(str(result))
    for reason in dict.fromkeys(run.failure for runs in result.runs for run in runs if run.failure):
        echo(f"failed: {reason}", err=True)
    echo(f"averages: {result.directory / 'sweep.csv'}")
