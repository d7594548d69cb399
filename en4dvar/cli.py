"""The command line. Heavy imports stay inside the commands, so that ``--help`` answers at once.

Exit codes: 0 done; 1 the run failed, or some data sets of a campaign; 2 usage, configuration, data or output directory;
3 too few surviving members (in a campaign: nothing else failed); 130 interrupted, to be continued with --resume.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from en4dvar.errors import En4dvarError
from en4dvar.plugin_commands import PluginCommand, plugin_commands

if TYPE_CHECKING:
    from en4dvar.config import Config, TwinConfig

F = Callable[..., Any]
MOST_TOLD = 30  # data sets, warnings and failures on the terminal; all of them are in the run directory


class Failed(click.ClickException):
    """An error told on standard error, without a traceback, with an exit code of ours."""

    def __init__(self, message: str, exit_code: int):
        super().__init__(message)
        self.exit_code = exit_code  # type: ignore[misc]

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(self.message, file=file, err=file is None)


class Commands(click.Group):
    """Adds the commands of application packages; turns errors of ours and Ctrl-C into messages and exit codes."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *plugin_commands()})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        built_in = super().get_command(ctx, cmd_name)
        plugin = None if built_in else plugin_commands().get(cmd_name)
        return PluginCommand(plugin) if plugin else built_in

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except En4dvarError as error:
            raise Failed(str(error), error.exit_code) from error
        except (KeyboardInterrupt, click.Abort) as interrupt:
            raise Failed(str(interrupt) or "interrupted", 130) from None


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="en4dvar")
def main() -> None:
    """Calibrate a model on measured time series with an ensemble (En4D-Var).

    \b
    Example:
      en4dvar run configs/quickstart.yaml
    """


def _config_options(command: F) -> F:
    for decorate in (
        click.option(
            "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a value, e.g. assimilation.members=96."
        ),
        click.option("--data", metavar="FILE", help="Data file, folder or pattern instead of data.path."),
        click.argument("config", type=click.Path()),
    ):
        command = decorate(command)
    return command


def _load(config: str, data: str | None, settings: tuple[str, ...]) -> Config:
    from en4dvar.config import load_config

    return load_config(config, _overrides(data, settings))


def _load_any(config: str, data: str | None, settings: tuple[str, ...], **special: Any) -> Config | TwinConfig:
    from en4dvar.config import load_any

    return load_any(config, _overrides(data, settings, **special))


def _overrides(data: str | None, settings: tuple[str, ...], **special: Any) -> dict[str, Any]:
    overrides: dict[str, Any] = {}
    for item in settings:
        key, equals, value = item.partition("=")
        if not equals:
            raise click.BadParameter(f"{item!r} is not KEY=VALUE", param_hint="--set")
        overrides[key.strip()] = value
    # A path on the command line is relative to the shell's folder, one in the file to the file's.
    special["data.path"] = [str(Path(data).absolute())] if data else None
    return overrides | {key: value for key, value in special.items() if value is not None}


