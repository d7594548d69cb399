r"""A stand-in for J that costs nothing to evaluate: J of predictions emulated by polynomials of the control vector.

    m_k(x) ≈ Σ_a c_ka z^a,   z = W (x − x̄),   |a| ≤ degree

Within a posterior predictions bend little, so that a few hundred runs tell them to a small part of the observation
error. J is a sum of squares of residuals, and a cubic fitted to these runs gives it to a few tenths where J itself
varies by tens. The fit is weighted towards runs of low J and made twice: first at draws of the Gaussian posterior, then
with runs where the first emulator says the posterior is. The share of those runs that importance weights exp(Ĵ − J)
leave effective says how far Ĵ can be trusted.

Sources: polynomial surrogates of posteriors, Marzouk & Xiu (2009), Commun. Comput. Phys. 6, 826; sampling where the
surrogate says, Li & Marzouk (2014), SIAM J. Sci. Comput. 36, A1163.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular

from en4dvar.data.noise import Predicted
from en4dvar.diagnosis.diagnostics import effective_share
from en4dvar.ensemble.forecast import Forecast, costs
from en4dvar.model.state import DISCREPANCY, NOISE_SCALE, Array, Indices
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.sampling.walkers import advance

DEGREES = (3, 2)  # tried in this order
RUNS_PER_TERM = 4
FEWEST_RUNS, MOST_RUNS = 96, 512  # of one fit
ENOUGH_ALIVE = 0.75  # share of the first runs that must succeed
CEILING = 20.0  # above the lowest J_o of the runs, and ln of the prior's volume over the posterior's more
RIDGE = 1e-9
WALKERS = 300
SCATTERED, SETTLED = 6, 10  # rounds of the walkers before the second fit, after it
LONGER = 60  # rounds of walkers that go on
PER_ROUND = 10  # moves in a round
BLOCK = 128  # points whose monomials are in the processor's cache together: five times as fast

Run = Callable[[Array], Forecast]


class Coordinates(NamedTuple):
    """z = whiten (x − centre) of control vectors (B, n); ``root`` is the inverse of ``whiten``."""

    centre: Array
    root: Array
    whiten: Array

    @classmethod
    def about(cls, points: Array) -> "Coordinates":
        """Those in which points (N, n) have mean zero and standard deviation 1 in every direction."""
        root = np.linalg.cholesky(np.atleast_2d(np.cov(points, rowvar=False)))
        whiten = solve_triangular(root, np.eye(len(root)), lower=True)  # in which units do not matter
        return cls(points.mean(axis=0), np.asarray(root), np.asarray(whiten))

    def of(self, x: Array) -> Array:
        """z (B, n) of control vectors (B, n)."""
        return np.asarray((x - self.centre) @ self.whiten.T)

    def back(self, z: Array) -> Array:
        """Control vectors (B, n) of z (B, n)."""
        return np.asarray(self.centre + z @ self.root.T)


class Emulator(NamedTuple):
    """Polynomials of ``coordinates``: ``coefficients`` (M, K) of the monomials of ``parents``."""

    coordinates: Coordinates
    parents: npt.NDArray[np.int64]
    coefficients: Array

    @classmethod
    def fitted(
        cls, coordinates: Coordinates, degree: int, x: Array, outputs: Array, counts: Array, ridge: float
    ) -> "Emulator":
        """Least squares on runs at ``x`` (B, n) that gave ``outputs`` (B, K) and count so much (B,).

        ``ridge`` is relative to the normal equations of scaled columns: it decides where runs leave a coefficient open.
        """
        parents = monomials(x.shape[1], degree)
        matrix = np.ascontiguousarray(basis(coordinates.of(x), parents).T)
        weighted = matrix * counts[:, None]
        normal = weighted.T @ matrix
        scale = np.sqrt(np.diag(normal))
        normal = normal / np.outer(scale, scale)
        normal[np.diag_indices_from(normal)] += ridge
        coefficients = np.linalg.solve(normal, (weighted.T @ outputs) / scale[:, None]) / scale[:, None]
        return cls(coordinates, parents, np.asarray(coefficients))

    def predictions(self, x: Array) -> Array:
        """Outputs (B, K) at control vectors (B, n)."""
        z = self.coordinates.of(x)
        outputs = np.empty((len(z), self.coefficients.shape[1]))
        for at in range(0, len(z), BLOCK):
            outputs[at : at + BLOCK] = basis(z[at : at + BLOCK], self.parents).T @ self.coefficients
        return outputs


def monomials(n: int, degree: int) -> npt.NDArray[np.int64]:
    """(M, 2) of the monomials in n coordinates up to ``degree``, in order of degree; the first is 1.

    Monomial j is monomial ``[j, 0]`` times coordinate ``[j, 1]``.
    """
    index: dict[tuple[int, ...], int] = {(): 0}
    parents = [(0, 0)]
    for d in range(1, degree + 1):
        for combination in itertools.combinations_with_replacement(range(n), d):
            index[combination] = len(parents)
            parents.append((index[combination[:-1]], combination[-1]))
    return np.array(parents, dtype=np.int64)


def basis(z: Array, parents: npt.NDArray[np.int64]) -> Array:
    """Monomials (M, B) of points (B, n), all of one degree at a time."""
    values = np.empty((len(parents), len(z)))
    values[0] = 1.0
    begin = 1
    while begin < len(parents):
        end = int(np.searchsorted(parents[:, 0], begin))  # what is multiplied lies before
        np.multiply(values[parents[begin:end, 0]], z.T[parents[begin:end, 1]], out=values[begin:end])
        begin = end
    return values


@dataclass(frozen=True)
class Bend:
    """x ↦ ln(1 + exp(x − ``about``)) of those coordinates (n,) of which ``about`` is no NaN.

    They are the logarithms of what acts on the predictions: what a positive parameter does vanishes with it, and so
    does the slope of this, while a polynomial of the logarithm grows.
    """

    about: Array

    @classmethod
    def of(cls, prior: Prior, points: Array) -> "Bend":
        """About the mean of points (B, n). Parameters of errors, whose logarithms are emulated, stay as they are."""
        of_errors = {p.name for p in (NOISE_SCALE, *DISCREPANCY)}
        bent = [t.transform == "lognormal" and t.parameter.name not in of_errors for t in prior.terms]
        return cls(np.where(bent, points.mean(axis=0), np.nan))

    def __call__(self, x: Array) -> Array:
        bent, of_it = ~np.isnan(self.about), np.array(x)
        of_it[:, bent] = np.logaddexp(0.0, x[:, bent] - self.about[bent])
        return of_it


@dataclass(frozen=True)
class EmulatedCost:
    """Ĵ (B,) of control vectors (B, n): J of a ``problem``, of the predictions (and rates, ln σ) of ``emulator``, a
    polynomial of what ``bend`` makes of them.

    J_o is cut at ``ceiling``: far from its runs a polynomial says only that J is large, and a walker that true J lets
    in there must find its way out. All of the prior at that J_o has about e^−20 of the posterior's probability.
    ``share`` is the effective share of the runs that judge it, ``draws`` (S, n) are of exp(−Ĵ). Outputs are stacked as
    those of ``make``.
    """

    emulator: Emulator
    bend: Bend
    problem: InverseProblem
    make: Predicted
    ceiling: float = math.inf
    share: float = math.nan
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))

    def cost(self, x: Array) -> Array:
        """Ĵ (B,) of control vectors (B, n)."""
        observed = self.problem.observations.cost(self.make.unstacked(self.emulator.predictions(self.bend(x))))
        return np.minimum(observed, self.ceiling) + self.problem.prior.cost(x)

    def settled(self, random: np.random.Generator) -> "EmulatedCost":
        """With draws of the walkers after :data:`LONGER` more rounds: where the posterior is bent, those of a hundred
        moves from a Gaussian were up to 40 % too narrow.
        """
        walkers = len(self.draws) // (SETTLED - SETTLED // 3)
        positions = self.walk(self.draws[-walkers:], self.draws, random, LONGER)
        return replace(self, draws=np.concatenate(positions[LONGER // 3 :]))

    def walk(self, x: Array, others: Array, random: np.random.Generator, rounds: int) -> list[Array]:
        """Positions (W, n) of walkers from ``x`` after each round, sampling exp(−Ĵ); ``others`` (W', n) stand still."""
        costs, positions = self.cost(x), []
        for _ in range(rounds):
            x, costs = advance(self.cost, x, costs, others, random, PER_ROUND)
            positions.append(x)
        return positions


@dataclass(frozen=True)
class ModelRuns:
    """Members that could be run: control vectors (B, n), outputs (B, Ky) of the make of ``make``, J (B,)."""

    x: Array
    outputs: Array
    costs: Array
    make: Predicted

    @classmethod
    def of(cls, x: Array, outcome: Forecast, costs: Array) -> "ModelRuns":
        """Those of control vectors (B, n) and J (B,) that could be run."""
        alive = outcome.active & np.isfinite(costs)
        return cls(x[alive], outcome.predicted.stacked[alive], costs[alive], outcome.predicted[:0])

    def __getitem__(self, chosen: Indices) -> "ModelRuns":
        return replace(self, x=self.x[chosen], outputs=self.outputs[chosen], costs=self.costs[chosen])

    def joined(self, other: "ModelRuns") -> "ModelRuns":
        x, outputs = np.concatenate([self.x, other.x]), np.concatenate([self.outputs, other.outputs])
        return replace(self, x=x, outputs=outputs, costs=np.concatenate([self.costs, other.costs]))


def needed_runs(n_parameters: int) -> tuple[int, int] | None:
    """(Degree, runs of one fit) for so many parameters; None where there are too many of them."""
    for degree in DEGREES:
        runs = RUNS_PER_TERM * math.comb(n_parameters + degree, degree)
        if runs <= MOST_RUNS:
            return degree, max(FEWEST_RUNS, runs)
    return None


def emulate(
    run: Run, problem: InverseProblem, ensemble: Array, random: np.random.Generator, fits: int = 2
) -> EmulatedCost | None:
    """Ĵ about a Gaussian ensemble (N, n), transformed, with draws of it.

    Each of the ``fits`` takes the :func:`needed_runs` of the model through ``run``, from the second on where the one
    before says the posterior is. None where there are too many parameters for polynomials, or so many runs fail that
    the rest does not determine them.
    """
    prior, n = problem.prior, ensemble.shape[1]
    wanted = needed_runs(n)
    if wanted is None or len(ensemble) <= n:
        return None
    degree, count = wanted
    coordinates = Coordinates.about(ensemble)
    runs = _run(run, problem, coordinates.back(random.standard_normal((count, n))))
    if len(runs.x) < ENOUGH_ALIVE * count:
        return None
    emulated = fitted_cost(problem, degree, runs, 2 * n)
    kept, share = runs.x, math.nan
    walkers = kept[random.permutation(len(kept))[:WALKERS]]
    for _ in range(fits - 1):
        positions = emulated.walk(walkers, kept, random, SCATTERED)
        walkers, kept = positions[-1], np.concatenate(positions[SCATTERED // 2 :])
        new = _run(run, problem, kept[np.linspace(0, len(kept) - 1, count).astype(int)])
        if not len(new.x):
            return None
        share = effective_share(emulated.cost(new.x) - new.costs) * len(new.x) / count  # of the fit without them
        runs = runs.joined(new)
        emulated = fitted_cost(problem, degree, runs, 2 * n)
    settled = emulated.walk(walkers, kept, random, SETTLED)
    narrowed = prior.log_det_root - np.linalg.slogdet(coordinates.root)[1]
    ceiling = float(np.min(runs.costs - prior.cost(runs.x)) + CEILING + max(0.0, narrowed))
    return replace(emulated, ceiling=ceiling, share=share, draws=np.concatenate(settled[SETTLED // 3 :]))


def _run(run: Run, problem: InverseProblem, x: Array) -> ModelRuns:
    """Run control vectors (B, n); the survivors."""
    outcome = run(x)
    return ModelRuns.of(x, outcome, costs(problem, x, outcome))


def fitted_cost(problem: InverseProblem, degree: int, runs: ModelRuns, near: float) -> EmulatedCost:
    """Ĵ fitted to runs; one whose J exceeds the lowest by ``near`` counts half."""
    excess, bend = (runs.costs - runs.costs.min()) / near, Bend.of(problem.prior, runs.x)
    x = bend(runs.x)
    emulator = Emulator.fitted(Coordinates.about(x), degree, x, runs.outputs, 1 / (1 + excess**2), RIDGE)
    return EmulatedCost(emulator, bend, problem, runs.make)
