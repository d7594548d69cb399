"""Forward runs of many data sets in one compiled call: coordinates of every set → its predictions."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import numpy as np
import numpy.typing as npt

from en4dvar.errors import ConfigError
from en4dvar.problem import InverseProblem
from en4dvar.state import TIME_SHIFT, Array
from en4dvar_bubble.model import BubbleModel

CHUNK = 128  # trajectories of one call, a thread


class Runs(Protocol):
    """``values`` and ``weight`` (S, K): readings and β/std², 0 beyond the last reading of a set."""

    values: Array
    weight: Array

    def predictions(self, x: Array, sets: npt.NDArray[np.intp] | None = None) -> Array:
        """(B, S, K) of coordinates (B, S, n), NaN where a run failed; anything finite where ``weight`` is 0.

        ``sets``: the data sets meant, all by default.
        """


class SetRuns:
    """:class:`Runs` of data sets with one model and one prior.

    Raises
    ------
    ConfigError: another model than ``bubble``; models, priors or fixed values that differ; observation errors that are
        not independent, Gaussian and of known standard deviation.
    """

    def __init__(self, problems: Sequence[InverseProblem], workers: int = 1):
        first = problems[0]
        if not isinstance(first.model, BubbleModel):
            raise ConfigError("a population needs the model 'bubble'")
        for p in problems:
            o = p.observations
            if p.model is not first.model or p.prior.terms != first.prior.terms or p.fixed != first.fixed:
                raise ConfigError(f"{o.name}: a population needs one model, prior and set of fixed values")
            if not o.noise.plain or "sigma" in p.prior.names:
                raise ConfigError(f"{o.name}: a population needs independent Gaussian errors of known std")
        self.model, self.prior, self.fixed, self.workers = first.model, first.prior, first.fixed, workers
        shape = len(problems), max(len(p.observations) for p in problems)
        self.times, self.values, self.weight = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        for s, p in enumerate(problems):
            o, k = p.observations, len(p.observations)
            self.times[s] = o.times[-1]  # padded: read again, and not counted
            self.times[s, :k], self.values[s, :k], self.weight[s, :k] = o.times, o.values, o.weights / o.std**2

    def predictions(self, x: Array, sets: npt.NDArray[np.intp] | None = None) -> Array:
        """See :class:`Runs`."""
        n_batch, n_sets, n = x.shape
        readings = self.times if sets is None else self.times[sets]
        theta = self.prior.to_physical(x.reshape(-1, n))
        of = dict(zip(self.prior.names, theta.T, strict=True))
        of |= {name: np.full(len(theta), value) for name, value in self.fixed.items()}
        shift = of.get(TIME_SHIFT.name, np.zeros(len(theta)))
        times = np.maximum(np.tile(readings, (n_batch, 1)) + shift[:, None], 0.0)
        out = np.full(times.shape, np.nan)

        def run(begin: int) -> None:
            rows = slice(begin, begin + CHUNK)
            states = self.model.initial_states({p.name: of[p.name][rows] for p in self.model.parameters})
            path = self.model.integrate(states, times[rows])
            out[rows] = np.where(path.solution.status[:, None] == 0, path["R"], np.nan)

        with ThreadPoolExecutor(self.workers) as pool:
            list(pool.map(run, range(0, len(theta), CHUNK)))
        return out.reshape(n_batch, n_sets, -1)


def log_likelihood(runs: Runs, predictions: Array, sets: npt.NDArray[np.intp] | None = None) -> Array:
    """−½ Σ β (y − m)²/std² (B, S) of predictions (B, S, K) for ``sets``, all by default; −inf where a run failed."""
    chosen = slice(None) if sets is None else sets
    squares = np.sum(runs.weight[chosen] * (runs.values[chosen] - predictions) ** 2, axis=2)
    return np.where(np.isfinite(squares), -0.5 * squares, -np.inf)
