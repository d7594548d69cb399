"""``en4dvar run``."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path
from typing import TYPE_CHECKING

import click

from en4dvar.commands.common import Failed, Source, command_line, config_options, continuable, note_beginning

if TYPE_CHECKING:
    from en4dvar.caution import Caution
    from en4dvar.config import Config, SequenceConfig, TwinConfig
    from en4dvar.cycling.problem import SeriesResult
    from en4dvar.cycling.twin import TwinResult
    from en4dvar.runs.campaign import Campaign

MOST_TOLD = 30  # data sets, warnings and failures on the terminal; all of them are in the run directory


@click.command()
@config_options
@click.option("--out", type=click.Path(path_type=Path), help="Run directory; default output.directory or runs/<name>.")
@click.option("--force", is_flag=True, help="Replace an earlier run in the run directory, once this one is complete.")
@click.option(
    "--resume",
    is_flag=True,
    help="Continue the interrupted run in the run directory, to the same bits; if there is none, begin.",
)
@click.option("--no-report", is_flag=True, help="Write no page; 'en4dvar report' writes it later.")
@click.option("--workers", type=click.IntRange(min=1), help="Parallel workers; the numbers do not depend on it.")
@click.option("--scheduler", metavar="ADDRESS", help="Work on a dask cluster, e.g. tcp://10.0.0.1:8786.")
def run(
    source: Source,
    out: Path | None,
    force: bool,
    resume: bool,
    no_report: bool,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Estimate the parameters; write posterior and report to the run directory.

    Several data files (a list, a pattern or a folder) are a campaign; a file that cannot be used does not stop it.
    A configuration with a 'twin:' section is a twin experiment: RMSE and spread against its truth. One with a
    'sequence:' section is followed in time by a filter or a sliding-window smoother.

    \b
    Example:
      en4dvar run configs/quickstart.yaml --out runs/first --set assimilation.members=96
    """
    from en4dvar.config import Config, TwinConfig, load_any

    special = {
        "output.directory": str(out) if out else None,
        "output.report": False if no_report else None,
        "execution.workers": workers,
        "execution.address": scheduler,
    }
    with chdir("."):  # own code of a configuration may leave this folder, which --out refers to
        config = load_any(source.path, source.overrides(**special))
    note_beginning(config.directory, resume)
    if isinstance(config, Config):
        _estimate(config, force, resume)
    elif scheduler:
        raise click.UsageError(
            "--scheduler cannot be used for a series: its cycles are too short to be sent to other machines"
        )
    elif isinstance(config, TwinConfig):
        _conduct(config, force, resume)
    else:
        _follow(config, force, resume)


def _estimate(config: Config, force: bool, resume: bool) -> None:
    from en4dvar.executor import available_cores
    from en4dvar.runs.progress import terminal_progress
    from en4dvar.runs.runner import run_campaign

    with continuable(), terminal_progress() as progress:
        campaign = run_campaign(
            config, force=force, resume=resume, progress=progress, command=command_line(),
            report_workers=config.execution.workers or available_cores(),
        )  # fmt: skip
    _tell(campaign, with_report=config.report)


def _tell(campaign: Campaign, with_report: bool) -> None:
    """The posterior on standard output, warnings on standard error. Raises :class:`Failed` where a data set has."""
    from en4dvar.storage.joint_file import FILE, load_joint
    from en4dvar.storage.population_file import FILE as POPULATION
    from en4dvar.storage.population_file import load_population
    from en4dvar.summary import results_table

    few = len(campaign) <= MOST_TOLD
    summaries, remarks, warnings = {}, [], _Warnings()
    for i, outcome in enumerate(campaign.outcomes):  # once: each is read from the disk
        if few and not outcome.failure:
            summaries[outcome.name] = outcome.summary
        if i < MOST_TOLD:
            remarks += [f"{outcome.name}: {remark}" for remark in outcome.remarks]
        warnings.add(outcome.name, outcome.warnings)
    if few:
        click.echo(results_table(summaries))
    for remark in remarks:
        click.echo(remark)
    together = load_joint(campaign.directory / FILE) if (campaign.directory / FILE).exists() else None
    if together:
        from en4dvar.report.joint import joint_table

        click.echo(f"\n{joint_table(together)}")
    behind = load_population(campaign.directory / POPULATION) if (campaign.directory / POPULATION).exists() else None
    if behind:
        from en4dvar.report.population import population_lines

        click.echo("\n" + "\n".join(population_lines(behind)))
    for notice in campaign.notices:
        click.echo(f"warning: {notice}", err=True)
    warnings.add("all together", together.cautions if together else ())
    warnings.add("population", behind.cautions if behind else ())
    for name, warning in warnings.worst:
        click.echo(f"{warning.kind}: {name}: {warning}", err=True)
    if warnings.count > MOST_TOLD:
        click.echo(f"and {warnings.count - MOST_TOLD} more warnings and notes; see run.log", err=True)
    if len(campaign) and with_report:
        click.echo(f"report: {campaign.directory / 'report.html'}")
    if campaign.failures:
        reasons = [f"{o.name}: {o.failure}" for o in campaign.failures]
        head = f"{len(reasons)} of {len(campaign.outcomes)} data sets failed:"
        more = [f"and {len(reasons) - MOST_TOLD} more; see summary.csv"] if len(reasons) > MOST_TOLD else []
        raise Failed("\n".join([head, *reasons[:MOST_TOLD], *more]), campaign.exit_code)


class _Warnings:
    """``worst``: those that are told, each with its data set, the worst first. The others are only counted."""

    def __init__(self) -> None:
        self.worst: list[tuple[str, Caution]] = []
        self.count = 0

    def add(self, name: str, cautions: Sequence[Caution]) -> None:
        self.count += len(cautions)
        known = [*self.worst, *((name, caution) for caution in cautions)]
        self.worst = sorted(known, key=lambda one: one[1].rank)[:MOST_TOLD]


def _conduct(config: TwinConfig, force: bool, resume: bool) -> None:
    from en4dvar.runs.progress import cycle_progress
    from en4dvar.runs.twin_run import run_twin, scores_table

    with continuable(), cycle_progress(config.experiment.cycles) as on_cycle:
        result = run_twin(config, force=force, resume=resume, on_cycle=on_cycle, command=command_line())
    click.echo(scores_table(result))
    _tell_series(config, "twin.nc", config.experiment.members, result)


def _follow(config: SequenceConfig, force: bool, resume: bool) -> None:
    from en4dvar.config.build_sequence import build_sequence
    from en4dvar.runs.progress import cycle_progress
    from en4dvar.runs.sequence_run import estimates_table, run_sequence

    with continuable(), cycle_progress(len(build_sequence(config).series.times)) as on_cycle:
        result = run_sequence(config, force=force, resume=resume, on_cycle=on_cycle, command=command_line())
    click.echo(estimates_table(result))
    _tell_series(config, "sequence.nc", config.assimilation.members, result)


def _tell_series(
    config: TwinConfig | SequenceConfig, file: str, members: int, result: TwinResult | SeriesResult
) -> None:
    """Warnings on standard error, and where the files are."""
    if result.run.failures:
        lost = f"{len(result.run.failures)} of {members} members lost"
        click.echo(f"warning: {config.name}: {lost}, the last: {result.run.failures[-1]}", err=True)
    for warning in result.warnings:
        click.echo(f"warning: {config.name}: {warning}", err=True)
    click.echo(f"result: {config.directory / file}")
    if config.report:
        click.echo(f"report: {config.directory / 'report.html'}")
