"""A series to assimilate: what is known at time zero, what was observed, and how it is assimilated."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.data.observations import Observations
from en4dvar.data.series import Part, Series
from en4dvar.diagnosis.diagnostics import chi2_interval, common_reasons
from en4dvar.executor import Executor
from en4dvar.model.forward import ForwardModel, Observable
from en4dvar.model.state import Array
from en4dvar.plumbing.hints import counted
from en4dvar.plumbing.units import unit_after
from en4dvar.series.moments import SequentialState
from en4dvar.series.sequential import run_sequential
from en4dvar.series.series import CycleSeries, aligned
from en4dvar.series.settings import SequentialSettings
from en4dvar.series.start import InitialEnsemble

TOO_SURE, TOO_WIDE = 1.2, 1 / 1.5  # root mean square of normalised innovations that is told, beyond chance
LEFT, OFTEN = 0.5, 0.01  # step, in standard deviations, that a limit made the last, and share of cycles, that are told
CHANCE = 3.0  # error over spread of a constant that nothing depends on, that is told


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
    ) -> "SeriesProblem":
        """The problem of readings of observables, each series with its own times. Raises :class:`DataError`."""
        return cls.of(start, series[0].observable, Observations.of_series(series, name=name), settings, members)

    @classmethod
    def of(
        cls,
        start: InitialEnsemble,
        observable: Observable,
        data: Observations,
        settings: SequentialSettings,
        members: int,
    ) -> "SeriesProblem":
        """The problem of a data set; ``observable`` is that of one without parts. Raises :class:`DataError`."""
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
        if not scheme.cycled or scheme.resamples:
            return "its scheme knows no Gaussian forecast"
        return ""


@dataclass(frozen=True)
class SeriesResult:
    """The result of assimilating a series."""

    problem: SeriesProblem
    seed: int
    run: SequentialState

    @property
    def series(self) -> CycleSeries:
        """What was observed."""
        return self.problem.series

    @property
    def model(self) -> ForwardModel:
        """What the ensemble was run with."""
        return self.problem.start.model

    @property
    def normalised(self) -> Array:
        """(K, p) innovations over their expected standard deviations, √(forecast + observation variance), NaN in
        gaps.
        """
        series, predicted = self.series, self.run.predicted
        return np.asarray((series.values - predicted.mean) / np.hypot(predicted.std, series.std))

    @property
    def log_evidence(self) -> float:
        """ln p(y) by the forecasts' Gaussians, of one observation time after the other; NaN where there is none."""
        return float("nan") if self.problem.without_evidence else float(np.sum(self.run.evidence))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons not to trust the spread."""
        told = [*self.of_members, *too_few_at_start(self.problem)]
        size, (low, high) = scatter(self.normalised)
        missed, (_, most) = scatter(self.run.residuals)
        if missed > max(TOO_SURE, most):
            told.append(
                f"residuals of the analyses are {missed:.2g} times the errors: windows have ended in a wrong minimum "
                "of J (give a shorter lag), or model or errors are wrong (give model_error or larger errors)"
            )
        elif size > max(TOO_SURE, high):
            told.append(
                f"innovations are {size:.2g} times as large as forecast and errors say: the ensemble is too sure of "
                "itself; give model_error, inflation or larger errors"
            )
        if size < min(TOO_WIDE, low):
            told.append(f"innovations are only {size:.2g} times what forecast and errors say: these are too large")
        return tuple(told)

    @property
    def of_members(self) -> Iterator[str]:
        """Those of :attr:`warnings` that its members give, whatever was observed."""
        yield from members_lost(self.run, self.problem.members)
        yield from too_few(self.problem)
        yield from narrowed(self.problem, self.run)
        yield from unsettled(self.problem, self.run)


def scatter(normalised: Array) -> tuple[float, Array]:
    """Root mean square of what should have a variance of 1, NaN in gaps, and the interval (2,) of chance."""
    squares = normalised[np.isfinite(normalised)] ** 2
    count = max(1, len(squares))
    interval = np.sqrt(np.array(chi2_interval(float(len(squares)))) / count)
    return float(np.sqrt(squares.mean())) if len(squares) else 1.0, interval


def members_lost(run: SequentialState, members: int) -> Iterator[str]:
    """Where some were: of how many, why and when, and what to do."""
    if run.failures:
        yield (
            f"{len(run.failures)} of {members} members were lost: {common_reasons(run.failures)}; the result holds "
            "only where the model runs: narrow what is uncertain at the start, or find out why the model fails"
        )


def too_few(problem: SeriesProblem) -> Iterator[str]:
    """Where members are fewer than what they must span, and one more: the state that a square root widens by a model
    error, or what a window, of all times at most, estimates, state and model error.
    """
    start, settings, members = problem.start, problem.settings, problem.members
    lag, error = min(settings.scheme.lag, len(problem.series.times)), settings.model_error
    if error is None:
        return
    size = sum(field.size for field in start.model.layout if field.name not in start.fixed)
    if error.form == "square-root" and members <= size:
        yield (
            f"{members} members are fewer than the {size + 1} that a model error by a square root needs ({size} for "
            "the state, and one): a part of it is lost, most of it for a parameter that varies; give more members, or "
            "additive: drawn"
        )
    if lag and settings.localisation is None and members < (needed := size + lag * len(error.where) + 1):
        yield (
            f"{members} members are fewer than the {needed} that a window of {lag} times with model error "
            f"needs ({size} for the state, {len(error.where)} a time, and one): the spread may be far too small; "
            "give more members, or a shorter lag"
        )


def too_few_at_start(problem: SeriesProblem) -> Iterator[str]:
    """Where members are fewer than what is uncertain at the start, and one more, and neither a localisation nor a model
    error gives the analysis further directions. A twin experiment compares its spread with the truth instead.
    """
    settings, size = problem.settings, problem.start.drawn_size
    whole = settings.scheme.cycled and not settings.scheme.resamples
    if whole and settings.localisation is None and settings.model_error is None and problem.members <= size:
        yield (
            f"{problem.members} members are fewer than the {size + 1} that a state of {size} uncertain numbers needs: "
            "what they do not span stays as wrong as it is at the start, unless the model itself forgets it, as a "
            "chaotic one may, and the spread may be far too small; give more members, or localisation"
        )


def unsettled(problem: SeriesProblem, run: SequentialState) -> Iterator[str]:
    """Where cycles ended at the limit of iterations, far from where they would have."""
    count, cycles, worst = int(np.sum(run.left > LEFT)), int(np.sum(run.iterations > 0)), int(np.argmax(run.left))
    if count > OFTEN * cycles:
        yield (
            f"{count} of {counted(cycles, 'cycle')} ended at max_iterations before they had settled, the worst at "
            f"{problem.series.times[worst]:.6g}{unit_after(problem.start.model.time_unit)} with a last step of "
            f"{run.left[worst]:.2g} posterior standard deviations; give a larger max_iterations or, where steps go to "
            "and fro, mda_weights, or a shorter lag"
        )


def narrowed(problem: SeriesProblem, run: SequentialState) -> Iterator[str]:
    """Where perturbed observations make constants too sure: what moves and narrows bystanders is chance alone.

    In each cycle chance takes a share d of the variance P and adds as much to the squared error e²: e² ← e² + d P and
    P ← (1 − d) λ² P. An inflation λ = exp(¾ d) lets P grow by d/2 a cycle, which keeps e² below 2 P.
    """
    start, settings, by = problem.start, problem.settings, run.bystanders
    error, layout = settings.model_error, start.model.layout
    names = [name for name in (start.prior.names if start.prior else ()) if name in layout.names]
    constant = [name for name in names if error is None or not np.any(error.rate[layout[name]])]
    if not (constant and by.size):
        return
    variances = by.var(axis=0, ddof=1)
    if (excess := math.sqrt(np.mean((1 + by.mean(axis=0) ** 2) / variances))) > CHANCE:
        taken = 2 * math.log(settings.inflation.multiplicative) - math.log(variances.mean()) / len(problem.series.times)
        yield (
            f"perturbed observations move and narrow {', '.join(constant)} by chance, cycle by cycle: what no reading "
            f"tells of would be off by {excess:.2g} times its spread; give inflation: "
            f"{math.ceil(1000 * math.exp(0.75 * taken)) / 1000:g}, or more members"
        )


def assimilate_series(
    problem: SeriesProblem,
    seed: int = 0,
    executor: Executor | None = None,
    on_cycle: Callable[[int], None] | None = None,
    resume: SequentialState | None = None,
    keep: Callable[[Callable[[], SequentialState]], None] | None = None,
    truth: Array | None = None,
) -> SeriesResult:
    """Assimilate a series of observations. The same seed gives the same bits for any executor.

    ``on_cycle``, ``resume``, ``keep`` and ``truth`` (K, n_state) as for
    :func:`~en4dvar.series.sequential.run_sequential`, its errors too; members of a twin experiment are independent
    draws, as the truth is.
    """
    members = problem.start.members(problem.members, seed, exact=truth is None)
    run = run_sequential(
        problem.start.model, problem.observables, members, problem.series, problem.settings, seed, executor, on_cycle,
        resume, keep, truth,
    )  # fmt: skip
    return SeriesResult(problem, seed, run)
