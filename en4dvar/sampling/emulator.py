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
from en4dvar.noise import Linearisation, Predicted
from en4dvar.observations import Observations
from en4dvar.prior import Prior
from en4dvar.sampling.walkers import advance
from en4dvar.state import Array

DEGREES = (3, 2)  # tried in this order
RUNS_PER_TERM = 4
FEWEST_RUNS, MOST_RUNS = 96, 512  # of one fit
CEILING = 20.0  # above the lowest J_o of the runs
RIDGE = 1e-9  # relative: decides where the runs leave a coefficient open
WALKERS = 300
SCATTERED, SETTLED = 6, 10  # rounds of the walkers before the second fit, after it
PER_ROUND = 10  # moves in a round

Run = Callable[[Array], Forecast]


@dataclass(frozen=True)
class _Coordinates:
    """z = root⁻¹ (x − centre) of control vectors (B, n), in which an ensemble is N(0, 1), and monomials of them.

    ``terms``: for every degree from 2, which monomials of the degree before are multiplied by which coordinates.
    """

    centre: Array
    root: Array
    inverse_root: Array
    terms: tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]

    @classmethod
    def about(cls, ensemble: Array, degree: int) -> _Coordinates:
        """Those of an ensemble (N, n), with monomials up to ``degree``."""
        root = np.asarray(np.linalg.cholesky(np.atleast_2d(np.cov(ensemble.T))), dtype=float)
        return cls(ensemble.mean(axis=0), root, np.linalg.inv(root), _terms(ensemble.shape[1], degree))

    def to(self, x: Array) -> Array:
        return np.asarray((x - self.centre) @ self.inverse_root.T)

    def back(self, z: Array) -> Array:
        return np.asarray(self.centre + z @ self.root.T)

    def basis(self, z: Array) -> Array:
        """Monomials (C, B) of coordinates (B, n): 1, z_i, z_i z_j, …"""
        count, n = z.shape
        monomials = np.empty((1 + n + sum(len(by) for _, by in self.terms), count))
        monomials[0], monomials[1 : n + 1] = 1.0, z.T
        coordinates = before = monomials[1 : n + 1]
        end = n + 1
        for of_before, by in self.terms:
            here = monomials[end : end + len(by)]
            np.multiply(before[of_before], coordinates[by], out=here)
            before, end = here, end + len(by)
        return monomials


