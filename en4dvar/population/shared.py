r"""Shared parameters: some have one value in all data sets, the others are each set's own.

    J(u, v_1 … v_S) = ½ Σ_i Σ_k β (y − m(u, v_i))²/std² + ½ ‖u‖² + ½ Σ_i ‖v_i‖²

in coordinates whitened by the prior, which enters once for u. Minimised with forward runs of all sets by Levenberg and
Marquardt's method from several starts; the evidence is Laplace's, −J − ½ ln|I + SᵀS| (MacKay 2003, chapter 28).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from en4dvar.prior import Prior
from en4dvar.sampling.forward_runs import CampaignRuns
from en4dvar.state import Array

STEP = 1e-3  # of a prior standard deviation, for the tangent
SMALL = 1e-3  # decrease of J that ends the search
SAMPLE = 8  # 2^8 points
PIECES = 8  # of the sample, run one after the other
ROUNDS = 3
DAMPING = 10.0 ** np.arange(-1, 5)  # tried at once, relative to the last


@dataclass(frozen=True)
class SharedFit:
    """``common`` (c,) of ``names`` at the minimum, physical; ``chi2_per_observation``: about 1 where one value of the
    shared parameters explains all observations.
    """

    names: tuple[str, ...]
    common: Array
    log_evidence: float
    chi2_per_observation: float


@dataclass(frozen=True)
class _Minimum:
    """Where J ends, whitened, J, and its Gauss–Newton Hessian there."""

    z: Array
    cost: float
    hessian: Array


def fit_shared(runs: CampaignRuns, starts: Array, prior: Prior, names: Sequence[str], most: int = 60) -> SharedFit:
    """Fit ``names`` in common, with at most so many steps of each descent.

    Parameters
    ----------
    starts: (B, S, n) control vectors to start from; of the common coordinates their mean over the sets is taken.

    Raises
    ------
    ValueError: the model cannot be run at any start, or the prior is correlated.
    """
    if prior.blocks:
        raise ValueError("shared parameters need a prior of independent ones")
    where = [prior.names.index(name) for name in names]
    problem = _Shared(runs, prior, where, starts.shape[1])
    best = min((_search(problem, problem.pack(start), most) for start in starts), key=lambda end: end.cost)
    if not np.isfinite(best.cost):
        raise ValueError("shared parameters: the model cannot be run at any start")
    residual = problem.residual(best.z[None])[0]
    common = prior.mean[where] + prior.std[where] * best.z[: len(where)]
    physical = np.array([prior.terms[j].to_physical(x) for j, x in zip(where, common, strict=True)])
    evidence = -best.cost - 0.5 * float(np.linalg.slogdet(best.hessian)[1])
    return SharedFit(tuple(names), physical, evidence, float(np.sum(residual**2)) / int(np.sum(runs.weight > 0)))


class _Shared:
    """Whitened coordinates (c + S·b,): the common ones, then each set's own."""

    def __init__(self, runs: CampaignRuns, prior: Prior, where: list[int], n_sets: int):
        self.runs, self.prior, self.where, self.n_sets = runs, prior, where, n_sets
        self.own = [j for j in range(len(prior.names)) if j not in where]
        self.root = np.sqrt(runs.weight)

    def pack(self, x: Array) -> Array:
        z = (x - self.prior.mean) / self.prior.std
        return np.concatenate([z[:, self.where].mean(axis=0), z[:, self.own].ravel()])

    def unpack(self, z: Array) -> Array:
        """(B, S, n) transformed."""
        c = len(self.where)
        x = np.empty((len(z), self.n_sets, len(self.prior.names)))
        x[:, :, self.where] = z[:, None, :c]
        x[:, :, self.own] = z[:, c:].reshape(len(z), self.n_sets, len(self.own))
        return np.asarray(self.prior.mean + self.prior.std * x)

    def residual(self, z: Array) -> Array:
        """√β (y − m)/std (B, S, K), NaN where a run failed."""
        return np.asarray(self.root * (self.runs.values - self.runs.predictions(self.unpack(z))))

    def cost(self, z: Array) -> Array:
        total = 0.5 * np.sum(self.residual(z) ** 2, axis=(1, 2)) + 0.5 * np.sum(z**2, axis=1)
        return np.where(np.isfinite(total), total, np.inf)

    def renewed(self, z: Array) -> Array:
        """``z`` with each set's own coordinates at the best of a quasi-random sample of their prior, or as they are."""
        from scipy.stats import norm, qmc  # not needed to import the package

        c, b = len(self.where), len(self.own)
        if not b:
            return z
        sample = norm.ppf(qmc.Sobol(b, rng=0).random_base2(SAMPLE))
        trial = np.tile(z, (1 + len(sample), 1))
        trial[1:, c:] = np.tile(sample, (1, self.n_sets))
        own = trial[:, c:].reshape(len(trial), self.n_sets, b)
        total = np.concatenate(
            [0.5 * np.sum(self.residual(part) ** 2, axis=2) for part in np.array_split(trial, PIECES)]
        )
        total = np.where(np.isfinite(total), total, np.inf) + 0.5 * np.sum(own**2, axis=2)
        best = own[np.argmin(total, axis=0), np.arange(self.n_sets)]
        return np.concatenate([z[:c], best.ravel()])

    def tangent(self, z: Array) -> tuple[Array, Array]:
        """Residual (S·K,) and −∂residual/∂z (S·K, c + S·b): one run a set and coordinate, not a coordinate alone."""
        c, b = len(self.where), len(self.own)
        shifted = np.tile(z, (1 + c + b, 1))
        shifted[1 + np.arange(c), np.arange(c)] += STEP
        for j in range(b):
            shifted[1 + c + j, c + j :: b] += STEP
        r = self.residual(shifted)
        slope = (r[0] - r[1:]) / STEP  # (c + b, S, K)
        n_sets, k = r.shape[1:]
        matrix = np.zeros((n_sets, k, len(z)))
        matrix[:, :, :c] = slope[:c].transpose(1, 2, 0)
        for s in range(n_sets):
            matrix[s, :, c + s * b : c + (s + 1) * b] = slope[c:, s].T
        return r[0].ravel(), matrix.reshape(-1, len(z))


