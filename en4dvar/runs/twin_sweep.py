"""A twin experiment for several settings and seeds: a run each, and a table of what they reach.

Settings are compared on the same truths and observations, which depend on the seed and the ``twin:`` section alone.
Every run is kept as it ends, under what it depends on: more seeds or values find those that are there.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from en4dvar.config import TwinConfig, load_twin
from en4dvar.config.document import parse_document
from en4dvar.executor import Executor, ProcessesExecutor, SerialExecutor, available_cores
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.files import readable
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.report.chart import POINTS, Chart, Panel, Row
from en4dvar.report.paper import on_paper
from en4dvar.report.text import plus_minus
from en4dvar.results.checkpoint import FOLDER, digest
from en4dvar.results.provenance import identity
from en4dvar.runs.engine import KeptUnits, RunKind, Session, Tell, conduct_run, require_some
from en4dvar.series.twin import TwinExperiment, conduct

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STATE = f"{FOLDER}/sweep"
COLOURS = ("prior", "posterior", "background")  # of the estimates


@dataclass(frozen=True)
class TwinRun:
    """What came of one run: (estimate, RMSE, spread) after the burn-in and its warnings, or why it failed."""

    scores: tuple[tuple[str, float, float], ...] = ()
    failure: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class TwinSweep:
    """``values`` of the varied ``keys``, one tuple a setting, and the ``runs`` of each, one a seed."""

    keys: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]
    seeds: tuple[int, ...]
    runs: tuple[tuple[TwinRun, ...], ...]
    directory: Path

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A row a setting and estimate, as for ``pandas.DataFrame``."""
        return [
            dict(zip(self.keys, values, strict=True)) | {"estimate": name} | average
            | {"failed": sum(bool(run.failure) for run in runs), "doubted": sum(bool(run.warnings) for run in runs)}
            for values, runs in zip(self.values, self.runs, strict=True)
            for name, average in averages(runs).items()
        ]  # fmt: skip

    @property
    def doubts(self) -> Iterator[str]:
        """Warnings of the runs, one line for each advice: of how many runs, and of which first."""
        told: dict[str, list[str]] = {}
        for values, runs in zip(self.values, self.runs, strict=True):
            for seed, run in zip(self.seeds, runs, strict=True):
                for words in run.warnings:
                    line = f"{_words(values)}, seed {seed}: {words}"
                    told.setdefault(words.rpartition("; ")[2], []).append(line)
        total = len(self.values) * len(self.seeds)
        return (f"{len(lines)} of {total} runs, the first is {lines[0]}" for lines in told.values())

    def __repr__(self) -> str:
        return f"<TwinSweep of {len(self.values)} settings, {len(self.seeds)} seeds each, in {self.directory}>"

    def summary(self) -> "pd.DataFrame":
        """:attr:`rows` as a table."""
        from en4dvar.plumbing.whole_table import WholeTable

        return WholeTable(self.rows)

    def plot(self) -> "Figure":
        """RMSE of each estimate, with its standard error, over the settings."""
        names = [*map(_words, self.values)]
        panel = Panel(", ".join(self.keys), "RMSE", xticks=range(len(names)), names=names, legend=True)
        for estimate, colour in zip(dict.fromkeys(row["estimate"] for row in self.rows), COLOURS, strict=False):
            at = [i for i, runs in enumerate(self.runs) if estimate in averages(runs)]
            means = [averages(self.runs[i])[estimate] for i in at]
            rmse, error = (np.array([mean[key] for mean in means]) for key in ("rmse", "rmse_error"))
            panel.bars(at, rmse - np.nan_to_num(error), rmse + np.nan_to_num(error), colour)
            panel.dots(at, rmse, colour, 3.0, label=estimate)
        return on_paper(Chart([Row(7 * POINTS, [panel])]))

    def __str__(self) -> str:
        head = [*(key.rpartition(".")[2] for key in self.keys), "estimate", "runs", "RMSE", "spread"]
        lines = [
            [*(_text(row[key]) for key in self.keys), row["estimate"],
             f"{row['runs']}" + "".join(f" ({row[key]} {key})" for key in ("failed", "doubted") if row[key]),
             _with_error(row["rmse"], row["rmse_error"]), _with_error(row["spread"], row["spread_error"])]
            for row in self.rows
        ]  # fmt: skip
        return table([head, *lines])


def averages(runs: Sequence[TwinRun]) -> dict[str, dict[str, float]]:
    """Of each estimate how many ``runs`` did not fail, and the mean of their ``rmse`` and ``spread``, each with its
    standard error; NaN where there are too few. Of a setting whose runs all failed, an empty analysis.
    """
    names = dict.fromkeys(name for run in runs for name, _, _ in run.scores) or {"analysis": None}
    means = {}
    for name in names:
        both = np.array([numbers for run in runs for own, *numbers in run.scores if own == name]).reshape(-1, 2)
        n = len(both)
        mean = both.mean(axis=0) if n else np.full(2, np.nan)
        error = both.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.full(2, np.nan)
        means[name] = {"runs": n, "rmse": float(mean[0]), "rmse_error": float(error[0]),
                       "spread": float(mean[1]), "spread_error": float(error[1])}  # fmt: skip
    return means


