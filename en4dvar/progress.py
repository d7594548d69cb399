"""What a run tells while it runs: one line an iteration in ``run.log``, a live line on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from en4dvar.errors import OutputError
from en4dvar.problem import IterationRecord

Progress = Callable[[str, IterationRecord], None]


def describe(name: str, record: IterationRecord) -> str:
    """One iteration in one line: J and its terms, step, fit, information, members alive."""
    return (
        f"{name}: iteration {record.iteration:2d}  J {record.cost:.6g} = {record.background:.4g} + "
        f"{record.observation:.6g}  |dw| {record.step_norm:.2e}  step {record.step_length:.3g}  "
        f"chi2/K {record.chi2_per_observation:.3g}  DFS {record.dfs:.2f}  active {record.active}"
    )


class RunLog:
    """``run.log``: time and message, written line by line so that a killed run leaves what it knew.

    Raises :class:`OutputError` where it cannot be opened or, while the run is at work, written.
    """

    def __init__(self, path: Path, append: bool = False):
        try:
            self._file = path.open("a" if append else "w", encoding="utf-8", errors="backslashreplace", buffering=1)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
        self._path = path

    def write(self, message: str) -> None:
        """Append every line of ``message`` with the time of day."""
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        try:
            self._file.writelines(f"{now} {line}\n" for line in message.splitlines())
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with suppress(OutputError, OSError):  # on a full disk: the reason that ended the run is told all the same
            if value is not None:
                self.write(f"failed: {type(value).__name__}: {value}")
        with suppress(OSError):
            self._file.close()


@contextmanager
def terminal_progress(n_datasets: int) -> Iterator[Progress | None]:
    """A live line on the terminal (standard error), or None where there is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("prior forecast", total=n_datasets)
        seen: list[str] = []

        def show(name: str, record: IterationRecord) -> None:
            if name not in seen:
                seen.append(name)
            bar.update(task, completed=len(seen) - 1, description=_short(name, record))

        yield show


@contextmanager
def cycle_progress(cycles: int) -> Iterator[Callable[[int], None] | None]:
    """A bar of assimilation cycles on the terminal (standard error), or None where there is no terminal."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with Bar(console=console, transient=True) as bar:
        task = bar.add_task("cycles", total=cycles)
        yield lambda cycle: bar.update(task, completed=cycle + 1)


def _short(name: str, record: IterationRecord) -> str:
    return f"{name}: iteration {record.iteration}, J {record.cost:.5g}, {record.active} members"