@dataclass(frozen=True)
class Emulator:
    """Ĵ (B,) of control vectors (B, n), from polynomials (…, C) of ``coordinates``.

    ``observed`` is J_o (B,) of what ``of_outputs`` (Ky, C) gives, ``of_prior`` (n, C) the normalised departure from the
    prior's mean. J_o is cut at ``ceiling``: far from its runs a polynomial says only that J is large, and a walker that
    true J lets in there must find its way out. ``share`` is the effective share of the runs that judge it, ``draws``
    (S, n) are of exp(−Ĵ).
    """

    coordinates: _Coordinates
    of_outputs: Array
    of_prior: Array
    observed: Callable[[Array], Array]
    ceiling: float = math.inf
    share: float = math.nan
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))

    def cost(self, x: Array) -> Array:
        """Ĵ (B,) of control vectors (B, n)."""
        return self._cost(self.coordinates.to(x))

    def _cost(self, z: Array) -> Array:
        basis = self.coordinates.basis(z)
        departure = self.of_prior @ basis[: self.of_prior.shape[1]]
        observed = np.minimum(self.observed(self.of_outputs @ basis), self.ceiling)
        return np.asarray(observed + _half_square(departure))

    def walk(self, x: Array, others: Array, random: np.random.Generator, rounds: int) -> list[Array]:
        """Positions (W, n) of walkers from ``x`` after each round, sampling exp(−Ĵ); ``others`` (W', n) stand still."""
        z, others = self.coordinates.to(x), self.coordinates.to(others)
        cost, positions = self._sum_of_squares() or self._cost, []
        costs = cost(z)
        for _ in range(rounds):
            z, costs = advance(cost, z, costs, others, random, PER_ROUND)
            positions.append(self.coordinates.back(z))
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
        return lambda z: _half_square(rows @ self.coordinates.basis(z))


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
    coordinates = _Coordinates.about(ensemble, degree)
    found = _run(run, prior, observations, coordinates.back(random.standard_normal((count, n))))
    if found is None or len(found[0].x) < 0.75 * count:
        return None
    runs, make = found
    emulator = _fit(prior, observations, coordinates, runs, make)
    kept, share = runs.x, math.nan
    walkers = kept[random.permutation(len(kept))[:WALKERS]]
    for _ in range(fits - 1):
        positions = emulator.walk(walkers, kept, random, SCATTERED)
        walkers, kept = positions[-1], np.concatenate(positions[SCATTERED // 2 :])
        found = _run(run, prior, observations, kept[np.linspace(0, len(kept) - 1, count).astype(int)])
        if found is None:
            return None
        new = found[0]
        share = effective_share(emulator.cost(new.x) - new.costs) * len(new.x) / count  # of the fit without them
        runs = runs.joined(new)
        emulator = _fit(prior, observations, coordinates, runs, make)
    settled = emulator.walk(walkers, kept, random, SETTLED)
    ceiling = float(np.min(runs.costs - _prior_cost(prior, runs.x))) + CEILING
    return replace(emulator, ceiling=ceiling, share=share, draws=np.concatenate(settled[SETTLED // 3 :]))


def _run(run: Run, prior: Prior, observations: Observations, x: Array) -> tuple[_Runs, Predicted] | None:
    """Run control vectors (B, n); the survivors, and of what make their outputs are. None: no survivor."""
    found = run(x)
    if not found.active.any():
        return None
    costs = _prior_cost(prior, x) + observations.cost(found.predicted)
    alive = found.active & np.isfinite(costs)
    return _Runs(x[alive], found.predicted.stacked[alive], costs[alive]), found.predicted[:0]


def _prior_cost(prior: Prior, x: Array) -> Array:
    z = (x - prior.mean) / prior.std
    return np.asarray(0.5 * (z * z).sum(axis=1))


def _fit(prior: Prior, observations: Observations, coordinates: _Coordinates, runs: _Runs, make: Predicted) -> Emulator:
    """Weighted least squares; a run whose J exceeds the lowest by the width of a posterior, 2n, counts half."""
    n = len(coordinates.centre)
    excess = (runs.costs - runs.costs.min()) / (2 * n)
    root_weight = 1 / np.sqrt(1 + excess**2)
    design = coordinates.basis(coordinates.to(runs.x)).T * root_weight[:, None]
    scale = np.sqrt(np.sum(design**2, axis=0))
    normal = (design / scale).T @ (design / scale)
    normal[np.diag_indices_from(normal)] += RIDGE
    right = (design / scale).T @ (runs.outputs * root_weight[:, None])
    coefficients = (np.linalg.solve(normal, right) / scale[:, None]).T
    of_prior = np.column_stack([coordinates.centre - prior.mean, coordinates.root]) / prior.std[:, None]
    if make.rates is not None or make.noise_scale is not None or math.isfinite(observations.noise.counts_within):

        def observed(outputs: Array) -> Array:
            return observations.cost(make.unstacked(outputs.T))

        return Emulator(coordinates, coefficients, of_prior, observed)
    # R is constant and J_o quadratic: the polynomials can be those of whitened residuals, of which C tell as much as K
    d, s = observations.whiten(Linearisation(Predicted(coefficients[:, 0]), coefficients[:, 1:].T))
    residuals = np.column_stack([d, -s])
    if len(residuals) > residuals.shape[1]:
        residuals = np.asarray(np.linalg.qr(residuals, mode="r"))
    return Emulator(coordinates, residuals, of_prior, _half_square)


def _half_square(residuals: Array) -> Array:
    """½ |v|² (B,) of residuals (K, B)."""
    return np.asarray(0.5 * np.einsum("kb,kb->b", residuals, residuals))


def _terms(n: int, degree: int) -> tuple[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]], ...]:
    terms = []
    last = list(range(n))  # the highest coordinate in each monomial
    for _ in range(2, degree + 1):
        pairs = [(i, j) for i, highest in enumerate(last) for j in range(highest, n)]
        terms.append((np.array([i for i, _ in pairs]), np.array([j for _, j in pairs])))
        last = [j for _, j in pairs]
    return tuple(terms)