def _search(problem: _Shared, z: Array, most: int) -> _Minimum:
    """Minima one after the other, each set's own coordinates looked for anew in between, until that finds nothing.

    With the common coordinates fixed from outside a set's own have several minima, which no descent leaves.
    """
    best = _minimise(problem, problem.renewed(z), most)
    for _ in range(ROUNDS):
        again = _minimise(problem, problem.renewed(best.z), most)
        if not again.cost < best.cost - SMALL:
            break
        best = again
    return best


def _minimise(problem: _Shared, z: Array, most: int) -> _Minimum:
    cost, damping = float(problem.cost(z[None])[0]), 1e-2
    for _ in range(most):
        r, matrix = problem.tangent(z)
        if not (np.isfinite(cost) and np.all(np.isfinite(matrix))):
            return _Minimum(z, np.inf, np.eye(len(z)))
        hessian, slope = np.eye(len(z)) + matrix.T @ matrix, matrix.T @ r - z
        tries = damping * DAMPING
        trial = np.stack([z + np.linalg.solve(hessian + d * np.diag(np.diag(hessian)), slope) for d in tries])
        costs = problem.cost(trial)
        best = int(np.argmin(costs))
        decrease = cost - costs[best]
        if decrease > 0:
            z, cost, damping = trial[best], float(costs[best]), max(tries[best], 1e-8)
        if decrease <= SMALL:
            break
    _, matrix = problem.tangent(z)
    return _Minimum(z, cost, np.eye(len(z)) + matrix.T @ matrix)
