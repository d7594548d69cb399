"""Twin experiments: a truth is drawn and observed, and the assimilation is judged against it.

The truth and every member start from the model's initial state plus independent N(0, initial_std²) in the dynamic
variables; a parameter with a prior is drawn from it, for the truth and for each member. The state that is estimated
includes such parameters. RMSE and spread are over the dynamic variables, which share a unit:

    RMSE_k = √ mean_j (x̄_j − x_j^true)²,   spread_k = √ mean_j σ_j².

Random numbers: one stream for the truth, one for the errors of the observations, one a member.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from en4dvar.data.noise import Correlation
from en4dvar.executor import Executor, SerialExecutor
from en4dvar.model.forward import ForwardModel, Observable, Trajectory
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError, En4dvarError, retold
from en4dvar.priors.prior import member_stream
from en4dvar.series.moments import Moments, SequentialState
from en4dvar.series.problem import SeriesProblem, SeriesResult, assimilate_series
from en4dvar.series.series import CycleSeries
from en4dvar.series.settings import SequentialSettings
from en4dvar.series.start import InitialEnsemble
from en4dvar.series.window import Flow, MembersLost, predictions

OVERCONFIDENT = 0.5  # spread over RMSE of an ensemble that has lost the truth


@dataclass(frozen=True)
class TwinExperiment:
    """``start`` is the prior at time zero, and the model, of the truth and of each member. ``error_std`` is one number
    an observable; ``error_correlation`` (p, p) that of the errors of one instant, None: independent.

    Observations are taken every ``interval`` (the model's time unit); the first ``burn_in`` of ``cycles`` do not count
    in averages.
    """

    start: InitialEnsemble
    sequential: SequentialSettings
    members: int
    cycles: int
    interval: float
    error_std: Mapping[str, float]
    burn_in: int = 0
    error_correlation: Correlation | None = None

    @property
    def model(self) -> ForwardModel:
        """Of the truth and of the members."""
        return self.start.model

    @property
    def observables(self) -> tuple[Observable, ...]:
        """Those of the model that are observed."""
        return tuple(o for o in self.model.observables if o.name in self.error_std)

    @property
    def widths(self) -> list[int]:
        """How many numbers each observable is at an instant, by the state at time zero. Raises :class:`En4dvarError`:
        there is none. :class:`ConfigError`: the correlation of the errors is not that of so many.
        """
        state = self.start.coordinates.to_physical(self.start.drawn([member_stream(0, "truth")]))
        outcome = Trajectory(np.zeros(1), state, self.model.layout)
        widths = [predictions([o], outcome).shape[1] for o in self.observables]
        if self.error_correlation is not None:
            with retold(ValueError, ConfigError, "", "twin.error_correlation"):
                self.error_correlation.check_size(sum(widths))
        return widths

    @property
    def dynamic(self) -> Array:
        """(n_state,) bool: the variables that are not parameters."""
        constant = {p.name for p in self.model.parameters}
        return np.concatenate([np.full(f.size, f.name not in constant) for f in self.model.layout])

    @property
    def times(self) -> Array:
        """(K,) observation times."""
        return np.asarray(self.interval * np.arange(1, self.cycles + 1), dtype=float)


@dataclass(frozen=True)
class Score:
    """RMSE and spread (K,) of one kind of estimate and their means after the burn-in; NaN where there is none."""

    rmse: Array
    spread: Array
    mean_rmse: float
    mean_spread: float


@dataclass(frozen=True)
class TwinResult(SeriesResult):
    """What the assimilation made of the observations of a ``truth`` (K, n_state) at ``series.times``."""

    experiment: TwinExperiment
    truth: Array

    @property
    def scores(self) -> dict[str, Score]:
        """Scores of the forecast, the analysis and (with a lag) the smoothed ensemble."""
        kinds = {"forecast": self.run.forecast, "analysis": self.run.analysis}
        if self.experiment.sequential.smooths:
            kinds["smoothed"] = self.run.smoothed
        return {name: self._score(moments) for name, moments in kinds.items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons why the scores mean less than they seem to."""
        warnings = [*self.of_members]
        fields, start = self.model.layout, self.experiment.start
        names = np.array([f.name for f in fields for _ in range(f.size)])
        hidden = [value for name, value in start.fixed.items() if name not in fields.names]
        still = self.experiment.dynamic & (np.ptp(self.truth, axis=0) == 0)
        if start.prior is None or {*start.prior.names} <= {*fields.names}:
            still &= np.isin(self.truth[0], hidden)
        if still.any():
            warnings.append(
                f"{still.sum()} variables of {', '.join(dict.fromkeys(names[still]))} never change and have the values "
                "of parameters, but count in RMSE and spread; give each parameter in the state a field with its name"
            )
        if alone := int(np.sum(self.run.effective < 2)):
            warnings.append(
                f"in {alone} of {len(self.run.effective)} cycles one member had nearly all of the weight; give more "
                "members, more jitter or larger observation errors"
            )
        score = self.scores["analysis"]
        if score.mean_spread < OVERCONFIDENT * score.mean_rmse:
            ratio = score.mean_spread / score.mean_rmse
            warnings.append(
                f"the spread of the analysis is {ratio:.2g} of its RMSE: the ensemble is far too sure of itself; give "
                "more members, inflation or localisation"
            )
        return tuple(warnings)

    def _score(self, moments: Moments) -> Score:
        where, counted = self.experiment.dynamic, slice(self.experiment.burn_in, None)
        rmse = np.sqrt(np.mean((moments.mean - self.truth)[:, where] ** 2, axis=1))
        spread = np.sqrt(np.mean(moments.std[:, where] ** 2, axis=1))
        known = np.isfinite(rmse[counted])
        means = [float(np.mean(values[counted][known])) if known.any() else float("nan") for values in (rmse, spread)]
        return Score(rmse, spread, *means)


def observe_truth(experiment: TwinExperiment, seed: int) -> tuple[Array, CycleSeries]:
    """The truth (K, n_state) and its observations.

    Raises En4dvarError: the truth cannot be integrated. ConfigError: the correlation of the errors does not fit.
    """
    times, widths = experiment.times, experiment.widths
    states = _truth(experiment, seed)
    exact = predictions(experiment.observables, Trajectory(times, states, experiment.model.layout))
    std = np.repeat([experiment.error_std[o.name] for o in experiment.observables], widths)
    noise = member_stream(seed, "observation error").standard_normal(exact.shape)
    if experiment.error_correlation is not None:
        noise = experiment.error_correlation.correlated(noise)
    each = zip(experiment.observables, widths, strict=True)
    names = [f"{o.name}_{j}" if width > 1 else o.name for o, width in each for j in range(width)]
    return states, CycleSeries(times, exact + std * noise, std, experiment.error_correlation, tuple(names))


def _truth(experiment: TwinExperiment, seed: int) -> Array:
    """(K, n_state), with a model error where the members have one. Raises :class:`En4dvarError`."""
    model, error = experiment.model, experiment.sequential.model_error
    start = experiment.start.drawn([member_stream(seed, "truth")])
    coordinates = experiment.start.coordinates
    times = [0.0, *experiment.times.tolist()]
    if error is not None:
        stream = member_stream(seed, "model error of the truth")
        start = np.hstack([start, stream.standard_normal((1, experiment.cycles * len(error.where)))])
    try:
        flow = Flow(model, experiment.observables, times, SerialExecutor(), coordinates, error)
        path = flow.forecast(start, 0, range(1, len(times)))
    except MembersLost as lost:
        raise En4dvarError(f"the truth cannot be integrated: {lost.reasons[0]}") from None
    return coordinates.to_physical(np.concatenate(path))


def conduct(
    experiment: TwinExperiment,
    seed: int,
    executor: Executor | None = None,
    on_cycle: Callable[[int], None] | None = None,
    resume: SequentialState | None = None,
    keep: Callable[[Callable[[], SequentialState]], None] | None = None,
) -> TwinResult:
    """Draw a truth, observe it, assimilate the observations. The same seed gives the same bits for any executor.

    ``resume`` and ``keep`` as for :func:`~en4dvar.series.sequential.run_sequential`.

    Raises TooFewMembersError: the ensemble is lost. En4dvarError: the truth cannot be integrated.
    """
    truth, series = observe_truth(experiment, seed)
    problem = SeriesProblem(experiment.start, experiment.observables, series, experiment.sequential, experiment.members)
    result = assimilate_series(problem, seed, executor, on_cycle, resume, keep, truth)
    return TwinResult(problem, seed, result.run, experiment, truth)
