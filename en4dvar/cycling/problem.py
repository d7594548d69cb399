"""A series to assimilate: what is known at time zero, what was observed, and how it is assimilated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.cycling.aligned import aligned
from en4dvar.cycling.outcome import SequentialResult, SequentialState
from en4dvar.cycling.sequential import run_sequential
from en4dvar.cycling.series import CycleSeries
from en4dvar.cycling.settings import SequentialSettings
from en4dvar.cycling.start import InitialEnsemble
from en4dvar.executor import Executor
from en4dvar.forward import Observable
from en4dvar.observations import Observations
from en4dvar.schemes.bootstrap_filter import BootstrapFilter
from en4dvar.series import Part, Series
from en4dvar.state import Array

UNEXPECTED = 1.5  # root mean square of normalised innovations that calls for a warning, or its inverse


@dataclass(frozen=True)
class SeriesProblem:
    """``observables`` are the p outputs that ``series`` holds; ``members`` N."""

    start: InitialEnsemble
    observables: tuple[Observable, ...]
    series: CycleSeries
    settings: SequentialSettings
    members: int
    name: str = "series"

    @classmethod
    def of_series(
        cls,
        start: InitialEnsemble,
        series: Sequence[Series],
        settings: SequentialSettings,
        members: int,
        name: str = "series",
    ) -> SeriesProblem:
        """Of readings of one or several observables, each series with its own times. Raises :class:`DataError`."""
        return cls.of(start, series[0].observable, Observations.of_series(series, name=name), settings, members)

    @classmethod
    def of(
        cls,
        start: InitialEnsemble,
        observable: Observable,
        data: Observations,
        settings: SequentialSettings,
        members: int,
    ) -> SeriesProblem:
        """Of a data set; ``observable`` is that of one without parts. Raises :class:`DataError`."""
        whole = Part(observable.name, observable, 0, len(data))
        observables, series = aligned(data, data.parts or (whole,))
        settings = replace(settings, to_end=True, innovations=True, coordinates=start.coordinates)
        return cls(start, observables, series, settings, members, data.name)

    @property
    def without_evidence(self) -> str:
        """Why the densities of the observations do not multiply to an evidence; "" where they do."""
        scheme = self.settings.scheme
        if self.settings.localisation is not None:
            return "its analyses are localised, the covariance of its forecasts is not"
        if scheme.shift > 1:
            return "it assimilates the observations of several times at once"
        if not scheme.cycled or isinstance(scheme, BootstrapFilter):
            return "its scheme knows no Gaussian forecast"
        return ""


@dataclass(frozen=True)
class SeriesResult:
    """What the assimilation made of the series."""

    problem: SeriesProblem
    seed: int
    run: SequentialResult

    @property
    def normalised(self) -> Array:
        """(K, p) innovations over their expected standard deviations, √(forecast + observation variance)."""
        return normalised_innovations(self.problem.series, self.run)

    @property
    def log_evidence(self) -> float:
        """ln p(y) by the forecasts' Gaussians, of one observation time after the other; NaN where there is none."""
        return float("nan") if self.problem.without_evidence else float(np.sum(self.run.evidence))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What keeps a reader from trusting the spread."""
        squares = self.normalised[np.isfinite(self.normalised)] ** 2
        size = float(np.sqrt(squares.mean())) if len(squares) else 1.0
        if size > UNEXPECTED:
            return (
                f"innovations are {size:.2g} times as large as forecast and errors say: the ensemble is too sure of "
                "itself; give model_error, inflation or larger errors",
            )
        if size < 1 / UNEXPECTED:
            return (f"innovations are only {size:.2g} times what forecast and errors say: these are too large",)
        return ()


def normalised_innovations(series: CycleSeries, run: SequentialResult) -> Array:
    """(K, p) innovations over their expected standard deviations, NaN in gaps."""
    return np.asarray((series.values - run.predicted.mean) / np.hypot(run.predicted.std, series.std))


def assimilate_series(
    problem: SeriesProblem,
    seed: int = 0,
    executor: Executor | None = None,
    on_cycle: Callable[[int], None] | None = None,
    resume: SequentialState | None = None,
    keep: Callable[[Callable[[], SequentialState]], None] | None = None,
) -> SeriesResult:
    """Assimilate a series of observations. The same seed gives the same bits for any executor.

    ``on_cycle``, ``resume`` and ``keep`` as for :func:`~en4dvar.cycling.sequential.run_sequential`, its errors too.
    """
    members = problem.start.members(problem.members, seed, exact=True)
    run = run_sequential(
        problem.start.model, problem.observables, members, problem.series, problem.settings, seed, executor, on_cycle,
        resume, keep,
    )  # fmt: skip
    return SeriesResult(problem, seed, run)
