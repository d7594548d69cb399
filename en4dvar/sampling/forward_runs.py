"""Forward runs of many data sets in one call: control vectors of every set → its predictions."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from en4dvar.ensemble.forecast import as_read, time_shift
from en4dvar.ensemble.members import InitialStates, Reading, out_of_bounds
from en4dvar.executor import Executor, SerialExecutor
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import ConfigError
from en4dvar.problem import InverseProblem

Sets = npt.NDArray[np.intp] | None  # numbers of the data sets meant; all of them by default


class CampaignRuns(Protocol):
    """``values`` and ``weight`` (S, K): observations and β/std², 0 beyond the last observation of a set."""

    values: Array
    weight: Array

    def predictions(self, x: Array, sets: Sets = None) -> Array:
        """(B, S, K) of control vectors (B, S, n), NaN where a run failed; anything finite where ``weight`` is 0."""


class Predictor:
    """F and H of a problem at instants that are not those of its observations."""

    def __init__(self, problem: InverseProblem, executor: Executor | None = None):
        operator = problem.observable.operator
        self.problem, self.executor = problem, executor or SerialExecutor()
        self._initial_states = InitialStates(problem)
        self._reading = Reading((operator,), (), getattr(operator, "batched", False))

    def at(self, x: Array, times: Array) -> Array:
        """(B, M) of control vectors (B, n), each at its own times (B, M) of the model; NaN where a run failed."""
        physical = self.problem.prior.to_physical(x)
        alive, states = self._initial_states(physical, out_of_bounds(self.problem.prior, physical))
        observed = np.full(times.shape, np.nan)
        if len(states):
            outcomes = self.executor.trajectories(self.problem.model, states, times[alive])
            observed[alive] = self._reading.observe(outcomes, times.shape[1])[0][0]
        return np.asarray(as_read(self.problem, physical, observed[None])[0])

    def time_shifts(self, x: Array) -> Array:
        """t_s (B,) of control vectors (B, n)."""
        return time_shift(self.problem, self.problem.prior.to_physical(x))


class ForwardRuns:
    """:class:`CampaignRuns` of data sets with one prior; those that share model and fixed values are run together.

    A set with fewer observations than another is padded with its last instant: a model has to bear one twice.

    Raises
    ------
    ConfigError: priors that differ; observation errors that are not independent, Gaussian and of known std; parameters
        that vary in time.
    """

    def __init__(self, problems: Sequence[InverseProblem], executor: Executor | None = None):
        shape = len(problems), max(len(p.observations) for p in problems)
        self.times, self.values, self.weight = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        alike: dict[object, list[int]] = {}
        for s, p in enumerate(problems):
            o, k = p.observations, len(p.observations)
            if p.prior != problems[0].prior:
                raise ConfigError(f"{o.name}: a population needs one prior")
            if p.varying:
                raise ConfigError(f"{o.name}: a population needs parameters that do not vary in time")
            if o.parts:
                raise ConfigError(f"{o.name}: a population needs one observable, without places")
            if not o.noise.plain or p.has_noise_scale:
                raise ConfigError(f"{o.name}: a population needs independent Gaussian errors of known std")
            self.times[s] = o.times[-1]
            self.times[s, :k], self.values[s, :k], self.weight[s, :k] = o.times, o.values, o.weights / o.std**2
            key = id(p.model), id(p.observable), tuple(sorted(p.fixed.items())), p.perturbations, p.tied
            alike.setdefault(key, []).append(s)
        self.groups = [(Predictor(problems[sets[0]], executor), sets) for sets in alike.values()]

    def predictions(self, x: Array, sets: Sets = None) -> Array:
        """See :class:`CampaignRuns`."""
        chosen = np.arange(len(self.times)) if sets is None else sets
        out = np.empty((len(x), len(chosen), self.times.shape[1]))
        for predictor, members in self.groups:
            here = np.flatnonzero(np.isin(chosen, members))
            if len(here):
                flat = x[:, here].reshape(-1, x.shape[2])
                times = np.tile(self.times[chosen[here]], (len(x), 1)) + predictor.time_shifts(flat)[:, None]
                out[:, here] = predictor.at(flat, times).reshape(len(x), len(here), -1)
        return out


def log_likelihood(runs: CampaignRuns, predictions: Array, sets: Sets = None) -> Array:
    """−½ Σ β (y − m)²/std² (B, S) of predictions (B, S, K) for ``sets``, all by default; −inf where a run failed."""
    chosen = slice(None) if sets is None else sets
    squares = np.sum(runs.weight[chosen] * (runs.values[chosen] - predictions) ** 2, axis=2)
    return np.where(np.isfinite(squares), -0.5 * squares, -np.inf)
