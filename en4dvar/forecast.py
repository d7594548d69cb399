"""The composite operator 𝓗: control vectors → predictions, and the cost and posterior density built on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from en4dvar.errors import ConfigError
from en4dvar.executor import Executor, SerialExecutor, describe
from en4dvar.forward import Failure, RateOperator, Trajectory
from en4dvar.likelihood import needs_rate, observation_cost
from en4dvar.problem import InverseProblem
from en4dvar.state import NOISE_SCALE, TIME_SHIFT, Array, Parameter

NO_TIMES: Array = np.empty(0)
SAME_INSTANT = 1e-9  # of the window: an extra time this close to an observation is read at the observation


@dataclass(frozen=True)
class Forecast:
    """Predictions of B members; NaN rows where a member failed.

    ``predictions`` (B, K) at the observations, ``rates`` (B, K) of the observable or None where no observation has a
    timing error, ``path`` (B, M) at the extra times, ``failures`` (B,) reasons, "" for members alive, ``noise_scale``
    (B,) σ of each member or None where it is neither estimated nor fixed, ``extremes`` (B, V) what the members reached
    of the model's V limits of validity (empty without extra times).
    """

    predictions: Array
    rates: Array | None
    path: Array
    failures: tuple[str, ...]
    noise_scale: Array | None = None
    extremes: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def active(self) -> Array:
        """(B,) bool."""
        return np.array([not reason for reason in self.failures])

    def __getitem__(self, members: slice) -> Forecast:
        return Forecast(
            self.predictions[members],
            None if self.rates is None else self.rates[members],
            self.path[members],
            self.failures[members],
            None if self.noise_scale is None else self.noise_scale[members],
            self.extremes[members],
        )


def forecast(
    problem: InverseProblem, x: Array, executor: Executor | None = None, extra_times: Array = NO_TIMES
) -> Forecast:
    """Run control vectors ``x`` (B, n; transformed) through F and H.

    Member i is observed at t_k + t_s,i. ``extra_times`` (M,), on the clock of the observations, are read from the same
    run. A member fails, without disturbing the others, where a parameter leaves its bounds, ``initial_state`` raises,
    the model returns a :class:`Failure`, or H gives anything but finite numbers.

    Raises
    ------
    ConfigError: a timing error on an observable without a rate.
    """
    executor = executor or SerialExecutor()
    observations = problem.observations
    rate_operator = _rate_operator(problem)
    times, at_observations, at_extra = _union(observations.times, extra_times)
    n_members = len(x)
    physical = problem.prior.to_physical(x)
    states, failures = _initial_states(problem, physical)
    outcomes: dict[int, Trajectory | Failure] = {}
    if states:
        alive = list(states)
        shifted = times + _of_framework(problem, physical, TIME_SHIFT, 0.0)[alive, None]
        results = executor.trajectories(problem.model, np.stack(list(states.values())), shifted)
        outcomes = dict(zip(alive, results, strict=True))

    observed = np.full((n_members, len(times)), np.nan)
    rates = None if rate_operator is None else np.full((n_members, len(times)), np.nan)
    limits = problem.model.validity if extra_times.size else ()
    extremes = np.full((n_members, len(limits)), np.nan)
    for i, outcome in outcomes.items():
        if isinstance(outcome, Failure):
            failures[i] = outcome.reason
            continue
        try:
            row = _observe(problem, outcome, rate_operator)
            extremes[i] = [outcome.largest(limit.name) for limit in limits]
        except Exception as error:  # H belongs to the user as well
            failures[i] = describe(error)
            continue
        if row.shape[1:] != times.shape or not np.all(np.isfinite(row)):
            failures[i] = "non-finite prediction" if row.shape[1:] == times.shape else "misshapen prediction"
            continue
        observed[i] = row[0]
        if rates is not None:
            rates[i] = row[1]
    return Forecast(
        observed[:, at_observations],
        None if rates is None else rates[:, at_observations],
        observed[:, at_extra],
        tuple(failures),
        _of_framework(problem, physical, NOISE_SCALE, 1.0) if has_noise_scale(problem) else None,
        extremes,
    )


def has_noise_scale(problem: InverseProblem) -> bool:
    """Whether ``sigma`` is given and scales the observation errors (rather than being the model's own)."""
    own = {p.name for p in problem.model.parameters}
    return NOISE_SCALE.name not in own and NOISE_SCALE.name in {*problem.prior.names, *problem.fixed}


def cost(problem: InverseProblem, x: Array, executor: Executor | None = None) -> Array:
    """J (B,) of control vectors ``x`` (B, n), with the prior's own mean and covariance; +inf where the model fails.

    J = ½ Σ_j ((x_j − mean_j)/std_j)² + Σ_k β_k [½ (y_k − m_k)²/s_k² + ln(s_k/std_k)].
    """
    run = forecast(problem, x, executor)
    observation = observation_cost(problem.observations, run.predictions, run.rates, run.noise_scale)
    with np.errstate(over="ignore"):
        z = (x - problem.prior.mean) / problem.prior.std
        return np.where(run.active, 0.5 * np.sum(z * z, axis=-1) + observation, np.inf)


def log_posterior(problem: InverseProblem, x: Array, executor: Executor | None = None) -> Array:
    """Log posterior density (B,) in transformed space up to a constant that does not depend on x: −J.

    The dropped constant is that of the prior, ``Prior.log_density`` at its mean, and −Σ β_k ln(std_k √2π).
    """
    return -cost(problem, x, executor)


def check_problem(problem: InverseProblem) -> tuple[Parameter, ...]:
    """The parameters of ``problem.fixed``, in its order.

    Raises
    ------
    ConfigError: a parameter neither fixed nor estimated, both, or unknown to the model; a timing error on an
        observable without a rate.
    """
    perturbed = [p.parameter for p in problem.perturbations]
    known = {p.name: p for p in (TIME_SHIFT, NOISE_SCALE, *perturbed, *problem.model.parameters)}
    estimated, fixed = set(problem.prior.names), set(problem.fixed)
    if unknown := {p.field for p in problem.perturbations} - set(problem.model.layout.names):
        raise ConfigError(f"initial_state: {', '.join(sorted(unknown))}: not a field of the model's state")
    required = {p.name for p in (*perturbed, *problem.model.parameters)} - {TIME_SHIFT.name}
    for names, message in (
        (required - estimated - fixed, "neither fixed nor estimated"),
        (estimated & fixed, "both fixed and estimated"),
        ((estimated | fixed) - set(known), "not a parameter of the model"),
    ):
        if names:
            raise ConfigError(f"{', '.join(sorted(names))}: {message}")
    _rate_operator(problem)
    return tuple(known[name] for name in problem.fixed)


def _rate_operator(problem: InverseProblem) -> RateOperator | None:
    """What gives the rate of the observable, or None where no observation has a timing error."""
    if not needs_rate(problem.observations):
        return None
    operator = problem.observable.operator
    if not isinstance(operator, RateOperator):
        raise ConfigError(
            f"a timing error needs the rate of {problem.observable.name}, which the model does not provide"
        )
    return operator


def _initial_states(problem: InverseProblem, physical: Array) -> tuple[dict[int, Array], list[str]]:
    """States (n_state,) of the members that have one, by member, and the reasons (B,) of the others."""
    failures = [""] * len(physical)
    for parameter, values in zip(problem.prior.parameters, physical.T, strict=True):
        low, high = parameter.bounds
        for i in np.flatnonzero(~((values >= low) & (values <= high) & np.isfinite(values))):
            failures[i] = failures[i] or f"{parameter.name} outside [{low:g}, {high:g}] {parameter.unit}"
    alive = [i for i, reason in enumerate(failures) if not reason]
    if not alive:
        return {}, failures
    fixed = {name: np.full(len(physical), float(value)) for name, value in problem.fixed.items()}
    theta = {**fixed, **dict(zip(problem.prior.names, physical.T, strict=True))}
    own = {p.name for p in problem.model.parameters}
    of_model = {name: values for name, values in theta.items() if name in own}

    def build(members: list[int]) -> dict[int, Array]:
        states = np.asarray(problem.model.initial_states({k: v[members] for k, v in of_model.items()}), dtype=float)
        states = _perturbed(problem, states, {k: v[members] for k, v in theta.items()})
        if states.shape != (len(members), problem.model.layout.size) or not np.all(np.isfinite(states)):
            raise ValueError("non-finite or misshapen initial state")
        return dict(zip(members, states, strict=True))

    states: dict[int, Array] = {}
    try:
        return build(alive), failures
    except Exception:  # some member has no state: find out which, one by one
        for member in alive:
            try:
                states |= build([member])
            except Exception as error:  # a model may refuse parameters in any way; the reason is kept
                failures[member] = describe(error)
    return states, failures


def _perturbed(problem: InverseProblem, states: Array, theta: Mapping[str, Array]) -> Array:
    """Initial states (B, n_state) with the perturbations of the control vector; ValueError outside a field's bounds."""
    if not problem.perturbations or states.ndim != 2 or states.shape[1] != problem.model.layout.size:
        return states
    states = states.copy()
    fields = {f.name: f for f in problem.model.layout}
    for perturbation in problem.perturbations:
        where, value = problem.model.layout[perturbation.field], theta[perturbation.parameter.name][:, None]
        states[:, where] = states[:, where] * value if perturbation.relative else states[:, where] + value
        low, high = fields[perturbation.field].bounds
        if not np.all((states[:, where] > low) & (states[:, where] < high)):
            unit = fields[perturbation.field].unit
            raise ValueError(f"perturbed initial {perturbation.field} outside ({low:g}, {high:g}) {unit}")
    return states


def _of_framework(problem: InverseProblem, physical: Array, parameter: Parameter, default: float) -> Array:
    """Values (B,) of a parameter that the framework itself uses, t_s or σ."""
    if parameter.name in problem.prior.names:
        return np.asarray(physical[:, problem.prior.names.index(parameter.name)])
    return np.full(len(physical), problem.fixed.get(parameter.name, default))


def _observe(problem: InverseProblem, trajectory: Trajectory, rate_operator: RateOperator | None) -> Array:
    """Predictions and, where needed, rates, (1 or 2, K)."""
    rows = [np.asarray(problem.observable.operator(trajectory), dtype=float)]
    if rate_operator is not None:
        rows.append(np.asarray(rate_operator.rate(trajectory), dtype=float))
    return np.stack(rows)


def _union(times: Array, extra: Array) -> tuple[Array, npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Increasing union of the times and where the observations and the extra times stand in it."""
    nearest = times[np.abs(extra[:, None] - times).argmin(axis=1)]
    extra = np.where(np.abs(extra - nearest) <= SAME_INSTANT * (times[-1] - times[0]), nearest, extra)
    union: Array = np.unique(np.concatenate([times, extra]))
    return union, np.searchsorted(union, times), np.searchsorted(union, extra)
