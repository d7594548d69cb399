r"""Polynomial stand-ins for the forward model, one a data set, fitted where its likelihood is not negligible.

    m_k(x) ≈ Σ_a c_ka z^a,   z = W (x − x̄),   |a| ≤ degree

Their log-likelihood is off by about 0.1 (measured, degree 3, acoustic twin, rms over the posterior of a bubble), and a
population is sampled on them in seconds. What they leave is weighed away with forward runs (``study.population``).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numba
import numpy as np

from en4dvar.prior import member_stream
from en4dvar.state import Array

REACH = 12.0  # trained on points whose log-likelihood is within this of the best


@dataclass(frozen=True)
class Emulators:
    """Of S data sets, n coordinates, at most K readings (padded), M monomials.

    ``centre`` (S, n) and ``whiten`` (S, n, n) define z; ``coefficients`` (S, M, K); ``parents`` (M, 2): monomial j is
    monomial parents[j, 0] times coordinate parents[j, 1] of z; ``values`` and ``weight`` (S, K) readings and β/std²,
    0 where there is none.
    """

    centre: Array
    whiten: Array
    coefficients: Array
    parents: np.ndarray
    values: Array
    weight: Array

    def log_likelihood(self, x: Array) -> Array:
        """(B, S) of coordinates (B, S, n), up to the constant that the exact one lacks as well."""
        out = np.empty(x.shape[:2])
        _log_likelihoods(
            x, self.centre, self.whiten, self.coefficients, self.parents, self.values, self.weight, out
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
    x: Array, predictions: Array, values: Array, weight: Array, draws: Array, degree: int, visited: int = 0
) -> Emulators:
    """Least squares on forward runs, those near the best fit counting more.

    Parameters
    ----------
    x: (S, B, n) coordinates of runs; predictions: (S, B, K), NaN where a run failed.
    draws: (S, D, n) whose mean and twice whose standard deviations define z.
    visited: so many runs at the end are where earlier emulators saw a good fit; they count however bad it is, or a
        polynomial would go on inventing good fits beyond its points.

    Raises
    ------
    ValueError: too few runs near the best fit of a data set for the number of monomials.
    """
    n_sets, _, n = x.shape
    parents = monomials(n, degree)
    centre = draws.mean(axis=1)
    whiten = np.empty((n_sets, n, n))
    coefficients = np.zeros((n_sets, len(parents), values.shape[1]))
    for s in range(n_sets):
        whiten[s] = np.linalg.inv(2 * np.linalg.cholesky(np.cov(draws[s], rowvar=False)))
        alive = np.isfinite(predictions[s]).all(axis=1)
        at, seen = x[s][alive], predictions[s][alive]
        log = -0.5 * np.sum(weight[s] * (values[s] - seen) ** 2, axis=1)
        asked = np.flatnonzero(alive) >= len(alive) - visited
        near = (log > log.max() - REACH) | asked
        if near.sum() < 2 * len(parents):
            raise ValueError(f"{int(near.sum())} runs near the best fit for {len(parents)} monomials")
        root = np.maximum(np.exp(0.15 * (log[near] - log.max())), 0.2 * asked[near])[:, None]
        matrix = design_matrix((at[near] - centre[s]) @ whiten[s].T, parents)
        coefficients[s] = np.linalg.lstsq(matrix * root, seen[near] * root, rcond=None)[0]
    return Emulators(centre, whiten, coefficients, parents, values, weight)


def draw_interim(emulators: Emulators, mean: Array, std: Array, seed: int, count: int, walkers: int = 40) -> Array:
    """(S, count · walkers, n) draws of each L_i(x) N(x; mean, std²) on its emulator."""
    n_sets, n = emulators.centre.shape
    out = np.empty((n_sets, count, walkers, n))
    for s in range(n_sets):
        _walk(
            member_stream(seed, "interim draws", s), emulators.centre[s], emulators.whiten[s],
            emulators.coefficients[s], emulators.parents, emulators.values[s], emulators.weight[s], mean, std, 600, 12,
            out[s],
        )  # fmt: skip
    return out.reshape(n_sets, -1, n)


@numba.njit(cache=True, nogil=True)
def residual(x, centre, whiten, coefficients, parents, values, out):  # type: ignore[no-untyped-def]
    """y − m(x) (K,) of one data set."""
    n, count, k_max = x.size, parents.shape[0], values.size
    z = np.zeros(n)
    for i in range(n):
        for j in range(n):
            z[i] += whiten[i, j] * (x[j] - centre[j])
    terms = np.empty(count)
    terms[0] = 1.0
    for k in range(k_max):
        out[k] = values[k] - coefficients[0, k]
    for a in range(1, count):
        terms[a] = terms[parents[a, 0]] * z[parents[a, 1]]
        for k in range(k_max):
            out[k] -= terms[a] * coefficients[a, k]


@numba.njit(cache=True, nogil=True)
def log_likelihood(x, centre, whiten, coefficients, parents, values, weight):  # type: ignore[no-untyped-def]
    """−½ Σ β (y − m)²/std² of one data set."""
    left = np.empty(values.size)
    residual(x, centre, whiten, coefficients, parents, values, left)
    total = 0.0
    for k in range(values.size):
        total -= 0.5 * weight[k] * left[k] * left[k]
    return total


@numba.njit(cache=True, nogil=True)
def _walk(rng, centre, whiten, coefficients, parents, values, weight, mean, std, burn_in, thin, out):  # type: ignore[no-untyped-def]
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
            if np.log(rng.random()) < new - old[w]:
                x[w], old[w] = x_new, new
        if step >= burn_in and (step - burn_in) % thin == thin - 1:
            out[(step - burn_in) // thin] = x


@numba.njit(cache=True, nogil=True)
def _log_likelihoods(x, centre, whiten, coefficients, parents, values, weight, out):  # type: ignore[no-untyped-def]
    for b in range(x.shape[0]):
        for s in range(x.shape[1]):
            out[b, s] = log_likelihood(x[b, s], centre[s], whiten[s], coefficients[s], parents, values[s], weight[s])
