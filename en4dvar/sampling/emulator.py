"""A stand-in for J that costs nothing to evaluate: predictions as polynomials of the control vector.

J is a sum of squares of residuals, and within the posterior its predictions m(x) bend little: a cubic fitted to a few
hundred runs gives J to a few tenths where J itself varies by tens. The fit is weighted towards runs of low J and made
twice: first at draws of the Gaussian posterior, then with runs where the first emulator says the posterior is. The
share of those runs that importance weights exp(Ĵ − J) leave effective says how far Ĵ can be trusted.

Sources: polynomial surrogates of posteriors, Marzouk & Xiu (2009), Commun. Comput. Phys. 6, 826; sampling where the
surrogate says, Li & Marzouk (2014), SIAM J. Sci. Comput. 36, A1163.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from en4dvar.diagnostics import effective_share
from en4dvar.ensemble.forecast import Forecast
from en4dvar.likelihood import observation_cost
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.sampling.walkers import advance
from en4dvar.state import Array

DEGREES = (3, 2)  # tried in this order
RUNS_PER_TERM = 4
FEWEST_RUNS, MOST_RUNS = 96, 512  # of one fit
CEILING = 20.0  # above the lowest J_o of the runs
RIDGE = 1e-9  # relative: decides where the runs leave a coefficient open
WALKERS = 120
SCATTERED, SETTLED = 8, 40  # rounds of the walkers before the second fit, after it
PER_ROUND = 5  # moves of each half in a round

Run = Callable[[Array], Forecast]


@dataclass(frozen=True)
class Emulator:
    """Ĵ (B,) of control vectors (B, n), from polynomials of z = root⁻¹ (x − centre).

    ``terms`` are the index pairs that make each degree from the one before; ``coefficients`` (C, Ky) of predictions,
    rates and ln σ side by side. The observations' part is cut at ``ceiling``: far from its runs a polynomial says only
    that J is large, and a walker that true J lets in there must find its way out. ``share`` is the effective share of
    the runs that judge it, ``draws`` (S, n) are of exp(−Ĵ).
    """

    prior: Prior
    observations: Observations
    centre: Array
    inverse_root: Array
    terms: tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]
    coefficients: Array
    columns: tuple[bool, bool]
    ceiling: float = math.inf
    share: float = math.nan
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))

    def cost(self, x: Array) -> Array:
        """Ĵ (B,) of control vectors (B, n)."""
        outputs = self.coefficients.T @ _basis(self.inverse_root @ (x - self.centre).T, self.terms)
        k = len(self.observations.times)
        has_rates, has_scale = self.columns
        rates = outputs[k : 2 * k].T if has_rates else None
        scale = np.exp(outputs[-1]) if has_scale else None
        observed = observation_cost(self.observations, outputs[:k].T, rates, scale)
        return _prior_cost(self.prior, x) + np.minimum(observed, self.ceiling)

    def walk(self, x: Array, random: np.random.Generator, rounds: int) -> list[Array]:
        """Positions (W, n) of walkers from ``x`` after each round, sampling exp(−Ĵ)."""
        half = len(x) // 2
        halves = [x[:half], x[half : 2 * half]]
        costs = [self.cost(part) for part in halves]
        positions = []
        for _ in range(rounds):
            for i in (0, 1):
                halves[i], costs[i] = advance(self.cost, halves[i], costs[i], halves[1 - i], random, PER_ROUND)
            positions.append(np.concatenate(halves))
        return positions


@dataclass(frozen=True)
class _Runs:
    """Members that could be run: control vectors (B, n), outputs (B, Ky), J (B,)."""

    x: Array
    outputs: Array
    costs: Array

    def joined(self, other: _Runs) -> _Runs:
        return _Runs(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))


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
) -> Emulator | None:
    """An emulator about a Gaussian ensemble (N, n), transformed, with draws of it.

    Each of the ``fits`` takes the :func:`needed_runs` of the model through ``run``, from the second on where the one
    before says the posterior is. None where there are too many parameters for polynomials, or so many runs fail that
    the rest does not determine them.
    """
    n = ensemble.shape[1]
    wanted = needed_runs(n)
    if wanted is None or len(ensemble) <= n:
        return None
    degree, count = wanted
    mean = ensemble.mean(axis=0)
    root = np.asarray(np.linalg.cholesky(np.atleast_2d(np.cov(ensemble.T))), dtype=float)
    inverse_root, terms = np.asarray(np.linalg.inv(root), dtype=float), _terms(n, degree)
    found = _run(run, prior, observations, mean + random.standard_normal((count, n)) @ root.T)
    if found is None or len(found[0].x) < 0.75 * count:
        return None
    runs, columns = found
    emulator = _fit(prior, observations, mean, inverse_root, terms, runs, columns)
    walkers, share = runs.x[random.permutation(len(runs.x))[:WALKERS]], math.nan
    for _ in range(fits - 1):
        positions = emulator.walk(walkers, random, SCATTERED)
        walkers, kept = positions[-1], np.concatenate(positions[SCATTERED // 2 :])
        found = _run(run, prior, observations, kept[np.linspace(0, len(kept) - 1, count).astype(int)])
        if found is None:
            return None
        new = found[0]
        share = effective_share(emulator.cost(new.x) - new.costs) * len(new.x) / count  # of the fit without them
        runs = runs.joined(new)
        emulator = _fit(prior, observations, mean, inverse_root, terms, runs, columns)
    settled = emulator.walk(walkers, random, SETTLED)
    ceiling = float(np.min(runs.costs - _prior_cost(prior, runs.x))) + CEILING
    return replace(emulator, ceiling=ceiling, share=share, draws=np.concatenate(settled[SETTLED // 4 :]))


def _run(run: Run, prior: Prior, observations: Observations, x: Array) -> tuple[_Runs, tuple[bool, bool]] | None:
    """Run control vectors (B, n); the survivors, and whether there are rates and noise scales. None: no survivor."""
    found = run(x)
    if not found.active.any():
        return None
    parts = [found.predictions]
    if found.rates is not None:
        parts.append(found.rates)
    if found.noise_scale is not None:
        parts.append(np.log(found.noise_scale)[:, None])
    costs = _prior_cost(prior, x) + observation_cost(observations, found.predictions, found.rates, found.noise_scale)
    alive = found.active & np.isfinite(costs)
    columns = (found.rates is not None, found.noise_scale is not None)
    return _Runs(x[alive], np.hstack(parts)[alive], costs[alive]), columns


def _prior_cost(prior: Prior, x: Array) -> Array:
    z = (x - prior.mean) / prior.std
    return np.asarray(0.5 * (z * z).sum(axis=1))


def _fit(
    prior: Prior,
    observations: Observations,
    centre: Array,
    inverse_root: Array,
    terms: tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...],
    runs: _Runs,
    columns: tuple[bool, bool],
) -> Emulator:
    """Weighted least squares; a run whose J exceeds the lowest by the width of a posterior, 2n, counts half."""
    excess = (runs.costs - runs.costs.min()) / (2 * len(centre))
    root_weight = 1 / np.sqrt(1 + excess**2)
    design = _basis(inverse_root @ (runs.x - centre).T, terms).T * root_weight[:, None]
    scale = np.sqrt(np.sum(design**2, axis=0))
    normal = (design / scale).T @ (design / scale)
    normal[np.diag_indices_from(normal)] += RIDGE
    right = (design / scale).T @ (runs.outputs * root_weight[:, None])
    coefficients = np.linalg.solve(normal, right) / scale[:, None]
    return Emulator(prior, observations, centre, inverse_root, terms, coefficients, columns)


def _terms(n: int, degree: int) -> tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]:
    """For every degree from 2: which monomials of the degree before are multiplied by which coordinates."""
    terms = []
    last = list(range(n))  # the highest coordinate in each monomial
    for _ in range(2, degree + 1):
        pairs = [(i, j) for i, highest in enumerate(last) for j in range(highest, n)]
        terms.append((np.array([i for i, _ in pairs]), np.array([j for _, j in pairs])))
        last = [j for _, j in pairs]
    return tuple(terms)


def _basis(z: Array, terms: tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]) -> Array:
    """Monomials (C, B) of coordinates (n, B): 1, z_i, z_i z_j, …"""
    n = len(z)
    monomials = np.empty((1 + n + sum(len(by) for _, by in terms), z.shape[1]))
    monomials[0], monomials[1 : n + 1] = 1.0, z
    before, end = z, n + 1
    for of_before, by in terms:
        here = monomials[end : end + len(by)]
        np.multiply(before[of_before], z[by], out=here)
        before, end = here, end + len(by)
    return monomials
