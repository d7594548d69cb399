"""Commands of a configuration: ``en4dvar run`` and ``en4dvar validate``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import chdir
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from en4dvar.commands.common import Failed, Source, config_options, continuable, echo, workers_option
from en4dvar.plumbing.hints import counted

if TYPE_CHECKING:
    from en4dvar.config import SequenceConfig, TwinConfig
    from en4dvar.descent.preview import Preview
    from en4dvar.plumbing.caution import Caution
    from en4dvar.runs.campaign import Campaign

MOST_TOLD = 30  # data sets and failures on the terminal; all of them are in the run directory
MOST_NAMED = 3  # data sets of a warning


@click.command()
@config_options
@click.option("--out", type=click.Path(path_type=Path), help="Run directory; default output.directory or runs/<name>.")
@click.option("--force", is_flag=True, help="Replace an earlier run in the run directory, once this one is complete.")
@click.option(
    "--resume",
    is_flag=True,
    help="Continue the interrupted run in the run directory, to the same bits; if there is none, begin one.",
)
@click.option("--no-report", is_flag=True, help="Write no page; 'en4dvar report' writes it later.")
@click.option("--with-what-if", is_flag=True, help="Widen the intervals by the assumptions of the what-if table.")
@workers_option
@click.option("--scheduler", metavar="ADDRESS", help="Work on a dask cluster, e.g. tcp://10.0.0.1:8786.")
def run(source: Source, force: bool, resume: bool, workers: int | None, scheduler: str | None, **asked: Any) -> None:
    """Estimate the parameters; write posterior and report.

    Several data files (a list, a pattern or a folder) are a campaign; a file that cannot be used does not stop it.
    A configuration with a 'twin:' section is a twin experiment: RMSE and spread against its truth. One with a
    'sequence:' section is assimilated cycle by cycle, by a filter or a sliding-window smoother.

    \b
    Example:
      en4dvar run configs/quickstart.yaml --out runs/first --set assimilation.members=96
    """
    from en4dvar.config import Config, load_any

    special = {
        "output.directory": str(asked["out"]) if asked["out"] else None,
        "output.report": False if asked["no_report"] else None,
        "assimilation.what_if": "added" if asked["with_what_if"] else None,
        "execution.workers": workers,
        "execution.address": scheduler,
    }
    with chdir("."):  # own code of a configuration may leave this folder, which --out refers to
        config = load_any(source.path, source.overrides(**special))
    if isinstance(config, Config):
        from en4dvar.executor import available_cores
        from en4dvar.runs.progress import terminal_progress
        from en4dvar.runs.runner import run_campaign

        with continuable() as command, terminal_progress() as progress:
            campaign = run_campaign(
                config, force=force, resume=resume, progress=progress, command=command,
                report_workers=config.execution.workers or available_cores(),
            )  # fmt: skip
        _tell(campaign, with_report=config.report)
    elif scheduler:
        raise click.UsageError("--scheduler is not for a series: its cycles are too short to be sent to other machines")
    else:
        _follow(config, force, resume)


def _tell(campaign: Campaign, with_report: bool) -> None:
    """The posterior on standard output, warnings on standard error. Raises :class:`Failed` where a data set has.

    Of a campaign: the table of its data sets, of many that of its parameters, and its warnings counted by kind.
    """
    from en4dvar.estimation.summary import Estimates, results_table

    few, warnings, spread = len(campaign) <= MOST_TOLD, _Warnings(), Estimates()
    shown = {}
    for outcome in campaign.outcomes:  # once: each is read from the disk
        if few and not outcome.failure:
            shown[outcome.name] = outcome.summary
        spread.add(outcome.summary)
        warnings.add(outcome.name, outcome.warnings)
    if spread:
        echo(results_table(shown) if few else str(spread))
    for remark in campaign.outcomes[0].remarks if len(campaign.outcomes) == 1 else ():
        echo(f"{campaign.outcomes[0].name}: {remark}")
    _tell_what_sets_share(campaign.directory, warnings)
    for notice in campaign.notices:
        echo(f"warning: {notice}", err=True)
    for line in warnings.lines():
        echo(line, err=True)
    if len(campaign) and with_report:
        echo(f"report: {campaign.directory / 'report.html'}")
    if campaign.failures:
        reasons = [f"{o.name}: {o.failure}" for o in campaign.failures]
        head = f"{len(reasons)} of {len(campaign.outcomes)} data sets failed:"
        more = [f"and {len(reasons) - MOST_TOLD} more; see summary.csv"] if len(reasons) > MOST_TOLD else []
        raise Failed("\n".join([head, *reasons[:MOST_TOLD], *more]), campaign.exit_code)


def _tell_what_sets_share(directory: Path, warnings: _Warnings) -> None:
    """The joint estimate and the population of a run on standard output, where there are; their warnings are added."""
    from en4dvar.results.together import JOINT, load_joint, populations_of

    if (directory / JOINT).exists():
        from en4dvar.report.together import joint_table

        together = load_joint(directory / JOINT)
        echo(f"\n{joint_table(together)}")
        warnings.joint = True
        warnings.add("all together", together.cautions, whole=True)
    held = populations_of(directory)
    for n, (name, (_, of)) in enumerate(held.items()):
        from en4dvar.report.populations import group_lines
        from en4dvar.report.together import population_lines

        if name and n == 0:
            echo("\n" + "\n".join(group_lines(held)))
        echo("\n".join(["", *[name] * bool(name), *population_lines(of)]))
        warnings.add(f"the population of {name}" if name else "the population", of.cautions, whole=True)


class _Warnings:
    """Warnings by their kind: how many data sets have one, and those where most is wrong."""

    def __init__(self) -> None:
        self.of: dict[str, list[tuple[float, str, Caution]]] = {}  # code → the worst: place, data set, warning
        self.counts = Counter[tuple[str, str]]()  # of data sets: of a code, the worst severity it has there
        self.sets = 0
        self.wholes: dict[str, list[str]] = {}  # code → what is estimated of several data sets and has it
        self.joint = False  # single data sets only begin a joint estimate

    def add(self, name: str, cautions: Sequence[Caution], whole: bool = False) -> None:
        """Of a data set; ``whole``: of an estimate of several of them."""
        from en4dvar.plumbing.caution import codes, gravity

        if whole:
            for code in codes(cautions):
                self.wholes.setdefault(code, []).append(name)
        else:
            self.sets += 1
            worst = {c.code: c.severity for c in sorted(cautions, key=lambda c: -c.rank)}
            self.counts.update(worst.items())  # the milder ones of other data sets are in the report
        for caution in cautions:
            told = [*self.of.get(caution.code, []), (caution.rank - 1e-3 * gravity(cautions), name, caution)]
            self.of[caution.code] = sorted(told, key=lambda entry: entry[0])[:MOST_TOLD]

    def lines(self) -> Iterator[str]:
        """One for each kind, the worst first; of a single data set one for each warning.

        Where a joint estimate follows, what is less than serious in its single data sets is one line.
        """
        begun = []
        for told in sorted(self.of.values(), key=lambda entries: entries[0][2].rank):
            _, name, worst = told[0]
            told = [entry for entry in told if self.sets == 1 or entry[2].severity == worst.severity]
            count, wholes = self.counts[worst.code, worst.severity], self.wholes.get(worst.code, [])
            if self.joint and not wholes and worst.severity != "serious":
                begun.append(f"{worst.name} in {count}")
                continue
            if count + len(wholes) == 1:
                yield from (f"{caution.kind}: {name}: {caution}" for _, _, caution in told)
                continue
            which = [entry for entry in dict.fromkeys(entry[1] for entry in told) if entry not in wholes][:MOST_NAMED]
            if count > MOST_NAMED:
                which[0] = f"{count} of {self.sets} data sets, worst {which[0]}"
            who = " and ".join(", ".join(names) for names in (wholes, which) if names)
            yield f"{worst.kind}: {who}: {worst if count == 1 else f'{worst.name}; {worst.advice}'}"
        if begun:
            codes = ", ".join(begun)
            yield f"note: the fits of the {self.sets} single data sets only begin the joint estimate: {codes}"
        if self.sets > 1 and self.of:
            yield "what was found in each of them: run.log and the report"


def _follow(config: TwinConfig | SequenceConfig, force: bool, resume: bool) -> None:
    """Cycles, their table on standard output, warnings on standard error, and where the files are."""
    from en4dvar.runs.cycles import cycles_of
    from en4dvar.runs.engine import conduct_run
    from en4dvar.runs.progress import counted

    with continuable() as command, counted("cycles") as tell:
        kind = cycles_of(config, lambda cycle: tell(cycle + 1, kind.cycles) if tell else None)
        result = conduct_run(kind, force, resume, command)
    echo(result.table())
    for warning in result.warnings:
        echo(f"warning: {config.name}: {warning}", err=True)
    echo(f"result: {config.directory / kind.result}")
    if config.report:
        echo(f"report: {config.directory / 'report.html'}")


@click.command()
@config_options
@click.option("--plot", is_flag=True, help="Draw the prior predictive over the data (PNG and PDF).")
def validate(source: Source, plot: bool) -> None:
    """Check a configuration and its data; say what a run costs.

    It says what would be estimated. All mistakes are listed at once, with file, line and column. A data file that
    cannot be used is named, and does not stop the others, as in a run. The cost is estimated by running a few prior
    members.

    \b
    Example:
      en4dvar validate configs/quickstart.yaml --plot
    """
    from en4dvar.config import Config, TwinConfig
    from en4dvar.runs.checks import check_all

    loaded, problems, unusable = check_all(source.path, source.overrides())
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
    if unusable:
        left = counted(len(problems), "data set")
        echo(f"warning: a run goes on with {left}, without those that cannot be used:", err=True)
    for fault in unusable:
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
