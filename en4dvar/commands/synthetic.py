"""Commands that try what could be, from one configuration: ``en4dvar simulate`` (one forward run, or the data sets of a
synthetic campaign), ``calibrate``, ``design`` and ``sweep-twin``.
"""

import os
from pathlib import Path
from typing import Any

import click

from en4dvar.commands.common import Source, config_options, continuable, deliver, echo, parted, tell, workers_option
from en4dvar.commands.plugins import WithForms, asked, loaded


@click.command(cls=WithForms)
@config_options
@click.option("--out", type=click.Path(path_type=Path), help="CSV file to write; default standard output.")
@click.option("--times", metavar="FROM:TO:STEP", help="Instants, e.g. '0 us:60 us:1 us'.")
@click.option("--noise", metavar="STD", help="Add Gaussian noise, e.g. '1.4 um' or '1 % of maximum'.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the noise; default the configuration's.")
@click.option("--force", is_flag=True, help="Replace the files.")
def simulate(
    source: Source, out: Path | None, times: str | None, noise: str | None, seed: int | None, force: bool, **forms: Any
) -> None:
    """Run the model once and write the observable as CSV.

    Parameters have their fixed values, or the medians of their priors. Set parameters with --set; the columns are
    those of the configuration's data section. A configuration with a 'campaign:' section draws truths instead, and
    writes a folder of data sets.

    \b
    Example:
      en4dvar simulate configs/quickstart.yaml --set parameters.G='0.5 kPa' \\
          --times '0 us:60 us:1 us' --noise '1.4 um' --out synthetic.csv
    """
    from en4dvar.commands.common import command_line, refuse_to_replace
    from en4dvar.config.document import override, read_document
    from en4dvar.config.kinds import resolve_campaign
    from en4dvar.plumbing.files import inside
    from en4dvar.results.provenance import portable
    from en4dvar.runs.simulation import draw_campaign, noise_level, parse_times, simulate, to_csv, write_campaign

    others = asked(forms)
    if others and noise and out is None:
        raise click.UsageError("--noise applies to the table: name its file with --out")
    document = read_document(source.path)
    if "campaign" in document.data:
        if source.data or times or noise or others:
            words = ", ".join(["--data", "--times", *(f"--{name}" for name in others)])
            raise click.UsageError(f"{words} and --noise do not apply to a configuration with a 'campaign:'")
        base = source.path.resolve().parent
        plan = resolve_campaign(override(document, source.overrides(seed=seed)), base)
        folder = out or plan.file.campaign.directory
        if not out:  # a folder that came with the configuration may be a link
            inside(base, os.path.relpath(folder, base))
        sets = draw_campaign(plan)
        truth = write_campaign(plan, sets, folder, command_line(), force)
        fits = [s.nrmse for s in sets]
        echo(f"{len(sets)} synthetic data sets, NRMSE of the truth {min(fits):.3f} to {max(fits):.3f}; truth: {truth}")
        return
    config = source.load()
    data = [path for series in (config.data.series if config.data else ()) for path in series.data.path]
    refuse_to_replace(force, out, *(path for _, path, _ in others.values()), read=[source.path, *data])
    instants = parse_times(times, config.model.time_unit) if times else None
    seed = config.seed if seed is None else seed
    for name, (entry, path, settings) in others.items():
        echo(loaded(entry, f"--{name}")(config, instants, path, settings, seed))
    if others and out is None:  # the table was not asked for
        return
    simulation = simulate(config, instants)
    if noise:
        simulation = simulation.with_noise(noise_level(noise, config, simulation), seed)
    deliver(to_csv(simulation, config, portable(command_line())), out, "")


