"""A stand-in for J that costs nothing to evaluate: J of emulated predictions.

J is a sum of squares of residuals, and a cubic fitted to a few hundred runs gives it to a few tenths where J itself
varies by tens. The fit is weighted towards runs of low J and made twice: first at draws of the Gaussian posterior, then
with runs where the first emulator says the posterior is. The share of those runs that importance weights exp(Ĵ − J)
leave effective says how far Ĵ can be trusted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from en4dvar.diagnostics import effective_share
from en4dvar.ensemble.forecast import Forecast
from en4dvar.likelihood import fixed_precision, observation_cost
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.sampling.emulator import Coordinates, Emulator, basis
from en4dvar.sampling.walkers import advance
from en4dvar.state import Array

DEGREES = (3, 2)  # tried in this order
RUNS_PER_TERM = 4
FEWEST_RUNS, MOST_RUNS = 96, 512  # of one fit
ENOUGH_ALIVE = 0.75  # share of the first runs that must succeed
CEILING = 20.0  # above the lowest J_o of the runs
RIDGE = 1e-9
WALKERS = 300
SCATTERED, SETTLED = 6, 10  # rounds of the walkers before the second fit, after it
PER_ROUND = 10  # moves in a round

Run = Callable[[Array], Forecast]


@dataclass(frozen=True)
class EmulatedCost:
    """Ĵ (B,) of control vectors (B, n).

    ``observed`` is J_o (B,) of what the polynomials ``of_outputs`` (Ky, M) give, ``of_prior`` (n, 1 + n) the normalised
    departure from the prior's mean. J_o is cut at ``ceiling``: far from its runs a polynomial says only that J is
    large, and a walker that true J lets in there must find its way out. ``share`` is the effective share of the runs
    that judge it, ``draws`` (S, n) are of exp(−Ĵ).
    """

    emulator: Emulator
    of_outputs: Array
    of_prior: Array
    observed: Callable[[Array], Array]
    ceiling: float = math.inf
    share: float = math.nan
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))

    def cost(self, x: Array) -> Array:
        """Ĵ (B,) of control vectors (B, n)."""
        return self._cost(self.emulator.coordinates.of(x))

    def _cost(self, z: Array) -> Array:
        at = basis(z, self.emulator.parents)
        departure = self.of_prior @ at[: self.of_prior.shape[1]]
        return np.asarray(np.minimum(self.observed(self.of_outputs @ at), self.ceiling) + _half_square(departure))

    def walk(self, x: Array, others: Array, random: np.random.Generator, rounds: int) -> list[Array]:
        """Positions (W, n) of walkers from ``x`` after each round, sampling exp(−Ĵ); ``others`` (W', n) stand still."""
        coordinates = self.emulator.coordinates
        z, others = coordinates.of(x), coordinates.of(others)
        cost, positions = self._sum_of_squares() or self._cost, []
        costs = cost(z)
        for _ in range(rounds):
            z, costs = advance(cost, z, costs, others, random, PER_ROUND)
            positions.append(coordinates.back(z))
        return positions

    def _sum_of_squares(self) -> Callable[[Array], Array] | None:
        """:meth:`_cost` where it is nothing but squares: of as few polynomials as there are monomials, at most."""
        if self.observed is not _half_square or math.isfinite(self.ceiling):
            return None
        rows = np.zeros((len(self.of_outputs) + len(self.of_prior), self.of_outputs.shape[1]))
        rows[: len(self.of_outputs)] = self.of_outputs
        rows[len(self.of_outputs) :, : self.of_prior.shape[1]] = self.of_prior
        if len(rows) > rows.shape[1]:
            rows = np.asarray(np.linalg.qr(rows, mode="r"))
        return lambda z: _half_square(rows @ basis(z, self.emulator.parents))


@dataclass(frozen=True)
class _Runs:
    """Members that could be run: control vectors (B, n), J (B,), and outputs (B, Ky): predictions and, where there are
    any, rates and ln σ.
    """

    x: Array
    outputs: Array
    costs: Array
    has_rates: bool
    has_scale: bool

    def joined(self, other: _Runs) -> _Runs:
        x, outputs, costs = (
            np.concatenate(pair)
            for pair in ((self.x, other.x), (self.outputs, other.outputs), (self.costs, other.costs))
        )
        return replace(self, x=x, outputs=outputs, costs=costs)


def needed_runs(n_parameters: int) -> tuple[int, int] | None:
    """(Degree, runs of one fit) for so many parameters; None where there are too many of them."""
    for degree in DEGREES:
        runs = RUNS_PER_TERM * math.comb(n_parameters + degree, degree)
        if runs <= MOST_RUNS:
            return degree, max(FEWEST_RUNS, runs)
    return None


def emulate(
    run: Run,
    prior: Prior,
    observations: Observations,
    ensemble: Array,
    random: np.random.Generator,
    fits: int = 2,
) -> EmulatedCost | None:
    """Ĵ about a Gaussian ensemble (N, n), transformed, with draws of it.

    Each of the ``fits`` takes the :func:`needed_runs` of the model through ``run``, from the second on where the one
    before says the posterior is. None where there are too many parameters for polynomials, or so many runs fail that
    the rest does not determine them.
    """
    n = ensemble.shape[1]
    wanted = needed_runs(n)
    if wanted is None or len(ensemble) <= n:
        return None
    degree, count = wanted
    coordinates = Coordinates.about(ensemble)
    runs = _run(run, prior, observations, coordinates.back(random.standard_normal((count, n))))
    if len(runs.x) < ENOUGH_ALIVE * count:
        return None
    emulated = _fit(prior, observations, coordinates, degree, runs)
    kept, share = runs.x, math.nan
    walkers = kept[random.permutation(len(kept))[:WALKERS]]
    for _ in range(fits - 1):
        positions = emulated.walk(walkers, kept, random, SCATTERED)
        walkers, kept = positions[-1], np.concatenate(positions[SCATTERED // 2 :])
        new = _run(run, prior, observations, kept[np.linspace(0, len(kept) - 1, count).astype(int)])
        if not len(new.x):
            return None
        share = effective_share(emulated.cost(new.x) - new.costs) * len(new.x) / count  # of the fit without them
        runs = runs.joined(new)
        emulated = _fit(prior, observations, coordinates, degree, runs)
    settled = emulated.walk(walkers, kept, random, SETTLED)
    ceiling = float(np.min(runs.costs - _prior_cost(prior, runs.x))) + CEILING
    return replace(emulated, ceiling=ceiling, share=share, draws=np.concatenate(settled[SETTLED // 3 :]))


def _run(run: Run, prior: Prior, observations: Observations, x: Array) -> _Runs:
    """Run control vectors (B, n); the survivors."""
    found = run(x)
    parts = [found.predictions]
    if found.rates is not None:
        parts.append(found.rates)
    if found.noise_scale is not None:
        parts.append(np.log(found.noise_scale)[:, None])
    costs = _prior_cost(prior, x) + observation_cost(observations, found.predictions, found.rates, found.noise_scale)
    alive = found.active & np.isfinite(costs)
    has_rates, has_scale = found.rates is not None, found.noise_scale is not None
    return _Runs(x[alive], np.hstack(parts)[alive], costs[alive], has_rates, has_scale)


def _prior_cost(prior: Prior, x: Array) -> Array:
    z = (x - prior.mean) / prior.std
    return np.asarray(0.5 * (z * z).sum(axis=1))


def _fit(prior: Prior, observations: Observations, coordinates: Coordinates, degree: int, runs: _Runs) -> EmulatedCost:
    """A run whose J exceeds the lowest by the width of a posterior, 2n, counts half."""
    excess = (runs.costs - runs.costs.min()) / (2 * len(coordinates.centre))
    emulator = Emulator.fitted(coordinates, degree, runs.x, runs.outputs, 1 / (1 + excess**2), RIDGE)
    coefficients = emulator.coefficients.T
    of_prior = np.column_stack([coordinates.centre - prior.mean, coordinates.root]) / prior.std[:, None]
    precision = fixed_precision(observations)
    if runs.has_rates or runs.has_scale or precision is None:
        observed = partial(_cost_of_outputs, observations, runs.has_rates, runs.has_scale)
        return EmulatedCost(emulator, coefficients, of_prior, observed)
    # R is constant and J_o quadratic: the polynomials can be those of whitened residuals, of which M tell as much as K
    residuals = -coefficients
    residuals[:, 0] += observations.values
    residuals *= np.sqrt(precision)[:, None]
    if len(residuals) > residuals.shape[1]:
        residuals = np.asarray(np.linalg.qr(residuals, mode="r"))
    return EmulatedCost(emulator, residuals, of_prior, _half_square)


def _cost_of_outputs(observations: Observations, has_rates: bool, has_scale: bool, outputs: Array) -> Array:
    """J_o (B,) of predictions, rates and ln σ on top of each other (Ky, B)."""
    k = len(observations.times)
    rates = outputs[k : 2 * k].T if has_rates else None
    return observation_cost(observations, outputs[:k].T, rates, np.exp(outputs[-1]) if has_scale else None)


def _half_square(residuals: Array) -> Array:
    """½ |v|² (B,) of residuals (K, B)."""
    return np.asarray(0.5 * np.einsum("kb,kb->b", residuals, residuals))
