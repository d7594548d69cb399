r"""Polynomial stand-ins for the forward model, one a data set, fitted where its likelihood is not negligible.

    m_k(x) ≈ Σ_a c_ka z^a,   z = W (x − x̄),   |a| ≤ degree

Most readings are met to 0.01 µm (acoustic twin, degree 4); one at the very end of the collapse, where the radius has a
cusp in time, is missed by up to 2 µm. The error of each reading adds to its variance, or walkers would take the misses
for good fits. What is left is weighed away with forward runs (``study.population``).
Beyond |z| = 3, six standard deviations from the points, a polynomial can fit readings by chance: there the likelihood
is made to vanish.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from en4dvar.prior import member_stream
from en4dvar.state import Array

REACH = 12.0  # trained on points whose log-density is within this of the best
TRUSTED, WALL = 3.0, 10.0  # of |z|, and what the log-likelihood loses for the square of an excess
RIDGE = 1e-11  # relative: where runs leave a coefficient open


@dataclass(frozen=True)
class Emulators:
    """Of S data sets, n coordinates, at most K readings (padded), M monomials.

    ``centre`` (S, n) and ``whiten`` (S, n, n) define z; ``coefficients`` (S, M, K); ``parents`` (M, 2): monomial j is
    monomial parents[j, 0] times coordinate parents[j, 1] of z; ``values`` (S, K) readings and ``weight`` (S, K)
    1/(std²/β + error²), 0 where there is none.
    """

    centre: Array
    whiten: Array
    coefficients: Array
    parents: np.ndarray
    values: Array
    weight: Array

    def log_likelihood(self, x: Array, sets: npt.NDArray[np.intp] | None = None) -> Array:
        """(B, S) of coordinates (B, S, n) of ``sets``, all by default; up to the constant that the exact one lacks."""
        s = slice(None) if sets is None else sets
        out = np.empty(x.shape[:2])
        _log_likelihoods(
            np.ascontiguousarray(x), self.centre[s], self.whiten[s], self.coefficients[s], self.parents,
            self.values[s], self.weight[s], out,
        )  # fmt: skip
        return out


def monomials(n: int, degree: int) -> np.ndarray:
    """(M, 2) parents of the monomials in n coordinates up to ``degree``, in order of degree; the first is 1."""
    index: dict[tuple[int, ...], int] = {(): 0}
    parents = [(0, 0)]
    for d in range(1, degree + 1):
        for combination in itertools.combinations_with_replacement(range(n), d):
            index[combination] = len(parents)
            parents.append((index[combination[:-1]], combination[-1]))
    return np.array(parents, dtype=np.int64)


def design_matrix(z: Array, parents: np.ndarray) -> Array:
    """Monomials (B, M) of points (B, n)."""
    columns = [np.ones(len(z))]
    for parent, variable in parents[1:]:
        columns.append(columns[parent] * z[:, variable])
    return np.stack(columns, axis=1)


def fit_emulators(
    x: Array,
    predictions: Array,
    log_prior: Array,
    values: Array,
    weight: Array,
    draws: Array,
    degree: int,
    visited: int = 0,
) -> Emulators:
    """Least squares on forward runs, those of high interim posterior density counting more.

    Parameters
    ----------
    x: (S, B, n) coordinates of runs; predictions: (S, B, K), NaN where a run failed; log_prior: (S, B) interim.
    draws: (S, D, n) whose mean and twice whose standard deviations define z.
    visited: so many runs at the end are where earlier emulators saw a good fit; they count however bad it is, or a
        polynomial would go on inventing good fits beyond its points.

    A data set with few runs near its best fit gets a polynomial of lower degree.

    Raises
    ------
    ValueError: too few runs near the best fit of a data set even for the first degree.
    """
    n_sets, _, n = x.shape
    parents = monomials(n, degree)
    centre = draws.mean(axis=1)
    whiten = np.empty((n_sets, n, n))
    coefficients = np.zeros((n_sets, len(parents), values.shape[1]))
    trusted = np.zeros_like(weight)
    for s in range(n_sets):
        whiten[s] = np.linalg.inv(2 * np.linalg.cholesky(np.cov(draws[s], rowvar=False)))
        alive = np.isfinite(predictions[s]).all(axis=1)
        at, seen = x[s][alive], predictions[s][alive]
        log = log_prior[s][alive] - 0.5 * np.sum(weight[s] * (values[s] - seen) ** 2, axis=1)
        asked = np.flatnonzero(alive) >= len(alive) - visited
        near = (log > log.max() - REACH) | asked
        terms = _affordable(n, degree, int(near.sum()))
        count = np.maximum(np.exp(0.3 * (log[near] - log.max())), 0.04 * asked[near])
        matrix = design_matrix((at[near] - centre[s]) @ whiten[s].T, parents[:terms])
        coefficients[s, :terms] = _least_squares(matrix, seen[near], count)
        error = count @ (seen[near] - matrix @ coefficients[s, :terms]) ** 2 / count.sum()
        trusted[s] = weight[s] / (1 + weight[s] * error)
    return Emulators(centre, whiten, coefficients, parents, values, trusted)


def _affordable(n: int, degree: int, runs: int) -> int:
    """Number of monomials of the highest degree that leaves two runs for each."""
    for d in range(degree, 0, -1):
        if runs >= 2 * math.comb(n + d, d):
            return math.comb(n + d, d)
    raise ValueError(f"{runs} runs near the best fit for {n + 1} monomials")


def _least_squares(matrix: Array, right: Array, count: Array) -> Array:
    """Coefficients (M, K) from rows that count so much (B,): normal equations of scaled columns, slightly damped."""
    weighted = matrix * count[:, None]
    normal = weighted.T @ matrix
    scale = np.sqrt(np.diag(normal))
    normal = normal / np.outer(scale, scale)
    normal[np.diag_indices_from(normal)] += RIDGE
    return np.asarray(np.linalg.solve(normal, (weighted.T @ right) / scale[:, None]) / scale[:, None])


def draw_interim(
    emulators: Emulators,
    mean: Array,
    std: Array,
    seed: int,
    words: str,
    count: int,
    walkers: int = 40,
    temperature: float = 1.0,
    workers: int = 1,
) -> Array:
    """(S, count · walkers, n) draws of each L_i(x) N(x; mean, std²), to the power 1/temperature, on its emulator.

    ``seed`` and ``words`` name the random streams; ``workers`` threads.
    """
    n_sets, n = emulators.centre.shape
    out = np.empty((n_sets, count, walkers, n))

    def one(s: int) -> None:
        _walk(
            member_stream(seed, words, s), emulators.centre[s], emulators.whiten[s],
            emulators.coefficients[s], emulators.parents, emulators.values[s], emulators.weight[s], mean, std, 600, 12,
            temperature, out[s],
        )  # fmt: skip

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, range(n_sets)))
    return out.reshape(n_sets, -1, n)


@numba.njit(cache=True, nogil=True)
def residual(x, centre, whiten, coefficients, parents, values, out):  # type: ignore[no-untyped-def]
    """y − m(x) (K,) of one data set; returns Σ (|z| − 3)² over the coordinates beyond 3."""
    n, count, k_max = x.size, parents.shape[0], values.size
    z, beyond = np.zeros(n), 0.0
    for i in range(n):
        for j in range(n):
            z[i] += whiten[i, j] * (x[j] - centre[j])
        beyond += max(abs(z[i]) - TRUSTED, 0.0) ** 2
    terms = np.empty(count)
    terms[0] = 1.0
    for k in range(k_max):
        out[k] = values[k] - coefficients[0, k]
    for a in range(1, count):
        terms[a] = terms[parents[a, 0]] * z[parents[a, 1]]
        for k in range(k_max):
            out[k] -= terms[a] * coefficients[a, k]
    return beyond


@numba.njit(cache=True, nogil=True)
def log_likelihood(x, centre, whiten, coefficients, parents, values, weight):  # type: ignore[no-untyped-def]
    """−½ Σ weight (y − m)² of one data set, less beyond the points it was learnt from."""
    left = np.empty(values.size)
    total = -WALL * residual(x, centre, whiten, coefficients, parents, values, left)
    for k in range(values.size):
        total -= 0.5 * weight[k] * left[k] * left[k]
    return total


@numba.njit(cache=True, nogil=True)
def _walk(rng, centre, whiten, coefficients, parents, values, weight, mean, std, burn_in, thin, temperature, out):  # type: ignore[no-untyped-def]
    """Draws ``out`` (D, W, n) of L(x) N(x; mean, std²) by W walkers with differential evolution (ter Braak 2006)."""
    count, walkers, n = out.shape
    root = np.linalg.inv(whiten)  # of twice the standard deviations
    x, old = np.empty((walkers, n)), np.full(walkers, -np.inf)
    x_new = np.empty(n)
    for w in range(walkers):
        for i in range(n):
            x_new[i] = 0.25 * rng.standard_normal()
        x[w] = centre + root @ x_new
    for step in range(-1, burn_in + thin * count):
        for w in range(walkers):
            a = (w + rng.integers(1, walkers)) % walkers
            b = (w + rng.integers(1, walkers)) % walkers
            jump = 1.0 if rng.random() < 0.1 else 2.38 / np.sqrt(2 * n) * (1.0 if rng.random() < 0.5 else 0.4)
            new = 0.0
            for i in range(n):
                x_new[i] = x[w, i]
                if step >= 0:
                    x_new[i] += jump * (x[a, i] - x[b, i]) + 1e-3 * std[i] * rng.standard_normal()
                new -= 0.5 * ((x_new[i] - mean[i]) / std[i]) ** 2
            new += log_likelihood(x_new, centre, whiten, coefficients, parents, values, weight)
            if temperature * np.log(rng.random()) < new - old[w]:
                x[w], old[w] = x_new, new
        if step >= burn_in and (step - burn_in) % thin == thin - 1:
            out[(step - burn_in) // thin] = x


@numba.njit(cache=True, nogil=True)
def _log_likelihoods(x, centre, whiten, coefficients, parents, values, weight, out):  # type: ignore[no-untyped-def]
    for b in range(x.shape[0]):
        for s in range(x.shape[1]):
            out[b, s] = log_likelihood(x[b, s], centre[s], whiten[s], coefficients[s], parents, values[s], weight[s])