@click.command()
@config_options
@click.option("--sets", type=click.IntRange(min=2), default=200, show_default=True, help="Number of synthetic sets.")
@click.option(
    "--made-with", "made", multiple=True, metavar="KEY=VALUE",
    help="Another value for making the readings, not for the estimates; any number of times."
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder; default runs/<name>_calibration.")
@click.option("--force", is_flag=True, help="Replace an earlier calibration, once this one is complete.")
@click.option("--resume", is_flag=True, help="Continue an interrupted calibration, or add sets.")
@workers_option
def calibrate(source: Source, sets: int, made: tuple[str, ...], workers: int | None, **how: Any) -> None:
    """Test on synthetic data whether the intervals are right.

    Makes data sets from the configuration, estimates them, and tests the ranks of the truths. Truths are drawn from
    the priors, readings from the model with the errors of the file, at the times of its data. If a posterior is
    correct, its 90 % intervals hold nine truths in ten. --made-with makes the readings under another assumption,
    which shows what a wrong one would do. Writes calibration.csv and a page.

    \b
    Example:
      en4dvar calibrate configs/quickstart.yaml --sets 100
    """
    from en4dvar.runs.calibration_run import calibrate as conduct
    from en4dvar.runs.progress import counted

    how |= {"overrides": source.overrides(**{"execution.workers": workers}), "made_with": parted(made, "--made-with")}
    with continuable() as command, counted("sets") as progress:
        result = conduct(source.path, sets, progress=progress, command=command, **how)
    echo(str(result))
    for remark in result.remarks:
        tell(f"note: {remark}")
    echo(f"report: {result.directory / 'calibration.html'}")


@click.command()
@config_options
@click.option(
    "--after", metavar="RUN_DIR", type=click.Path(path_type=Path), help="Finished run whose posterior is the prior."
)
@click.option("--out", type=click.Path(path_type=Path), help="Directory of the result; default runs/<name>_design.")
@click.option("--force", is_flag=True, help="Replace an earlier result in the directory.")
@click.option("--resume", is_flag=True, help="Continue an interrupted comparison, to the same numbers.")
def design(source: Source, **how: Any) -> None:
    """Compare planned experiments by the information they will give.

    The configuration is that of 'run'; its data file need not exist. A 'design:' section says when readings are
    taken, which settings can change, and which parameters are asked about. Writes design.nc, designs.csv and a
    page.

    \b
    Example:
      en4dvar design configs/lotka_volterra_design.yaml
    """
    from en4dvar.report.design import design_table, remarks
    from en4dvar.runs.design_run import run_design
    from en4dvar.runs.progress import counted

    with continuable() as command, counted("designs") as on_design:
        plan, directory = run_design(
            source.path, overrides=source.overrides(), on_design=on_design, on_cost=tell, command=command, **how
        )
    echo(design_table(plan))
    for remark in remarks(plan):
        tell(f"note: {remark}")
    echo(f"report: {directory / 'design.html'}")


@click.command(name="sweep-twin")
@config_options
@click.option(
    "--vary", "varied", multiple=True, required=True, metavar="KEY=[VALUE, …]",
    help="A key and its values; any number of times, for all combinations."
)  # fmt: skip
@click.option(
    "--seeds", type=click.IntRange(min=1), default=5, show_default=True,
    help="Number of seeds per combination, starting with the file's.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the table; default runs/<name>_sweep.")
@click.option("--force", is_flag=True, help="Replace an earlier sweep, once this one is complete.")
@click.option("--resume", is_flag=True, help="Keep finished runs; seeds and values may be added at the end.")
@workers_option
def sweep_twin(source: Source, varied: tuple[str, ...], seeds: int, **how: Any) -> None:
    """Compare settings in twin experiments by RMSE and spread.

    The table has means over seeds, ± standard error. All settings see the same truths and observations. Writes
    sweep.csv and, with every run, runs.csv.

    \b
    Example:
      en4dvar sweep-twin configs/lorenz96_etkf.yaml --vary 'assimilation.scheme=[etkf, esrf, enkf-n]' --seeds 10
    """
    from en4dvar.runs.twin_sweep import sweep_twin as sweep

    vary = parted(varied, "--vary")
    if len(vary) < len(varied):
        raise click.UsageError("--vary: give all values of a key in one list")
    how |= {"overrides": source.overrides(), "progress": lambda done, of: tell(f"{done} of {of} runs")}
    with continuable() as command:
        result = sweep(source.path, vary, seeds, command=command, **how)
    echo(str(result))
    for reason in dict.fromkeys(run.failure for runs in result.runs for run in runs if run.failure):
        tell(f"failed: {reason}")
    for words in result.doubts:
        tell(f"warning: {words}")
    echo(f"averages: {result.directory / 'sweep.csv'}")
