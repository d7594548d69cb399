"""The composite operator 𝓗: control vectors → predictions, and the cost and posterior density built on it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from en4dvar.data.noise import Predicted, sides_of
from en4dvar.ensemble.members import NOT_FINITE, InitialStates, Reading, Readout, Rows, batched, operators_of
from en4dvar.executor import Executor, SerialExecutor
from en4dvar.model.state import (
    NOISE_SCALE,
    OF_READINGS,
    READING_OFFSET,
    READING_SCALE,
    TIME_SCALE,
    TIME_SHIFT,
    Array,
    Indices,
    Parameter,
)
from en4dvar.plumbing.errors import ConfigError
from en4dvar.problem import InverseProblem

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
WEIGHTS = WEIGHTS / WEIGHTS.sum()
GRID_POINTS = 200  # of a plot
SAME_INSTANT = 1e-9  # of the window: an extra time this close to an observation is read at the observation


@dataclass(frozen=True)
class SpreadRates:
    r"""The rate of an observable that R takes from a path which is not straight while an instant is uncertain.

    A reading at t + δ with δ ~ N(0, T²) differs from m(t) by a variance of T² ṁ² as long as the path is straight over
    T. About the minimum of a collapse it is not: ṁ passes through zero within a hundredth of a frame, so that T |ṁ|
    says that a reading there is as good as one at rest, and J has a pit some nanometres wide at every parameter that
    brings a minimum to a reading. So the rate is the one that has the variance of the path itself,

        ṁ_T² = Var[m(t + δ)] / T²,

    by Gauss–Hermite quadrature with five points, which is exact for polynomials in δ of degree four. T² is the sum of
    the squares of the reading's ``time_std`` and of a/v, where a discrepancy of size a (the median of its prior) grows
    in proportion to the rate beyond v: such a discrepancy is a model that is early or late by a/v. Before the model
    begins the path is taken to stand still.

    ``time_std`` T (K,) of the readings; increasing ``instants``, of which ``at`` (K,) are those of the readings and
    ``nodes`` (5, K) lie about them.
    """

    time_std: Array
    instants: Array
    at: Indices
    nodes: Indices

    def rates(self, values: Array, rates: Array) -> Array:
        """(B, K) from ``values`` (5, B, K) of paths at the nodes; those that are given where T is zero."""
        mean = np.tensordot(WEIGHTS, values, 1)
        variance = np.tensordot(WEIGHTS, (values - mean) ** 2, 1)
        return np.asarray(np.divide(np.sqrt(variance), self.time_std, out=rates.copy(), where=self.time_std > 0))


def spread_rates(problem: InverseProblem) -> SpreadRates | None:
    """None where R needs no rate, or the path is not to be had between the readings, or these are of several series."""
    o = problem.observations
    if not (o.noise.needs_rates and problem.model.dense) or o.parts:
        return None
    time_std = o.noise.time_std
    if np.isfinite(o.noise.grows_beyond):
        name, prior = problem.discrepancy[0].name, problem.prior
        physical = prior.to_physical(prior.mean)
        size = physical[prior.names.index(name)] if name in prior.names else problem.fixed[name]
        time_std = np.hypot(time_std, size / o.noise.grows_beyond)
    beginning = min(0.0, float(o.times[0]))  # a model starts at time zero and need not know what was before
    wanted = np.vstack([o.times, np.maximum(o.times + NODES[:, None] * time_std, beginning)])
    instants, where = np.unique(wanted, return_inverse=True)
    where = where.reshape(wanted.shape)
    return SpreadRates(time_std, instants, where[0], where[1:])


NO_TIMES: Array = np.empty(0)


@dataclass(frozen=True)
class Forecast:
    """Predictions of B members; NaN where a member failed, or the reading is missing.

    ``predicted`` (B, …) at the observations: predictions (B, K), their rates where R depends on them, the noise scale
    and the discrepancy where there is one; ``path`` (B, P M) at the extra times, one after the other for the P parts of
    the observations that have one value at a time (P = 1 of a single observable), ``failures`` (B,) reasons, "" for
    members alive, ``extremes`` (B, V) what the members reached of the model's V limits of validity, ``beyond`` (B, V)
    since when they exceed these, on the clock of the observations (both empty without extra times). ``filled`` is the
    share of the readings that :func:`en4dvar.ensemble.missing.filled` has put in, ``lacking`` are those it could not.
    """

    predicted: Predicted
    path: Array
    failures: tuple[str, ...]
    extremes: Array = field(default_factory=lambda: np.empty((0, 0)))
    beyond: Array = field(default_factory=lambda: np.empty((0, 0)))
    filled: float = 0.0
    lacking: tuple[int, ...] = ()

    @property
    def predictions(self) -> Array:
        """(B, K) at the observations."""
        return self.predicted.values

    @property
    def active(self) -> Array:
        """(B,) bool."""
        return np.array([not reason for reason in self.failures])

    @property
    def partial(self) -> Array:
        """(B,) bool: members that failed for nothing but NaN in some of their readings."""
        failed = np.array([reason == NOT_FINITE for reason in self.failures])
        return np.asarray(failed & np.isfinite(self.predictions).any(axis=1))

    @property
    def lost(self) -> tuple[str, ...]:
        """(B,) the failures of members that have no reading at all, or failed for another reason."""
        return tuple("" if some else reason for some, reason in zip(self.partial, self.failures, strict=True))

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        arrays = self.predicted.values, self.predicted.rates, self.path, self.extremes, self.beyond
        return sum(array.nbytes for array in arrays if array is not None)

    def __len__(self) -> int:
        return len(self.failures)

    def __getitem__(self, members: slice | Indices) -> "Forecast":
        rows = {name: getattr(self, name)[members] for name in ("predicted", "path", "extremes", "beyond")}
        failures = tuple(self.failures[i] for i in np.arange(len(self.failures))[members])
        return replace(self, **rows, failures=failures)


class Composite:
    """𝓗, F then H then the clock of the observations: control vectors → predictions.

    What does not depend on the members is found out once.

    Raises ConfigError: a timing error on an observable without a rate.
    """

    def __init__(self, problem: InverseProblem, executor: Executor | None = None):
        self.problem, self.executor = problem, executor or SerialExecutor()
        self._initial_states = InitialStates(problem)
        self._operators = _operators(problem)
        self._batched = batched(problem)
        self._spread = spread_rates(problem)

    def __call__(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        """:meth:`run`, or what the executor has kept of it."""
        outcome: Forecast = self.executor.once(self.run, x, extra_times)
        return outcome

    def run(self, x: Array, extra_times: Array = NO_TIMES) -> Forecast:
        """Run control vectors ``x`` (B, n; transformed) through F and H.

        Member i is observed at a_i t_k + t_s,i, see :func:`clock_of` and :func:`as_read`. ``extra_times`` (M,), on the
        clock of the observations, are read from the same run. A member fails, without disturbing the others, where a
        parameter leaves its bounds, ``initial_state`` raises, the model returns a :class:`Failure`, or H gives anything
        but finite numbers.
        """
        problem = self.problem
        times, reading, size, at_observations, at_extra, at_nodes = self._reading(extra_times)
        named = len(problem.prior.terms)
        physical = problem.prior.to_physical(x[:, :named])
        alive, states, failures = self._initial_states(physical, x[:, named:])
        scale, shift = clock_of(problem, physical)
        shifted = scale[alive, None] * times + shift[alive, None]
        outcomes = self.executor.trajectories(problem.model, states, shifted) if len(states) else ()
        *read, reasons = reading.observe(outcomes, size)
        observed = np.full((len(reading.quantities), len(x), size), np.nan)
        limits = np.full((len(x), len(reading.limits), 2), np.nan)
        observed[:, alive], limits[alive] = read
        for i, reason in zip(np.arange(len(x))[alive], reasons, strict=True):
            failures[i] = reason
        observed = as_read(problem, physical, observed)
        rates = self._rates(observed, at_observations, at_nodes) if len(observed) > 1 else None
        predicted = with_errors(problem, physical, observed[0][:, at_observations], rates)
        extremes, beyond = limits[..., 0], (limits[..., 1] - shift[:, None]) / scale[:, None]
        return Forecast(predicted, observed[0][:, at_extra], tuple(failures), extremes, beyond)

    def _rates(self, observed: Array, at: Rows, nodes: Rows) -> Array:
        rates: Array = observed[1][:, at]
        return rates if self._spread is None else self._spread.rates(np.moveaxis(observed[0][:, nodes], 1, 0), rates)

    def _reading(self, extra_times: Array) -> tuple[Array, Reading, int, Rows, Rows, Rows]:
        """The instants; what is read there and how many numbers that are; which of them are observations, and curves,
        and the nodes of rates.

        A single observable is read at all instants, and picked from them for all members at once.
        """
        observations = self.problem.observations
        limits = tuple(self.problem.model.validity) if len(extra_times) else ()
        spread = self._spread
        instants, rows = observations.instants if spread is None else (spread.instants, spread.at)
        nodes: Rows = slice(0, 0) if spread is None else spread.nodes
        at_extra: Rows = slice(0, 0)
        times = instants
        if len(extra_times):
            times, at_instants, at_extra = _union(instants, extra_times)
            rows, nodes = at_instants[rows], at_instants[nodes]
        if not observations.parts:
            quantities = tuple(of_parts[0] for of_parts in self._operators)
            return times, Reading(quantities, limits, self._batched), len(times), rows, at_extra, nodes
        readouts = tuple(Readout(operator, observations.parts, rows, at_extra) for operator in self._operators)
        k, curves = len(observations), sum(part.has_path for part in observations.parts)
        size = k + curves * len(extra_times)
        return times, Reading(readouts, limits, self._batched), size, slice(0, k), slice(k, size), nodes


def plotting_times(problem: InverseProblem) -> Array:
    """The instants (M,) of prior and posterior paths in a plot, on the clock of the observations.

    Further ones than the observations are asked for only where the model gives them for next to nothing.
    """
    observations = problem.observations
    return np.linspace(*observations.span, GRID_POINTS) if problem.model.dense else observations.instants[0]


def forecast(
    problem: InverseProblem, x: Array, executor: Executor | None = None, extra_times: Array = NO_TIMES
) -> Forecast:
    """:class:`Composite` of a problem, called once."""
    return Composite(problem, executor)(x, extra_times)


def cost(problem: InverseProblem, x: Array, executor: Executor | None = None) -> Array:
    """J (B,) of control vectors ``x`` (B, n), with the prior's own mean and covariance; +inf where the model fails.

    J = ½ ‖z‖² + Σ_k β_k [½ (y_k − m_k)²/s_k² + ln(s_k/std_k)], z the white coordinates of x: (x_j − mean_j)/std_j
    where no parameters are correlated.
    """
    return costs(problem, x, forecast(problem, x, executor))


def costs(problem: InverseProblem, x: Array, run: Forecast) -> Array:
    """The same, where the ``run`` of ``x`` is there."""
    with np.errstate(over="ignore"):
        return np.where(run.active, problem.prior.cost(x) + problem.observations.cost(run.predicted), np.inf)


def log_posterior(problem: InverseProblem, x: Array, executor: Executor | None = None) -> Array:
    """Log posterior density (B,) in transformed space up to a constant that does not depend on x: −J.

    The dropped constant is that of the prior, ``Prior.log_density`` at its mean, and −Σ β_k ln(std_k √2π).
    """
    return -cost(problem, x, executor)


def check_problem(problem: InverseProblem) -> tuple[Parameter, ...]:
    """The parameters of ``problem.fixed``, in its order.

    Raises ConfigError: a parameter neither fixed nor estimated, both, or unknown to the model; a timing error on an
    observable without a rate.
    """
    if not problem.prior.terms and not problem.fields:
        raise ConfigError("prior: at least one parameter must be estimated")
    perturbed = [p.parameter for p in problem.perturbations]
    discrepancy = problem.discrepancy
    known = {p.name: p for p in (*OF_READINGS, *discrepancy, *perturbed, *problem.model.parameters)}
    estimated, fixed = set(problem.prior.names), set(problem.fixed)
    if unknown := {p.field for p in problem.perturbations} - set(problem.model.layout.names):
        raise ConfigError(f"initial_state: {', '.join(sorted(unknown))}: not a field of the model's state")
    required = {p.name for p in (*discrepancy, *perturbed, *problem.model.parameters)} - {TIME_SHIFT.name}
    tied = {tie.parameter.name for tie in problem.tied}
    for names, message in (
        (required - estimated - fixed - tied, "neither fixed nor estimated"),
        (tied & (estimated | fixed), "tied, and fixed or estimated as well"),
        ({tie.to for tie in problem.tied} - estimated, "not estimated, but others are tied to it"),
        (estimated & fixed, "both fixed and estimated"),
        ((estimated | fixed) - set(known), "not a parameter of the model"),
    ):
        if names:
            raise ConfigError(f"{', '.join(sorted(names))}: {message}")
    for uncertain, parameter in (
        (problem.has_reading_scale, READING_SCALE),
        (problem.has_reading_offset, READING_OFFSET),
    ):
        if uncertain and problem.observations.parts:
            where = f"parameters.{parameter.name}"
            raise ConfigError("cannot be one number for several series or for readings at places", where)
    if problem.has_noise_scale and np.any(sides_of(problem.observations.noise)):
        raise ConfigError("bounds (at_most, at_least) tell no scale of errors; leave sigma out", "parameters.sigma")
    _operators(problem)
    return tuple(known[name] for name in problem.fixed)


def _operators(problem: InverseProblem) -> list[tuple[Callable[[Any], Array], ...]]:
    """H of every part, and its rate where R depends on it. Raises :class:`ConfigError` where there is no rate."""
    parts, noise = problem.parts, problem.observations.noise
    what = "a timing error" if noise.timed else "a discrepancy that grows with the rate"
    return [operators_of(parts), *([operators_of(parts, what)] if noise.needs_rates else [])]


def as_read(problem: InverseProblem, physical: Array, observed: Array) -> Array:
    """Readings of an observable, and of its rates, (Q, B, M): times ``reading_scale``, plus ``reading_offset``. Rates
    are by the time of the data."""
    if problem.has_time_scale:
        observed = np.concatenate([observed[:1], observed[1:] * clock_of(problem, physical)[0][:, None]])
    if problem.has_reading_scale:
        observed = observed * of_framework(problem, physical, READING_SCALE, 1.0)[:, None]
    if problem.has_reading_offset:
        read = observed[0] + of_framework(problem, physical, READING_OFFSET, 0.0)[:, None]
        observed = np.concatenate([read[None], observed[1:]])
    return observed


def clock_of(problem: InverseProblem, physical: Array) -> tuple[Array, Array]:
    """Scale a and shift t_s (B,) of the times at which members are observed."""
    shift = of_framework(problem, physical, TIME_SHIFT, 0.0)
    if not problem.has_time_scale:
        return np.ones_like(shift), shift
    return of_framework(problem, physical, TIME_SCALE, 1.0), shift


def of_framework(problem: InverseProblem, physical: Array, parameter: Parameter, default: float) -> Array:
    """Values (B,) of a parameter that the framework itself uses."""
    if parameter.name in problem.prior.names:
        return np.asarray(physical[:, problem.prior.names.index(parameter.name)])
    return np.full(len(physical), problem.fixed.get(parameter.name, default))


def with_errors(problem: InverseProblem, physical: Array, values: Array, rates: Array | None) -> Predicted:
    """Predictions ``values`` (B, K), beside the parameters of their errors in physical control vectors (B, n)."""
    scale = of_framework(problem, physical, NOISE_SCALE, 1.0) if problem.has_noise_scale else None
    discrepancy = [of_framework(problem, physical, p, np.nan) for p in problem.discrepancy]
    return Predicted(values, rates, scale, np.stack(discrepancy, axis=1) if discrepancy else None)


def _union(times: Array, extra: Array) -> tuple[Array, Indices, Indices]:
    """Increasing union of the times and where the observations and the extra times stand in it."""
    nearest = times[np.searchsorted(0.5 * (times[1:] + times[:-1]), extra)]
    extra = np.where(np.abs(extra - nearest) <= SAME_INSTANT * (times[-1] - times[0]), nearest, extra)
    union = np.unique(np.concatenate([times, extra]))
    return union, np.searchsorted(union, times), np.searchsorted(union, extra)
