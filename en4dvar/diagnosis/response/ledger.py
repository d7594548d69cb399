r"""The ledger of a posterior: what the path went through where it informed each parameter, e.g. at which strain rates.

A parameter that is one number may stand for something that varies along the path. If it were off by δx_j(τ), a function
of time, readings would be off by ∫ L_kj(τ) δx_j(τ) dτ, and the estimate, one number, by

    δx̂_j = ∫ a_j(τ) δx_j(τ) dτ,     a_j(τ) = Σ_k G_jk L_kj(τ),

G the gain of the whitened innovations: an averaging kernel (Backus & Gilbert 1968, Geophys. J. R. Astr. Soc. 16, 169),
whose integral is the parameter's degrees of freedom for signal but for what acts through the initial state. The share
of |a_j| that falls into a cell of time is the weight of what the path went through there.

L comes from runs that resume the path at the edges of the cells with the parameter changed from there on; neighbours
differ by what the change does within one cell. The reading of an instant is thus credited to all of its past, as it
should: a rebound tells of the viscosity in the collapse before it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.data.noise import Linearisation
from en4dvar.diagnosis.response.what_if import LinearResponse
from en4dvar.ensemble.forecast import clock_of, of_framework
from en4dvar.ensemble.members import EVERYONE, InitialStates, Reading, Readout, batched, operators_of
from en4dvar.executor.base import without_warnings
from en4dvar.model.forward import Failure, PathQuantity, Trajectory
from en4dvar.model.state import READING_SCALE, Array
from en4dvar.plumbing.user_code import reason_of
from en4dvar.problem import InverseProblem

CELLS = 32  # M, of the path in time; narrow where its quantities change
FINE = 20  # points of a cell at which the path is read
CHANGE = 0.1  # posterior standard deviations of the change of a parameter
QUANTILES = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class Ledger:
    """P parameters, M cells of time, V quantities of the path, at the centre of the posterior.

    ``edges`` (M + 1,) of the cells in the model's time; ``values`` (V, M), the mean size of each quantity in a cell;
    ``kernel`` (P, M), a_j integrated over each cell; ``runs`` (parts of) forward runs it took. NaN where a run failed.
    """

    parameters: tuple[str, ...]
    quantities: tuple[PathQuantity, ...]
    edges: Array
    values: Array
    kernel: Array
    runs: int

    @property
    def weights(self) -> Array:
        """(P, M), the share of each cell; rows sum to one, NaN where nothing on the path informs the parameter."""
        size = np.abs(self.kernel)
        total = size.sum(axis=1, keepdims=True)
        return np.asarray(np.divide(size, total, out=np.full_like(size, np.nan), where=total > 0))

    @property
    def quantiles(self) -> Array:
        """(P, V, 3): the :data:`QUANTILES` of each quantity under the weights of each parameter."""
        return np.array([[weighted_quantiles(v, w) for v in self.values] for w in self.weights])


def weighted_quantiles(values: Array, weights: Array, levels: Sequence[float] = QUANTILES) -> Array:
    """The quantiles of values (M,) with weights (M,) that sum to one, on the line through the middles of the weights of
    neighbours; NaN where a weight is.
    """
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    known = np.isfinite(share).all()
    return np.interp(levels, share, values[order]) if known else np.full(len(levels), np.nan)


def ledger(problem: InverseProblem, response: LinearResponse, std: Array) -> Ledger | None:
    """The ledger of a posterior with standard deviations ``std`` (n,), transformed, in this process.

    None where the model names no quantities of its path, none of its path parameters is estimated, or it cannot be run
    like this: a model may fail in any way, and the posterior is there already.
    """
    names = tuple(name for name in problem.prior.names if name in problem.model.path_parameters)
    if not names or not problem.model.path_quantities or not response.defined or not np.all(std > 0):
        return None
    try:
        with without_warnings():
            return _ledger(problem, response, std, names)
    except BaseException as error:
        reason_of(error)  # an interrupt is one
        return None


def _ledger(problem: InverseProblem, response: LinearResponse, std: Array, names: tuple[str, ...]) -> Ledger | None:
    model, prior = problem.model, problem.prior
    physical = prior.to_physical(response.at)
    alive, start, _ = InitialStates(problem)(physical[None])
    (rate,), (shift,) = clock_of(problem, physical[None])
    scale = float(of_framework(problem, physical[None], READING_SCALE, 1.0)[0]) if problem.has_reading_scale else 1.0
    times = rate * problem.observations.times + shift
    path = None if alive is not EVERYONE else _path(problem, start, float(times.max()))
    if path is None:
        return None
    edges, states, values = path
    columns = [prior.names.index(name) for name in names]
    moved = response.at + CHANGE * np.diag(std)[columns]
    changes = [
        (model.layout[name].start, prior.to_physical(x)[j]) for name, j, x in zip(names, columns, moved, strict=True)
    ]
    local = _localised(problem, states[:-1], edges[:-1], (rate, shift), changes)
    local = scale * local / (CHANGE * std[columns])[:, None, None]
    kernels = (gain @ _whitened(response, of) for gain, of in zip(response.gain[columns], local, strict=True))
    kernel = np.stack(list(kernels))
    return Ledger(names, model.path_quantities, edges, values, kernel, 2 + (len(names) + 1) * (len(edges) - 1))


def _path(problem: InverseProblem, start: Array, end: float) -> tuple[Array, Array, Array] | None:
    """Edges (M + 1,) of the cells, states there (M + 1, n_state), sizes (V, M) of the quantities there."""
    model = problem.model
    even = np.linspace(0.0, end, CELLS * FINE + 1)
    (first,) = model.trajectories(start, even)
    if isinstance(first, Failure):
        return None
    # Edges (M + 1,) of cells with equal shares of the time and of the variation of each quantity (V, T)
    variation = np.abs(np.diff(np.stack([first[q.name] for q in model.path_quantities]), axis=1))
    total = variation.sum(axis=1, keepdims=True)
    variation = np.divide(variation, total, out=np.zeros_like(variation), where=total > 0)
    density = np.diff(even) / (even[-1] - even[0]) + variation.mean(axis=0)
    spent = np.concatenate([[0.0], np.cumsum(density)])
    edges = np.asarray(np.interp(np.linspace(0, spent[-1], CELLS + 1), spent, even))
    share = np.arange(CELLS * FINE) / FINE
    fine = np.append(np.interp(share, np.arange(CELLS + 1), edges), edges[-1])
    (path,) = model.trajectories(start, fine)
    if not isinstance(path, Trajectory):
        return None
    sizes = np.abs(np.stack([path[q.name] for q in model.path_quantities]))
    means = 0.5 * (sizes[:, 1:] + sizes[:, :-1])
    return edges, path.states[::FINE], means.reshape(len(means), CELLS, FINE).mean(axis=2)


def _localised(
    problem: InverseProblem, states: Array, start: Array, clock: tuple[float, float], changes: list[tuple[int, float]]
) -> Array:
    """The change of predictions (P, M, K) by each change (column of the state, value) within each cell. ``states`` (M,
    n_state) of the path at ``start`` (M,) of each cell; readings are made on a ``clock`` of that rate
    and shift.
    """
    n_cells, variants = len(states), [states]
    for column, value in changes:
        changed = states.copy()
        changed[:, column] = value
        variants.append(changed)
    x = np.concatenate(variants)
    begin = np.tile(start, len(variants))
    (rate, shift), (instants, rows) = clock, problem.observations.instants
    times = rate * problem.observations.times + shift
    outcomes = problem.model.resumed(x, begin, np.broadcast_to(rate * instants + shift, (len(x), len(instants))))
    readout = Readout(operators_of(problem.parts), problem.parts, rows, slice(0, 0))
    read = Reading((readout,), (), batched(problem)).observe(outcomes, len(times))[0][0]
    runs = read.reshape(len(variants), n_cells, len(times))
    later = np.where(times > start[:, None], runs[1:] - runs[0], 0.0)  # changed from the start of each cell on
    later[:, 0] = runs[1:, 0] - runs[0, 0]  # readings before time zero, where the model has any
    later[:, :-1] -= later[:, 1:].copy()
    return later


def _whitened(response: LinearResponse, anomalies: Array) -> Array:
    """(K', M) of anomalies (M, K) of the predictions."""
    at = response.linear.prediction
    rates = None if at.rates is None else np.zeros_like(anomalies)
    scale = None if at.noise_scale is None else np.zeros(len(anomalies))
    return response.observations.whiten(Linearisation(at, anomalies, rates, scale))[1]
