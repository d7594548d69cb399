"""What a run tells while it runs: one line an iteration in ``run.log``, a live line on a terminal."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from en4dvar.diagnosis.analysis import ChainRecord, Descents, IterationRecord, Record, StartRecord
from en4dvar.model.state import Parameter
from en4dvar.plumbing.compiled import watch_compilation
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import own_file, refused
from en4dvar.plumbing.hints import duration, short
from en4dvar.plumbing.tables import without_control
from en4dvar.plumbing.units import convert
from en4dvar.runs.interrupt import Interrupted

TYPICAL_ITERATIONS = 8.0
LONGEST_NAME = 24  # of a data set in the live line
WIDE = 110  # columns of a terminal that has room for a bar


WORDS: dict[type[Record], tuple[str, str]] = {  # of the log, of the live line
    StartRecord: (
        "{stage}, round {r.rounds:2d}  lowest J {lowest:.6g}  of {count} descents  under way {r.active}",
        "{stage}, round {r.rounds} of {count} descents: lowest J {lowest:.4g}",
    ),
    Descents: ("{r.words}", "{r.words}"),
    ChainRecord: (
        "chain, {r.steps:4d} steps  R-hat {r.r_hat:.3f}  effective sample size {r.effective:.0f}",
        "chain of {r.steps} steps: R-hat {r.r_hat:.3f}, {r.effective:.0f} independent draws",
    ),
    IterationRecord: (
        "iteration {r.iteration:2d}  J {r.cost:.6g} = {r.background:.4g} + {r.observation:.6g}  "
        "|dw| {r.step_norm:.2e}  step {r.step_length:.3g}  chi2/K {r.chi2_per_observation:.3g}  "
        "DFS {r.dfs:.2f}  active {r.active}",
        "iteration {r.iteration}: J {r.cost:.4g}, χ²/K {r.chi2_per_observation:.3g}, step {r.step_length:.2g}",
    ),
}


def describe(name: str, record: Record) -> str:
    """An iteration in one line: J and its terms, step, fit, information, members alive; or where start or chain are."""
    return f"{name}: {_words(record, 0)}"


def _words(record: Record, place: int) -> str:
    more: dict[str, Any] = {}
    if isinstance(record, StartRecord):
        stage = "search for another minimum" if record.further else "start"
        more = {"stage": stage, "lowest": min(record.costs), "count": len(record.costs)}
    return WORDS[type(record)][place].format(r=record, **more)


def intervals(name: str, record: Record, parameters: Sequence[Parameter]) -> str:
    """A second line for an iteration: median and middle 90 % of each parameter, ``G 7.8 (4.1 to 11) kPa``; or ""."""
    if not isinstance(record, IterationRecord) or not len(record.members):
        return ""
    words = []
    for p, values in zip(parameters, record.members.T, strict=False):  # cells of fields come after the parameters
        low, middle, high = (
            f"{v:.4g}" for v in convert(np.nanquantile(values, (0.05, 0.5, 0.95)), p.unit, p.display_unit)
        )
        words.append(f"{p.name} {middle} ({low} to {high}) {p.display_unit}")
    return f"\n{name}: iteration {record.iteration:2d}  90 %: {', '.join(words)}" if words else ""


@contextmanager
def run_log(path: Path, append: bool = False) -> Iterator[Callable[[str], None]]:
    """Within, what appends every line of a message to ``run.log`` with the time of day, at once, so that a killed run
    leaves what it knew; at the end why the block was left, where it raised. Raises :class:`OutputError` where the file
    cannot be opened or, while the run is at work, written.
    """
    with refused(path, "cannot be written"):
        handle = own_file(path)
        if not append:
            os.ftruncate(handle, 0)
        file = os.fdopen(handle, "a", encoding="utf-8", errors="backslashreplace", buffering=1)

    def write(message: str) -> None:
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        with refused(path, "cannot be written"):
            file.write("".join(f"{now} {without_control(line)}\n" for line in message.splitlines()))

    try:
        yield write
    except BaseException as error:
        words = f"failed: {type(error).__name__}: {error}"
        if isinstance(error, KeyboardInterrupt):
            words = str(error) if isinstance(error, Interrupted) else "interrupted"
        with suppress(OutputError, OSError):  # on a full disk: the reason that ended the run is told all the same
            write(words)
        raise
    finally:
        with suppress(OSError):
            file.close()


class LiveProgress:
    """One line on a terminal: the iteration that ended last, data sets done, time gone and left."""

    def __init__(self, bar: Any):
        self._bar = bar
        self._task = bar.add_task("prior forecast", total=None, left="")
        self._began = time.monotonic()
        self._total = 0  # data sets of the run
        self._before = self._done = 0  # those that an earlier run had done; that are done
        self._open: dict[str, int] = {}  # data set → its last iteration
        self._lengths: list[int] = []  # iterations of the data sets that have ended

    def __call__(self, name: str, record: Record) -> None:
        if isinstance(record, StartRecord | IterationRecord):
            self._open[name] = record.rounds if isinstance(record, StartRecord) else record.iteration
        self._show(f"{short(name, LONGEST_NAME)} {_words(record, 1)}")

    def compiling(self) -> None:
        """The model is being compiled, which later runs are spared."""
        self._show("first use of this model: compiling, once")

    def begin(self, done: int, total: int) -> None:
        """Of ``total`` data sets ``done`` were done by an earlier run."""
        self._before, self._done, self._total = done, done, total
        self._show(None)

    def ended(self, name: str, done: int, words: str = "") -> None:
        """A data set has ended, of several with one line of ``words``; ``done`` are done now."""
        if words and self._total > 1:
            self._bar.console.print(without_control(f"{name}: {words}"), markup=False, highlight=False, soft_wrap=True)
        if name in self._open:
            self._lengths.append(self._open.pop(name))
        self._done = done
        self._show("files and report" if done == self._total else None)

    def _show(self, description: str | None) -> None:
        description = description and without_control(description)
        gone, done, total = time.monotonic() - self._began, self._done - self._before, self._total - self._before
        left = time_left(gone, done, total, list(self._open.values()), self._lengths)
        fields = {"completed": self._done, "total": self._total or None, "left": left}
        self._bar.update(self._task, **fields, **({"description": description} if description else {}))


def time_left(gone: float, done: int, total: int, iterations: Sequence[int], lengths: Sequence[int]) -> str:
    """``"about 12 s left"``, or nothing where that cannot be told yet.

    ``gone`` seconds were spent on ``done`` of ``total`` data sets and on those at work, which have got to
    ``iterations``. A data set is taken to need as many as the mean of those that ended (``lengths``), else eight.
    """
    expected = sum(lengths) / len(lengths) if lengths else TYPICAL_ITERATIONS
    work = done + sum(min(0.9, i / max(expected, 1.0)) for i in iterations)
    if gone < 1.0 or work <= 0 or done >= total:
        return ""
    return f"about {duration(max(1, round(gone * (total - work) / work)))} left"


@contextmanager
def terminal_progress() -> Iterator[LiveProgress | None]:
    """A live line on the terminal (standard error) or in a notebook, or None where there is neither. NO_COLOR is
    respected. In a notebook rich needs ipywidgets; without it there is no line.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    notebook = Console()
    console = notebook if notebook.is_jupyter and find_spec("ipywidgets") else Console(stderr=True)
    if console is not notebook and (notebook.is_jupyter or not console.is_terminal):
        yield None
        return
    wide = [BarColumn(20)] if console.width >= WIDE else []
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        *wide,
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with shown(Bar(*columns, console=console, transient=True)) as bar:
        progress = LiveProgress(bar)
        with watch_compilation(progress.compiling):
            yield progress


@contextmanager
def shown(bar: Any) -> Iterator[Any]:
    """Within, a bar of ``rich`` is on the terminal; one that is gone at the end (SIGHUP) ends nothing else."""
    bar.start()
    try:
        yield bar
    finally:
        with suppress(OSError):
            bar.stop()


@contextmanager
def counted(what: str) -> Iterator[Callable[[int, int], None] | None]:
    """A bar on the terminal (standard error) that is told how many of how many are done, or None without a terminal."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with shown(Bar(console=console, transient=True)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total or None)