def sweep_twin(
    config: str | Path | Mapping[str, Any],
    vary: Mapping[str, Sequence[Any] | str],
    seeds: int = 5,
    *,
    overrides: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    workers: int | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
    command: str = "",
) -> TwinSweep:
    """Conduct a twin experiment with every combination of values, each for ``seeds`` seeds from that of the file on.

    Writes ``sweep.csv`` (averages) and ``runs.csv`` (every run) to ``out``, by default runs/<name>_sweep.

    ``vary``: dotted key → its values, a list, or text that is one in YAML. ``overrides``: as of :func:`en4dvar.run`.
    ``workers``: processes, by default one a core; the numbers do not depend on it. ``resume``: take over the finished
    runs that are in ``out``; seeds and values may have been added at the end. ``progress``: called with the number of
    runs that are done and of all.

    Raises :class:`ConfigError`: a setting is at fault, before any run. :class:`OutputError`: ``out`` cannot be used.
    """
    values = {key: _values(key, choices) for key, choices in vary.items()}
    if not values or seeds < 1:
        raise ConfigError("a sweep takes at least one key to vary, with its values, and at least one seed")
    combinations = tuple(product(*values.values()))
    configs = [load_twin(config, {**(overrides or {}), **dict(zip(values, c, strict=True))}) for c in combinations]
    first = configs[0]
    all_seeds = tuple(range(first.seed, first.seed + seeds))
    path = Path(out) if out else first.directory.with_name(f"{first.directory.name}_sweep")
    first = replace(first, directory=path)
    kind = SweepKind(first, configs, tuple(values), combinations, all_seeds, workers, progress)
    return conduct_run(kind, force, resume, command)


@dataclass(frozen=True)
class SweepKind(RunKind[TwinSweep]):
    """A twin experiment in several settings (``configs``), each for several ``seeds``: a unit of work each."""

    name = "sweep-twin"
    units = "finished runs"
    result = "sweep.csv"
    readers = ()
    files = (result, "runs.csv", STATE)

    config: TwinConfig
    configs: Sequence[TwinConfig]
    keys: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]
    seeds: tuple[int, ...]
    workers: int | None
    progress: Tell | None

    def executor(self) -> Executor:
        """Processes: a cycle is more of the interpreter than of the model, also where that is compiled."""
        workers = self.workers or available_cores()
        return SerialExecutor() if workers == 1 else ProcessesExecutor(workers)

    def conduct(self, run: Session, executor: Executor) -> TwinSweep:
        runs, n = self._runs(run, executor), len(self.seeds)
        require_some("runs", [twin.failure for twin in runs])
        of_settings = tuple(tuple(runs[i : i + n]) for i in range(0, len(runs), n))
        sweep = TwinSweep(self.keys, self.values, self.seeds, of_settings, self.config.directory)
        rows = sweep.rows
        write_csv(run.directory.at("sweep.csv"), [[*rows[0]], *([*map(_text, row.values())] for row in rows)])
        write_csv(run.directory.at("runs.csv"), runs_table(sweep))
        return sweep

    def _runs(self, session: Session, executor: Executor) -> list[TwinRun]:
        """One a seed, setting by setting; those that are there are taken over."""
        settings = [(c.experiment, identity(c.resolved, c.experiment.model, {}).settings) for c in self.configs]
        jobs = [(experiment, seed) for experiment, _ in settings for seed in self.seeds]
        marks = [digest(f"{text}\nseed of the run: {seed}".encode()) for _, text in settings for seed in self.seeds]
        words = [f"{_words(values)}, seed {seed}" for values in self.values for seed in self.seeds]
        named = dict(zip(marks, words, strict=True))
        kept = KeptUnits(session, STATE, TwinRun, "all runs are conducted again")
        kept.work(
            executor, _one, dict(zip(marks, jobs, strict=True)), self.progress,
            failed=lambda *_, reason: TwinRun(failure=readable(reason)),
            line=lambda mark, run: f"{named[mark]}: {run.failure or 'done'}",
        )  # fmt: skip
        return [kept.done[mark] for mark in marks]


def _one(experiment: TwinExperiment, seed: int) -> TwinRun:
    result = conduct(experiment, seed)
    scores = tuple((name, score.mean_rmse, score.mean_spread) for name, score in result.scores.items())
    return TwinRun(scores, warnings=result.warnings)


def _values(key: str, choices: Sequence[Any] | str) -> tuple[Any, ...]:
    """The values of a key. Raises :class:`ConfigError`."""
    if key == "seed":
        raise ConfigError("--vary seed: all settings have the same seeds, as many as --seeds says, from the file's on")
    if isinstance(choices, str):
        choices = parse_document(f"values: {choices}", f"--vary {key}").data["values"]
    if not isinstance(choices, list | tuple) or not choices:
        raise ConfigError(f"--vary {key}: give a list of values, e.g. --vary '{key}=[1.01, 1.05]'")
    if again := [choice for i, choice in enumerate(choices) if choice in choices[:i]]:
        raise ConfigError(f"--vary {key}: {again[0]} occurs twice; further runs of a setting are further --seeds")
    return tuple(choices)


def runs_table(sweep: TwinSweep) -> Iterator[list[str]]:
    """A line a run and estimate, below their heads."""
    yield [*sweep.keys, "seed", "estimate", "rmse", "spread", "failure", "warnings"]
    for values, runs in zip(sweep.values, sweep.runs, strict=True):
        own = [_text(value) for value in values]
        for seed, run in zip(sweep.seeds, runs, strict=True):
            doubts = "; ".join(run.warnings)
            for name, rmse, spread in run.scores:
                yield [*own, str(seed), name, repr(rmse), repr(spread), "", doubts]
            if run.failure:
                yield [*own, str(seed), "", "", "", run.failure, ""]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)


def _words(values: Sequence[Any]) -> str:
    return ", ".join(map(_text, values))


def _with_error(value: float, error: float) -> str:
    return plus_minus(value, error) if error > 0 else f"{value:.4g}"
