"""The forward runs of a data set under way, in the order in which they were asked for. Between them nothing is random
and nothing is read, so that an interrupted estimate that begins again asks for the same ones: it is given those that
were kept, makes the others, and comes to the same bits.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from en4dvar.diagnosis.analysis import Progress
from en4dvar.ensemble.forecast import Forecast
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.results.checkpoint import Keeper, digest

LARGEST = 2**27  # bytes of a journal; what follows is run again


@dataclass(frozen=True)
class KnownRuns:
    """``forecasts``, and digests of the arrays (``keys``) that they were made of."""

    keys: tuple[str, ...] = ()
    forecasts: tuple[Forecast, ...] = ()


class StoppedError(Exception):
    """The data set was given up."""


class Journal(Executor):
    """An ``executor`` of forward runs that are not made where they are known from ``before``. ``keeper`` writes them to
    a file, unless this worker does not see its folder. ``stop`` gives the data set up at its next forecast (within one
    process only).
    """

    def __init__(
        self, executor: Executor, before: KnownRuns = KnownRuns(), keeper: Keeper | None = None,
        stop: threading.Event | None = None,
    ):  # fmt: skip
        self.executor, self.workers, self.reads = executor, executor.workers, executor.reads
        self.keys, self.forecasts, self.at = list(before.keys), list(before.forecasts), 0
        self.room = LARGEST - sum(run.nbytes for run in before.forecasts)
        self.keeper, self.stop = keeper, stop

    def untold(self, progress: Progress | None) -> Progress | None:
        """What hears of what follows from the last run that is known on: the rest was told before the interruption."""
        return progress and (lambda name, record: progress(name, record) if self.at >= len(self.keys) else None)

    def once(self, run: Callable[..., Any], *asked: Array) -> Any:
        if self.stop is not None and self.stop.is_set():
            raise StoppedError
        at, key = self.at, digest(b"".join(part.tobytes() for part in asked))
        self.at += 1
        if at < len(self.keys) and self.keys[at] == key:
            return self.forecasts[at]
        del self.keys[at:], self.forecasts[at:]
        forecast = run(*asked)
        if self.keeper and self.keeper.path.parent.is_dir() and at == len(self.keys) and self.room > 0:
            self.keys.append(key)
            self.forecasts.append(forecast)
            self.room -= forecast.nbytes
            self.keeper.keep(lambda: KnownRuns(tuple(self.keys), tuple(self.forecasts)))
        return forecast

    def map(self, *arguments: Any, **named: Any) -> Any:
        return self.executor.map(*arguments, **named)

    def trajectories(self, *arguments: Any) -> Any:
        return self.executor.trajectories(*arguments)

    def close(self) -> None:
        """The executor is closed by who made it."""
