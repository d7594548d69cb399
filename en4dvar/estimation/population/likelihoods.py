r"""Likelihoods of data sets on their emulators, and draws of the posteriors they make with an interim prior.

    ln L̂(x) = −½ Σ_k (y_k − m_k(x))² / (std_k²/β_k + error_k²) − wall

What the emulator misses adds to the variance of each observation, or walkers would take the misses for good fits (of
bubbles, most readings are met to 0.01 µm; one at the very end of the collapse, where the radius has a cusp in time, is
missed by up to 2 µm). What is left is weighed away with forward runs (:mod:`~en4dvar.estimation.population.weights`).
Beyond |z| = 3, six standard deviations from the points, a polynomial can fit observations by chance: there the
likelihood is made to vanish.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from en4dvar.model.state import Array
from en4dvar.plumbing.compiled import kernel
from en4dvar.priors.prior import member_stream
from en4dvar.sampling.emulator import Coordinates, Emulator

REACH = 12.0  # trained on points whose log-density is within this of the best
TRUSTED, WALL = 3.0, 10.0  # of |z|, and what the log-likelihood loses for the square of an excess
RIDGE = 1e-11
RUNS_PER_TERM = 2
WIDTH = 2.0  # |z| = 1 is so many standard deviations of the points
BURN_IN, THIN = 600, 12  # steps of the walkers before the first draw and between two
LEAPS = 0.1  # share of the moves of length 1, which take walkers from one mode to another
JITTER = 1e-3  # of the interim prior's standard deviation


class EmulatedLikelihood(NamedTuple):
    """L̂ of one set: observations ``values`` (K,) and ``weight`` (K,) 1/(std²/β + error²), 0 where there is none.

    Kernels can read it.
    """

    emulator: Emulator
    values: Array
    weight: Array

    def log(self, x: Array) -> Array:
        """(B,) at control vectors (B, n); up to the constant that the exact one lacks."""
        out = np.empty(len(x))
        _log_likelihoods(np.ascontiguousarray(x), self, out)
        return out


def fit_likelihood(
    x: Array, predictions: Array, log_prior: Array, values: Array, weight: Array, draws: Array, degree: int,
    must: int = 0,
) -> EmulatedLikelihood:  # fmt: skip
    """The likelihood of one set, by least squares on forward runs, those of high interim posterior density counting
    more.

    Parameters
    ----------
    x: (B, n) control vectors of runs; predictions: (B, K), NaN where a run failed; log_prior: (B,) interim.
    values, weight: (K,) observations and β/std².
    draws: (D, n) whose mean and twice whose standard deviations define z.
    must: so many runs at the end are where earlier emulators saw a good fit; they count however bad it is, or a
        polynomial would go on inventing good fits beyond its points.

    With few runs near the best fit the polynomial is of lower degree.

    Raises
    ------
    ValueError: too few runs near the best fit even for the first degree.
    """
    alive = np.isfinite(predictions).all(axis=1)
    at, outputs = x[alive], predictions[alive]
    log = log_prior[alive] - 0.5 * np.sum(weight * (values - outputs) ** 2, axis=1)
    asked = np.flatnonzero(alive) >= len(x) - must
    near = (log > log.max() - REACH) | asked
    affordable = _affordable(x.shape[1], degree, int(near.sum()))
    counts = np.maximum(np.exp(0.3 * (log[near] - log.max())), 0.04 * asked[near])
    emulator = Emulator.fitted(Coordinates.about(draws, WIDTH), affordable, at[near], outputs[near], counts, RIDGE)
    error = counts @ (outputs[near] - emulator.predictions(at[near])) ** 2 / counts.sum()
    return EmulatedLikelihood(emulator, values, weight / (1 + weight * error))


def _affordable(n: int, degree: int, runs: int) -> int:
    """The highest degree up to ``degree`` that leaves two runs for each monomial."""
    for d in range(degree, 0, -1):
        if runs >= RUNS_PER_TERM * math.comb(n + d, d):
            return d
    raise ValueError(f"{runs} runs near the best fit for {n + 1} monomials")


def draw_interim(
    likelihoods: Sequence[EmulatedLikelihood], mean: Array, std: Array, seed: int, words: str, count: int,
    walkers: int = 40, temperature: float = 1.0, workers: int = 1,
) -> Array:  # fmt: skip
    """(S, count · walkers, n) draws of each L_i(x) N(x; mean, std²), to the power 1/temperature.

    ``seed`` and ``words`` name the random streams; ``workers`` threads.
    """
    out = np.empty((len(likelihoods), count, walkers, len(mean)))

    def draw_set(s: int) -> None:
        _walk(member_stream(seed, words, s), likelihoods[s], mean, std, temperature, out[s])

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(draw_set, range(len(likelihoods))))
    return out.reshape(len(likelihoods), -1, len(mean))


@kernel
def log_likelihood(x: Array, likelihood: EmulatedLikelihood) -> float:
    """ln L̂ at one control vector (n,)."""
    values, weight = likelihood.values, likelihood.weight
    centre, whiten = likelihood.emulator.coordinates.centre, likelihood.emulator.coordinates.whiten
    parents, coefficients = likelihood.emulator.parents, likelihood.emulator.coefficients
    z, beyond = np.zeros(x.size), 0.0
    for i in range(x.size):
        for j in range(x.size):
            z[i] += whiten[i, j] * (x[j] - centre[j])
        beyond += max(abs(z[i]) - TRUSTED, 0.0) ** 2
    terms, left = np.empty(parents.shape[0]), np.empty(values.size)
    terms[0] = 1.0
    for k in range(values.size):
        left[k] = values[k] - coefficients[0, k]
    for a in range(1, terms.size):
        terms[a] = terms[parents[a, 0]] * z[parents[a, 1]]
        for k in range(values.size):
            left[k] -= terms[a] * coefficients[a, k]
    total = -WALL * beyond
    for k in range(values.size):
        total -= 0.5 * weight[k] * left[k] * left[k]
    return total


@kernel
def _walk(
    rng: np.random.Generator, likelihood: EmulatedLikelihood, mean: Array, std: Array, temperature: float, out: Array
) -> None:
    """Draws ``out`` (D, W, n) of L̂(x) N(x; mean, std²) by W walkers with differential evolution (ter Braak 2006)."""
    count, walkers, n = out.shape
    root = np.linalg.inv(likelihood.emulator.coordinates.whiten)  # of twice the standard deviations
    x, old = np.empty((walkers, n)), np.full(walkers, -np.inf)
    x_new = np.empty(n)
    for w in range(walkers):
        for i in range(n):
            x_new[i] = 0.25 * rng.standard_normal()
        x[w] = likelihood.emulator.coordinates.centre + root @ x_new
    for step in range(-1, BURN_IN + THIN * count):
        for w in range(walkers):
            a = (w + rng.integers(1, walkers)) % walkers
            b = (w + rng.integers(1, walkers)) % walkers
            jump = 1.0 if rng.random() < LEAPS else 2.38 / np.sqrt(2 * n) * (1.0 if rng.random() < 0.5 else 0.4)
            new = 0.0
            for i in range(n):
                x_new[i] = x[w, i]
                if step >= 0:
                    x_new[i] += jump * (x[a, i] - x[b, i]) + JITTER * std[i] * rng.standard_normal()
                new -= 0.5 * ((x_new[i] - mean[i]) / std[i]) ** 2
            new += log_likelihood(x_new, likelihood)
            if temperature * np.log(rng.random()) < new - old[w]:
                x[w], old[w] = x_new, new
        if step >= BURN_IN and (step - BURN_IN) % THIN == THIN - 1:
            out[(step - BURN_IN) // THIN] = x


@kernel
def _log_likelihoods(x: Array, likelihood: EmulatedLikelihood, out: Array) -> None:
    for b in range(x.shape[0]):
        out[b] = log_likelihood(x[b], likelihood)
