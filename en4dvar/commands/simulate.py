"""``en4dvar simulate``: one forward run, or the data sets of a synthetic campaign."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from en4dvar.commands.common import command_line, config_options, load, overrides


@click.command()
@config_options
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
    loaded = load(config, data, settings)
    from en4dvar.errors import OutputError
    from en4dvar.files import write_text
    from en4dvar.runs.simulation import noise_level, parse_times, simulate, to_csv

    if out is not None and out.exists() and not force:
        raise OutputError(f"{out}: exists; give --force to replace it")
    instants = parse_times(times, loaded.model.time_unit) if times else None
    simulation = simulate(loaded, instants)
    if noise:
        simulation = simulation.with_noise(
            noise_level(noise, loaded, simulation), loaded.seed if seed is None else seed
        )
    text = to_csv(simulation, loaded, command_line())
    if out is None:
        click.echo(text, nl=False)
    else:
        write_text(out, text)


def _has_campaign(config: str) -> bool:
    from en4dvar.config.document import read_document

    return "campaign" in read_document(Path(config)).data


def _simulate_campaign(config: str, settings: tuple[str, ...], out: Path | None, seed: int | None, force: bool) -> None:
    from en4dvar.config.document import override, read_document
    from en4dvar.config.synthetic import resolve_campaign
    from en4dvar.runs.synthetic import draw_campaign, write_campaign

    changes = overrides(None, settings, seed=seed)
    plan = resolve_campaign(override(read_document(Path(config)), changes), Path(config).resolve().parent)
    plan = replace(plan, directory=out) if out else plan
    sets = draw_campaign(plan)
    truth = write_campaign(plan, sets, command_line(), force)
    fits = [s.nrmse for s in sets]
    click.echo(
        f"{len(sets)} synthetic data sets, NRMSE of the truth {min(fits):.3f} to {max(fits):.3f}; truth: {truth}"
    )
