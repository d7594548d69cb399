"""``en4dvar simulate``: one forward run, or the data sets of a synthetic campaign."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from en4dvar.commands.common import Source, command_line, config_options, deliver, echo, refuse_to_replace
from en4dvar.commands.plugins import WithForms, asked, write_form


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
    """Run the model once and write the observable as CSV: at fixed values and prior medians.

    Set parameters with --set; the columns are those of the configuration's data section.
    A configuration with a 'campaign:' section instead draws truths and writes a folder of data sets.

    \b
    Example:
      en4dvar simulate configs/quickstart.yaml --set parameters.G='0.5 kPa' \\
          --times '0 us:60 us:1 us' --noise '1.4 um' --out synthetic.csv
    """
    from en4dvar.config.document import read_document
    from en4dvar.runs.simulation import noise_level, parse_times, simulate, to_csv

    others = asked(forms)
    if others and noise and out is None:
        raise click.UsageError("--noise applies to the table: name its file with --out")
    if "campaign" in read_document(source.path).data:
        if source.data or times or noise or others:
            words = ", ".join(["--data", "--times", *(f"--{name}" for name in others)])
            raise click.UsageError(f"{words} and --noise do not apply to a configuration with a 'campaign:'")
        _simulate_campaign(source, out, seed, force)
        return
    config = source.load()
    for path in (out, *(path for path, _ in others.values())):
        refuse_to_replace(path, force)
    instants = parse_times(times, config.model.time_unit) if times else None
    seed = config.seed if seed is None else seed
    for name, (path, settings) in others.items():
        echo(write_form(name, config, instants, path, settings, seed))
    if others and out is None:  # the table was not asked for
        return
    simulation = simulate(config, instants)
    if noise:
        simulation = simulation.with_noise(noise_level(noise, config, simulation), seed)
    deliver(to_csv(simulation, config, command_line()), out, "")


def _simulate_campaign(source: Source, out: Path | None, seed: int | None, force: bool) -> None:
    from en4dvar.config.document import override, read_document
    from en4dvar.config.kinds import resolve_campaign
    from en4dvar.plumbing.files import inside
    from en4dvar.runs.simulation import draw_campaign, write_campaign

    document = override(read_document(source.path), source.overrides(seed=seed))
    base = source.path.resolve().parent
    plan = resolve_campaign(document, base)
    if out:
        plan = replace(plan, directory=out)
    else:  # a folder that came with the configuration may be a link
        inside(base, os.path.relpath(plan.directory, base))
    sets = draw_campaign(plan)
    truth = write_campaign(plan, sets, command_line(), force)
    fits = [s.nrmse for s in sets]
    echo(f"{len(sets)} synthetic data sets, NRMSE of the truth {min(fits):.3f} to {max(fits):.3f}; truth: {truth}")
