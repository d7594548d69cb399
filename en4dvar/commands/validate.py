"""``en4dvar validate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from en4dvar.commands.common import Source, config_options, echo

if TYPE_CHECKING:
    from en4dvar.descent.preview import Preview


@click.command()
@config_options
@click.option("--plot", is_flag=True, help="Draw the prior predictive over the data (PNG and PDF).")
def validate(source: Source, plot: bool) -> None:
    """Check a configuration and its data; say what would be estimated and what it costs.

    All mistakes are listed at once, with file, line and column. A data file that cannot be used is named, and does not
    stop the others, as in a run. The cost is estimated by running a few prior members.

    \b
    Example:
      en4dvar validate configs/quickstart.yaml --plot
    """
    from en4dvar.config import Config, TwinConfig
    from en4dvar.runs.checks import check_all

    checked = check_all(source.path, source.overrides())
    loaded, problems = checked.config, checked.problems
    if not isinstance(loaded, Config):
        from en4dvar.runs.cycles import cycles_of

        if plot:
            of_sequence = "--plot is for estimations; the report of a sequence shows its forecasts"
            of_twin = "a twin experiment has no data to plot the prior over"
            raise click.UsageError(of_twin if isinstance(loaded, TwinConfig) else of_sequence)
        echo(str(cycles_of(loaded)))
        return
    from en4dvar.commands.describe import cost_summary, problem_summary
    from en4dvar.descent.preview import preview
    from en4dvar.priors.prior import own_seed

    echo(problem_summary(loaded, problems))
    chosen = problems[:1]
    if plot:
        from en4dvar.plumbing.files import make_folder
        from en4dvar.report.history import PANELS, prior_predictive
        from en4dvar.report.paper import save_chart

        chosen = problems[:PANELS]
    seeds = [own_seed(loaded.seed, problem.observations.name) for problem in chosen]
    previews = [preview(p, loaded.assimilation, seed, whole=plot) for p, seed in zip(chosen, seeds, strict=True)]
    echo(cost_summary(loaded, previews[0], len(problems)))
    for shown in previews:
        _warn(shown)
    if checked.unusable:
        echo(f"warning: a run goes on with {len(problems)} data set(s), without those that cannot be used:", err=True)
    for fault in checked.unusable:
        echo(str(fault), err=True)
    if plot:
        folder, name = make_folder(loaded.directory.parent), f"{loaded.directory.name}_prior"
        save_chart(prior_predictive(previews), folder, name)
        left = f" ({len(previews)} of {len(problems)} data sets)" if len(previews) < len(problems) else ""
        echo(f"prior predictive: {folder / name}.png and .pdf{left}")


def _warn(preview: Preview) -> None:
    """Print the problems of a run that the prior ensemble already shows."""
    from en4dvar.diagnosis.honesty import doubts

    name, reasons = preview.problem.observations.name, [reason for reason in preview.run.failures if reason]
    if reasons:
        lost = f"{len(reasons)} of {len(preview.run.failures)} prior members cannot be run"
        echo(f"warning: {name}: {lost}, e.g.: {reasons[0]}", err=True)
    of_model = doubts(preview.problem, preview.members, preview.run.predictions)
    for doubt in (*preview.problem.observations.doubts, *of_model):
        echo(f"{doubt.kind}: {name}: {doubt.words}", err=True)
    if preview.outside > 0.1:
        share = f"{100 * preview.outside:.0f} % of the observations lie outside everything the prior expects"
        echo(f"warning: {name}: {share}; check units, clock and window (--plot shows them)", err=True)
