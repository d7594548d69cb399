"""A tempered population of chains, written without a line of ``en4dvar.sampling``: what a posterior is held against.

Sequential Monte Carlo (Del Moral, Doucet & Jasra 2006, J. R. Stat. Soc. B 68, 411): a population drawn from the prior
goes to the posterior along N(x; prior) L(x)^β, β from 0 to 1 so slowly that nine tenths of it stay effective, is
resampled and moved at every β, and at the end walks on while its moments are averaged. Moves are differential evolution
of one half by the other (ter Braak 2006), of which a tenth are whole differences: these lead from mode to mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
KEPT = 0.9  # share of the population that stays effective from one β to the next
SWEEPS = 6  # at each β
LEAPS = 0.1  # share of the moves by a whole difference
JITTER = 1e-3  # of the population's standard deviation


@dataclass(frozen=True)
class Tempered:
    """Draws (D, n) of the posterior, and the runs they took.

    Their number says nothing of the masses of modes apart, which are those that survived when β was low: compare
    populations of different seeds.
    """

    draws: Array
    runs: int

    @property
    def mean(self) -> Array:
        return np.asarray(self.draws.mean(axis=0))

    @property
    def std(self) -> Array:
        return np.asarray(self.draws.std(axis=0))


def tempered(
    log_likelihood: Callable[[Array], Array], mean: Array, std: Array, seed: int, count: int, walk: int
) -> Tempered:
    """Draws of N(x; mean, std²) exp(log_likelihood(x)), by ``count`` particles that walk ``walk`` sweeps at the end.

    ``log_likelihood`` (B,) of points (B, n), −inf or NaN where there is none.
    """
    random, n, runs = np.random.default_rng([seed, 77]), len(mean), 0

    def of(z: Array) -> Array:
        nonlocal runs
        runs += len(z)
        values = log_likelihood(mean + std * z)
        return np.where(np.isfinite(values), values, -np.inf)

    z = random.standard_normal((count, n))
    logs, beta = of(z), 0.0
    while beta < 1.0:
        step = _next(logs, 1.0 - beta)
        beta = 1.0 if step >= 1.0 - beta else beta + step
        weights = np.exp(step * (logs - logs.max()))
        chosen = np.searchsorted(np.cumsum(weights) / weights.sum(), (np.arange(count) + random.random()) / count)
        chosen = random.permutation(chosen.clip(max=count - 1))
        z, logs = z[chosen], logs[chosen]
        for _ in range(SWEEPS):
            z, logs = _sweep(of, z, logs, beta, random)
    kept = []
    for _ in range(walk):
        z, logs = _sweep(of, z, logs, 1.0, random)
        kept.append(z)
    return Tempered(mean + std * np.concatenate(kept), runs)


def _next(logs: Array, most: float) -> float:
    """The step in β that keeps :data:`KEPT` of the population effective, at most ``most``; by bisection."""

    def share(step: float) -> float:
        weights = np.exp(step * (logs - logs.max()))
        return float(weights.sum() ** 2 / np.sum(weights**2) / max(1, np.isfinite(logs).sum()))

    if share(most) >= KEPT:
        return most
    low, high = 0.0, most
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if share(middle) >= KEPT else (low, middle)
    return max(low, 1e-9)


def _sweep(
    of: Callable[[Array], Array], z: Array, logs: Array, beta: float, random: np.random.Generator
) -> tuple[Array, Array]:
    """Every particle is proposed one move, one half of them by differences of the other half."""
    z, logs, count, n = z.copy(), logs.copy(), len(z), z.shape[1]
    order = random.permutation(count)
    for mine, other in ((order[: count // 2], order[count // 2 :]), (order[count // 2 :], order[: count // 2])):
        a, b = z[random.choice(other, len(mine))], z[random.choice(other, len(mine))]
        usual = 2.38 / np.sqrt(2 * n) * random.uniform(0.3, 1.2, len(mine))
        length = np.where(random.random(len(mine)) < LEAPS, 1.0, usual)
        noise = JITTER * z[other].std(axis=0) * random.standard_normal((len(mine), n))
        proposed = z[mine] + length[:, None] * (a - b) + noise
        new = of(proposed)
        gain = beta * (new - logs[mine]) - 0.5 * np.sum(proposed**2 - z[mine] ** 2, axis=1)
        taken = np.log1p(-random.random(len(mine))) < gain
        z[mine[taken]], logs[mine[taken]] = proposed[taken], new[taken]
    return z, logs