@main.command()
@_config_options
@click.option("--out", type=click.Path(path_type=Path), help="Run directory; default output.directory or runs/<name>.")
@click.option("--force", is_flag=True, help="Replace an earlier run in the run directory, once this one is complete.")
@click.option("--resume", is_flag=True, help="Continue the interrupted run in the run directory, to the same bits.")
@click.option("--no-report", is_flag=True, help="Leave figures and page to 'en4dvar report'.")
@click.option("--workers", type=click.IntRange(min=1), help="Parallel workers; the numbers do not depend on it.")
@click.option("--scheduler", metavar="ADDRESS", help="Work on a dask cluster, e.g. tcp://10.0.0.1:8786.")
def run(
    config: str,
    data: str | None,
    settings: tuple[str, ...],
    out: Path | None,
    force: bool,
    resume: bool,
    no_report: bool,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Estimate the parameters; write posterior and report to the run directory.

    Several data files (a list, a pattern or a folder) are a campaign; one that cannot be used does not end it.
    A configuration with a 'twin:' section is a twin experiment: RMSE and spread against its truth.

    \b
    Example:
      en4dvar run configs/quickstart.yaml --out runs/first --set assimilation.members=96
    """
    special = {
        "output.directory": str(out) if out else None,
        "output.report": False if no_report else None,
        "execution.workers": workers,
        "execution.address": scheduler,
    }
    loaded = _load_any(config, data, settings, **special)
    from en4dvar.config import TwinConfig

    if isinstance(loaded, TwinConfig):
        if resume or scheduler:
            raise click.UsageError("a twin experiment takes neither --resume nor --scheduler")
        _run_twin(loaded, force)
        return
    from en4dvar.build import data_files, inverse_plan
    from en4dvar.describe import results_table
    from en4dvar.progress import terminal_progress
    from en4dvar.runner import execute

    words = ["en4dvar", *sys.argv[1:]]
    with terminal_progress(len(data_files(inverse_plan(loaded)))) as progress:
        try:
            campaign = execute(loaded, force=force, resume=resume, progress=progress, command=shlex.join(words))
        except KeyboardInterrupt as interrupt:
            again = shlex.join([*(w for w in words if w not in ("--force", "--resume")), "--resume"])
            raise Failed(f"{interrupt}\nto continue: {again}", 130) from None
    if len(campaign) <= MOST_TOLD:
        click.echo(results_table({o.name: o.summary for o in campaign.outcomes if not o.failure}))
    for notice in campaign.notices:
        click.echo(f"warning: {notice}", err=True)
    told = [f"{o.name}: {warning}" for o in campaign.outcomes for warning in o.warnings]
    for warning in told[:MOST_TOLD]:
        click.echo(f"warning: {warning}", err=True)
    if len(told) > MOST_TOLD:
        click.echo(f"warning: {len(told) - MOST_TOLD} more; see run.log", err=True)
    if len(campaign) and not no_report:
        click.echo(f"report: {campaign.directory / 'report.html'}")
    if campaign.failures:
        reasons = [f"{o.name}: {o.failure}" for o in campaign.failures]
        head = f"{len(reasons)} of {len(campaign.outcomes)} data sets failed:"
        more = [f"and {len(reasons) - MOST_TOLD} more; see summary.csv"] if len(reasons) > MOST_TOLD else []
        raise Failed("\n".join([head, *reasons[:MOST_TOLD], *more]), campaign.exit_code)


def _run_twin(config: TwinConfig, force: bool) -> None:
    from en4dvar.progress import cycle_progress
    from en4dvar.twin_run import run_twin, scores_table

    with cycle_progress(config.experiment.cycles) as on_cycle:
        result = run_twin(config, force=force, on_cycle=on_cycle, command=shlex.join(["en4dvar", *sys.argv[1:]]))
    click.echo(scores_table(result))
    if result.run.failures:
        lost = f"{len(result.run.failures)} of {config.experiment.members} members lost"
        click.echo(f"warning: {config.name}: {lost}, the last: {result.run.failures[-1]}", err=True)
    click.echo(f"result: {config.directory / 'twin.nc'}")


@main.command()
@_config_options
def validate(config: str, data: str | None, settings: tuple[str, ...]) -> None:
    """Check a configuration and its data without running; tell what would be estimated.

    \b
    Example:
      en4dvar validate configs/quickstart.yaml
    """
    loaded = _load_any(config, data, settings)
    from en4dvar.config import TwinConfig

    if isinstance(loaded, TwinConfig):
        from en4dvar.twin_run import twin_summary

        click.echo(twin_summary(loaded))
        return
    from en4dvar.build import build
    from en4dvar.describe import problem_summary

    click.echo(problem_summary(loaded, build(loaded)))


@main.command()
@_config_options
@click.option("--out", type=click.Path(path_type=Path), help="CSV file to write; default standard output.")
@click.option("--times", metavar="FROM:TO:STEP", help="Instants, e.g. '0 us:60 us:1 us'.")
@click.option("--noise", metavar="STD", help="Add Gaussian noise, e.g. '1.4 um' or '1 % of maximum'.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise; default the configuration's.")
@click.option("--force", is_flag=True, help="Replace the file given by --out.")
def simulate(
    config: str,
    data: str | None,
    settings: tuple[str, ...],
    out: Path | None,
    times: str | None,
    noise: str | None,
    seed: int | None,
    force: bool,
) -> None:
    """Run the model once and write the observable as CSV: at fixed values and prior medians.

    Set parameters with --set; the columns are those of the configuration's data section.
    A configuration with a 'campaign:' section instead draws truths and writes a folder of data sets.

    \b
    Example:
      en4dvar simulate configs/quickstart.yaml --set parameters.G='0.5 kPa' \\
          --times '0 us:60 us:1 us' --noise '1.4 um' --out synthetic.csv
    """
    if _has_campaign(config):
        if data or times or noise:
            raise click.UsageError("--data, --times and --noise do not apply to a configuration with a 'campaign:'")
        _simulate_campaign(config, settings, out, seed, force)
        return
    loaded = _load(config, data, settings)
    from en4dvar.errors import OutputError
    from en4dvar.files import write_text
    from en4dvar.simulation import noise_level, parse_times, simulate, to_csv

    if out is not None and out.exists() and not force:
        raise OutputError(f"{out}: exists; give --force to replace it")
    instants = parse_times(times, loaded.model.time_unit) if times else None
    simulation = simulate(loaded, instants)
    if noise:
        simulation = simulation.with_noise(
            noise_level(noise, loaded, simulation), loaded.seed if seed is None else seed
        )
    text = to_csv(simulation, loaded, shlex.join(["en4dvar", *sys.argv[1:]]))
    if out is None:
        click.echo(text, nl=False)
    else:
        write_text(out, text)


def _has_campaign(config: str) -> bool:
    from en4dvar.config.document import read_document

    return "campaign" in read_document(Path(config)).data


def _simulate_campaign(config: str, settings: tuple[str, ...], out: Path | None, seed: int | None, force: bool) -> None:
    from en4dvar.config.document import override, read_document
    from en4dvar.config.synthetic import relocated, resolve_campaign
    from en4dvar.synthetic import draw_campaign, write_campaign

    changes = _overrides(None, settings, seed=seed)
    plan = resolve_campaign(override(read_document(Path(config)), changes), Path(config).resolve().parent)
    plan = relocated(plan, out) if out else plan
    sets = draw_campaign(plan)
    truth = write_campaign(plan, sets, shlex.join(["en4dvar", *sys.argv[1:]]), force)
    fits = [s.nrmse for s in sets]
    click.echo(
        f"{len(sets)} synthetic data sets, NRMSE of the truth {min(fits):.3f} to {max(fits):.3f}; truth: {truth}"
    )


@main.command()
@click.argument("run_dir", type=click.Path(path_type=Path))
def report(run_dir: Path) -> None:
    """Write the report and figures of a finished run again, from its netCDF files.

    \b
    Example:
      en4dvar report runs/quickstart
    """
    from en4dvar.runner import report as write_report

    click.echo(f"report: {write_report(run_dir)}")


@main.command()
@click.argument("run_dirs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR RUN_DIR...")
def compare(run_dirs: tuple[Path, ...]) -> None:
    """Compare models on the same data: evidence, model probabilities, fit, information.

    \b
    Example:
      en4dvar compare runs/neo_hookean runs/quadratic
    """
    from en4dvar.compare import compare, comparison_table

    click.echo(comparison_table(compare(run_dirs)))


@main.command()
def models() -> None:
    """List the models with their observables, parameters, units and settings.

    \b
    Example:
      en4dvar models | less
    """
    from en4dvar.listing import model_listing

    click.echo(model_listing())


if __name__ == "__main__":
    main()
