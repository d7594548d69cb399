"""``en4dvar sweep`` and ``en4dvar study``. Heavy imports stay inside the commands."""

import os
from pathlib import Path

import click

from en4dvar.commands.common import Number, Source, continuable


@click.command()
@click.argument("configs", metavar="CONFIG...", nargs=-1, required=True, type=click.Path())
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a value of the configuration.")
@click.option("--data", metavar="FILE", type=click.Path(), help="Data file, folder or pattern instead of data.path.")
@click.option(
    "--trajectories", type=click.IntRange(min=2), default=50_000, show_default=True, help="Size of the design."
)
@click.option("--shift", default="0.8 us", show_default=True, help="Largest time shift.")
@click.option("--step", default="0.025 us", show_default=True, help="Step of the time grid and of the shifts.")
@click.option(
    "--width",
    type=Number(min=0, min_open=True),
    default=3.0,
    show_default=True,
    help="Range searched, in prior standard deviations.",
)
@click.option("--refine", type=click.IntRange(min=0), default=0, show_default=True, help="Rounds of local refinement.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the results; default runs/<name>_sweep.")
@click.option("--force", is_flag=True, help="Replace an earlier sweep.")
@click.option("--resume", is_flag=True, help="Continue an interrupted sweep.")
@click.option("--workers", type=click.IntRange(min=1), help="Threads; results do not depend on their number.")
def sweep(
    configs: tuple[str, ...], settings: tuple[str, ...], data: str | None, trajectories: int, shift: str, step: str,
    width: float, refine: int, out: Path | None, force: bool, resume: bool, workers: int | None,
) -> None:  # fmt: skip
    """Fit every data set by a search over simulations.

    This is the paper's IMR approach, by NRMSE. The design spans the priors of the configuration; the time shift is
    searched within --shift. Several configurations of one model share a design, and each trajectory is computed
    once for all their data sets.

    \b
    Examples:
      en4dvar sweep configs/agarose_03_qlkv.yaml --refine 4
      en4dvar sweep configs/agarose_03_qlkv.yaml configs/agarose_10_qlkv.yaml --trajectories 200000
    """
    from en4dvar.assembly.build import build
    from en4dvar.executor import choose_executor
    from en4dvar.plumbing.files import write_text
    from en4dvar.plumbing.units import UnitError, parse_quantity
    from en4dvar.runs.progress import counted
    from en4dvar.sampling.sweep import SweepSettings, run_sweep
    from en4dvar_agarose.run import StudyCheckpoints, earliest_reading, identity_of, one_model
    from en4dvar_agarose.tables import sweep_csv, sweep_text

    if len({*map(os.path.realpath, configs)}) < len(configs):
        raise click.UsageError("the same configuration is given twice, and its data sets would count twice")
    loaded = [Source(Path(config), data, settings).load() for config in configs]
    problems = one_model([problem for config in loaded for problem in build(config)])
    try:
        within, grid = (parse_quantity(text, problems[0].model.time_unit) for text in (shift, step))
    except UnitError as error:
        raise click.UsageError(f"--shift {shift}, --step {step}: {error}") from None
    if within < 0 or grid <= 0:
        raise click.UsageError("--shift must not be negative, and --step must be positive")
    chosen = SweepSettings(trajectories, within, grid, width, rounds=refine)
    folder = out or Path("runs") / f"{loaded[0].name}_sweep"
    who = identity_of(loaded[0].seed, chosen, {f"{i} {config.name}": config for i, config in enumerate(loaded, 1)})
    files = "sweep.csv", "checkpoints/*", "checkpoints/sweep/*"
    with (
        continuable(),
        StudyCheckpoints.open(folder, force, resume, who, files) as keep,
        counted("trajectories") as progress,
        choose_executor(problems[0].model, workers=workers) as executor,
    ):
        earliest = earliest_reading(problems[0].model)
        result = run_sweep(problems, chosen, loaded[0].seed, executor, keep.sweep(), progress, earliest)
        write_text(keep.directory.at("sweep.csv"), sweep_csv(result))
    click.echo(sweep_text(result))
    click.echo(f"best fits: {folder / 'sweep.csv'}")


@click.command()
@click.argument("config", type=click.Path())
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a value, e.g. sweep.trajectories=2000."
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the results; default runs/<name>.")
@click.option("--force", is_flag=True, help="Replace an earlier study.")
@click.option("--resume", is_flag=True, help="Continue a study that was interrupted.")
@click.option("--workers", type=click.IntRange(min=1), help="Threads; results do not depend on their number.")
def study(
    config: str, settings: tuple[str, ...], out: Path | None, force: bool, resume: bool, workers: int | None
) -> None:
    """Repeat the paper's study of agarose.

    Sweep and En4D-Var with three models, tables, figures and populations.

    \b
    Example:
      en4dvar study configs/agarose_study.yaml
    """
    from en4dvar.executor import available_cores
    from en4dvar_agarose.report import FILES, write_study
    from en4dvar_agarose.run import StudyCheckpoints, identity_of, run_study
    from en4dvar_agarose.settings import load_study

    plan = load_study(config, Source(Path(config), None, settings).overrides())
    folder = out or Path("runs") / plan.name
    who = identity_of(plan.seed, plan.sweep, plan.named)
    with continuable(), StudyCheckpoints.open(folder, force, resume, who, FILES) as keep:
        result = run_study(plan, workers or available_cores(), lambda message: click.echo(message, err=True), keep)
        page = write_study(result, keep.directory.work)
    for gel, comparison in result.comparisons.items():
        click.echo(f"{gel}: {comparison.undecidable} of {len(comparison.single)} data sets cannot tell the laws apart")
    click.echo(f"report: {folder / page.name}" + (" (synthetic twin, no measurement)" if plan.synthetic else ""))
