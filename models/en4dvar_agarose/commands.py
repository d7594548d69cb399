"""``en4dvar sweep`` and ``en4dvar study``. Heavy imports stay inside the commands."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import click

from en4dvar.commands.common import note_beginning


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
    "--width", type=float, default=3.0, show_default=True, help="Range searched, in prior standard deviations."
)
@click.option("--refine", type=click.IntRange(min=0), default=0, show_default=True, help="Rounds of local refinement.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the results; default runs/<name>_sweep.")
@click.option("--force", is_flag=True, help="Replace an earlier sweep.")
@click.option("--resume", is_flag=True, help="Continue an interrupted sweep.")
@click.option("--workers", type=click.IntRange(min=1), help="Threads; the numbers do not depend on it.")
def sweep(
    configs: tuple[str, ...], settings: tuple[str, ...], data: str | None, trajectories: int, shift: str, step: str,
    width: float, refine: int, out: Path | None, force: bool, resume: bool, workers: int | None,
) -> None:  # fmt: skip
    """Fit every data set by a search over simulations (the paper's IMR approach, NRMSE).

    The design spans the priors of the configuration; the time shift is searched within --shift. Several
    configurations of one model share a design, and each trajectory is computed once for all their data sets.

    \b
    Examples:
      en4dvar sweep configs/agarose_03_qlkv.yaml --refine 4
      en4dvar sweep configs/agarose_03_qlkv.yaml configs/agarose_10_qlkv.yaml --trajectories 200000
    """
    import hashlib

    from en4dvar.config import load_config
    from en4dvar.config.build import build
    from en4dvar.executor import available_cores, make_executor
    from en4dvar.files import inside, write_text
    from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
    from en4dvar.sampling.sweep import SweepSettings, refinement_size, run_sweep
    from en4dvar.units import UnitError, parse_quantity
    from en4dvar_agarose.checkpoints import prepare_folder
    from en4dvar_agarose.run import earliest_reading, one_model
    from en4dvar_agarose.summary import sweep_csv, sweep_text

    if force and resume:
        raise click.UsageError("--force and --resume exclude each other")
    loaded = [load_config(config, _overrides(settings, data)) for config in configs]
    problems = one_model([problem for config in loaded for problem in build(config)])
    try:
        within, grid = (parse_quantity(text, problems[0].model.time_unit) for text in (shift, step))
    except UnitError as error:
        raise click.UsageError(str(error)) from None
    if within < 0 or grid <= 0 or not width > 0:
        raise click.UsageError("--shift must not be negative, --step and --width must be positive")
    chosen = SweepSettings(trajectories, within, grid, width, rounds=refine)
    folder = out or Path("runs") / f"{loaded[0].name}_sweep"
    readings = b"".join(p.observations.times.tobytes() + p.observations.values.tobytes() for p in problems)
    key = hashlib.sha256(f"{[c.resolved for c in loaded]}{chosen}".encode() + readings).hexdigest()
    chunks = prepare_folder(inside(folder, "chunks"), key, "force" if force else "resume" if resume else "new")
    with (
        terminate_as_interrupt(),
        tell_interrupt(lambda: _to_continue(f"finished chunks are kept in {chunks}")),
        _bar(trajectories + refinement_size(chosen, len(problems))) as progress,
        make_executor(problems[0].model, workers or available_cores()) as executor,
    ):
        earliest = earliest_reading(problems[0].model)
        result = run_sweep(problems, chosen, loaded[0].seed, executor, chunks, progress, earliest)
    write_text(folder / "sweep.csv", sweep_csv(result))
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
@click.option("--workers", type=click.IntRange(min=1), help="Threads; the numbers do not depend on it.")
def study(
    config: str, settings: tuple[str, ...], out: Path | None, force: bool, resume: bool, workers: int | None
) -> None:
    """Repeat the paper's study: sweep and En4D-Var, three models, tables, figures, population.

    \b
    Example:
      en4dvar study configs/agarose_study.yaml
    """
    from en4dvar.executor import available_cores
    from en4dvar.runs.interrupt import tell_interrupt, terminate_as_interrupt
    from en4dvar.runs.rundir import RunDirectory
    from en4dvar.storage.checkpoint import FOLDER
    from en4dvar_agarose.checkpoints import StudyCheckpoints
    from en4dvar_agarose.report import write_study
    from en4dvar_agarose.run import run_study
    from en4dvar_agarose.settings import load_study

    if force and resume:
        raise click.UsageError("--force and --resume exclude each other")
    plan = load_study(config, _overrides(settings, None))
    folder = out or Path("runs") / plan.name
    note_beginning(folder, resume)
    with (
        terminate_as_interrupt(),
        RunDirectory.open(folder, "force" if force else "resume" if resume else "new") as directory,
        tell_interrupt(lambda: _to_continue(f"finished parts are kept in {folder}")),
    ):
        before = _times(directory.work)
        keep = StudyCheckpoints.open(directory, plan)
        result = run_study(plan, workers or available_cores(), lambda message: click.echo(message, err=True), keep)
        page = write_study(result, directory.work)
        # What was there before and has not been written since is the user's, unless it is a checkpoint.
        written = (name for name, time in _times(directory.work).items() if before.get(name) != time)
        directory.claim(*sorted({*written, *(name for name in before if name.startswith(f"{FOLDER}/"))}))
        directory.publish()
    for gel, comparison in result.comparisons.items():
        click.echo(f"{gel}: {comparison.undecidable} of {len(comparison.single)} data sets cannot tell the laws apart")
    click.echo(f"report: {folder / page.name}" + (" (synthetic twin, no measurement)" if plan.synthetic else ""))


def _times(folder: Path) -> dict[str, int]:
    """When each file was last written, ns, by its name."""
    files = (p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    return {p.relative_to(folder).as_posix(): p.stat().st_mtime_ns for p in files}


def _to_continue(kept: str) -> str:
    words = [word for word in sys.argv[1:] if word not in ("--force", "--resume")]
    return f"{kept}\nto continue: {shlex.join(['en4dvar', *words, '--resume'])}"


def _overrides(settings: tuple[str, ...], data: str | None) -> dict[str, Any]:
    overrides: dict[str, Any] = {}
    for item in settings:
        key, equals, value = item.partition("=")
        if not equals:
            raise click.BadParameter(f"{item!r} is not KEY=VALUE", param_hint="--set")
        overrides[key.strip()] = value
    return overrides | ({"data.path": [str(Path(data).absolute())]} if data else {})


def _bar(total: int) -> Any:
    """A context that gives a progress callback on a terminal, else None."""
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import Progress

    from en4dvar.runs.progress import shown as on_terminal

    @contextmanager
    def shown() -> Any:
        console = Console(stderr=True)
        if not console.is_terminal:
            yield None
            return
        with on_terminal(Progress(console=console, transient=True)) as bar:
            task = bar.add_task("trajectories", total=total)
            yield lambda done, _: bar.update(task, completed=done)

    return shown()
