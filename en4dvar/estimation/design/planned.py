r"""An experiment that is planned: its runs, in coordinates in which the prior is N(0, I) and what is asked is first;
and its expected information by linearisation, averaged over the prior.

At a draw u of the prior with the whitened sensitivities S of the readings the posterior is about N(·, M⁻¹),
M = I + SᵀS, and what it says of what is asked is the Schur complement M_a = M_aa − M_ab M_bb⁻¹ M_ba,

    I ≈ E_u[½ ln det M_a(u)],

exact where F and H are linear (Long, Scavino, Tempone & Wang 2013, Comput. Methods Appl. Mech. Eng. 259, 24). n
experiments alike share s, what is asked and what is common to them, such as a scale: each adds M_s − I, and what is
common is left out at the end, I ≈ E[½ ln det (I + n (M_s − I))_a].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.data.noise import Linearisation
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast
from en4dvar.model.state import Array, Indices
from en4dvar.plumbing.errors import ConfigError, TooFewMembersError
from en4dvar.priors.prior import standard_normal
from en4dvar.problem import InverseProblem

EPSILON = 1e-3  # size of a bundle, in prior standard deviations
FEWEST = 0.5  # of the draws must be alive


class Planned:
    """An inverse problem whose observations say when and how well it will be measured; their values mean nothing.

    ``about``: names of the parameters that are asked for, all by default; ``common``: of others that experiments alike
    share with each other. Coordinates u (…, n): x = mean + W u, W Wᵀ the prior covariance, W lower triangular in the
    order (asked, common, others), so that the first ``asked`` of them are those of what is asked for, whatever the
    others are, and the first ``shared`` those of what experiments share.

    Raises ConfigError: a name that is not estimated, or twice; weights other than 0 and 1, which are not Bayesian;
    whole fields.
    """

    def __init__(self, problem: InverseProblem, about: Sequence[str] = (), common: Sequence[str] = ()):
        if problem.fields:
            raise ConfigError(
                "whole fields cannot be planned for; without assimilation.localisation a field of at most 2000 cells "
                "is planned by its modes"
            )
        names = problem.prior.names
        about, common = tuple(about) or names, tuple(common)
        if unknown := [name for name in (*about, *common) if name not in names]:
            raise ConfigError(f"{', '.join(unknown)}: not estimated; estimated are {', '.join(names)}")
        first = (*about, *common)
        if len(set(first)) < len(first):
            raise ConfigError(f"{', '.join(first)}: a name is given twice")
        if not np.isin(problem.observations.weights, (0, 1)).all():
            raise ConfigError("weights other than 0 and 1 are not Bayesian: there is no expected information of them")
        self.problem, self.about, self.asked, self.shared = problem, about, len(about), len(first)
        self.composite = Composite(problem)
        order = [names.index(name) for name in (*first, *(name for name in names if name not in first))]
        half = problem.prior.from_white_change(np.eye(len(names)))
        covariance = (half.T @ half)[np.ix_(order, order)]
        self.root = np.empty((len(names), len(names)))
        self.root[order] = np.linalg.cholesky(covariance)
        self.names = tuple(names[j] for j in order)
        self.order = order
        self.forward_runs = 0

    def draws(self, count: int, seed: int) -> Array:
        """(count, n) of the prior; the numbers belong to the parameters, so that designs are compared on the same."""
        return np.column_stack([standard_normal(seed, f"design {name}", count) for name in self.names])

    def control(self, u: Array) -> Array:
        """Control vectors (…, n) of coordinates."""
        return np.asarray(self.problem.prior.mean + u @ self.root.T)

    def run(self, u: Array, grid: Array = NO_TIMES) -> Forecast:
        """Coordinates (B, n) through F and H."""
        self.forward_runs += len(u)
        return self.composite(self.control(u), grid)

    def cost(self, values: Array, run: Forecast) -> Array:
        """J_o (B,) of readings (K,) for runs; +inf where one has failed."""
        return replace(self.problem.observations, values=values).cost(run.predicted)

    def tangents(self, u: Array, run: Forecast | None = None) -> "Tangents":
        """At points (R, n), by n runs beside each; those where one fails are left out."""
        count, n = u.shape
        run = run or self.run(u)
        beside = self.run((u[:, None] + EPSILON * np.eye(n)).reshape(-1, n))
        stacked = run.predicted.stacked
        change = (beside.predicted.stacked.reshape(count, n, -1) - stacked[:, None]) / EPSILON
        alive = np.flatnonzero(np.isfinite(stacked).all(axis=1) & np.isfinite(change).all(axis=(1, 2)))
        where = [Linearisation.of_stacked(run.predicted[int(i)], stacked[i], change[i]) for i in alive]
        return Tangents(alive, u[alive], tuple(where))


@dataclass(frozen=True)
class Tangents:
    """Linearisations at points ``u`` (R, n); ``alive`` (R,) are their numbers among the points that were asked for."""

    alive: Indices
    u: Array
    at: tuple[Linearisation, ...]

    def some(self, which: Sequence[int]) -> "Tangents":
        """At some of the points."""
        chosen = list(which)
        return Tangents(self.alive[chosen], self.u[chosen], tuple(self.at[k] for k in chosen))

    def whitened(self, planned: Planned, values: Array | None = None) -> tuple[Array, Array]:
        """Innovations d (R, K') and sensitivities S (R, K', n) for readings (R, K); by default those predicted.

        Of errors with parameters of their own points have different numbers of rows; rows of zeros, which say nothing,
        make them equal.
        """
        observations = planned.problem.observations
        each = [predicted.prediction.values for predicted in self.at] if values is None else values
        parts = [
            observations.noise.whiten(y, observations.weights, predicted)
            for y, predicted in zip(each, self.at, strict=True)
        ]
        most = max((len(d) for d, _ in parts), default=0)
        return (
            np.stack([np.pad(d, (0, most - len(d))) for d, _ in parts]),
            np.stack([np.pad(s, ((0, most - len(s)), (0, 0))) for _, s in parts]),
        )


@dataclass(frozen=True)
class Gains:
    """``gains`` (R,) of the draws, nats."""

    gains: Array

    @property
    def gain(self) -> float:
        """Expected information, nats."""
        return float(self.gains.mean())

    @property
    def error(self) -> float:
        """Monte Carlo standard error of :attr:`gain`."""
        return standard_error(self.gains)


@dataclass(frozen=True)
class Expected(Gains):
    """By linearisation; posterior ``std`` (R, a) of what is asked, in transformed space, relative to the prior's;
    ``lost``: share of the draws at which the model fails.
    """

    std: Array
    lost: float


def standard_error(values: Array) -> float:
    """Standard error of the mean of independent values (R,)."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def expected(planned: Planned, tangents: Tangents, count: int, alike: int = 1) -> Expected:
    """Expected information of ``alike`` experiments, from tangents at those of ``count`` draws that can be run."""
    require_alive(len(tangents.at), count)
    _, rows = tangents.whitened(planned)
    asked, ratio = shared_spread(planned, np.einsum("rki,rkj->rij", rows, rows), alike)
    return Expected(0.5 * np.linalg.slogdet(asked)[1], ratio, 1 - len(tangents.at) / count)


def shared_spread(
    planned: Planned, information: Array, alike: int, precision: Array | None = None
) -> tuple[Array, Array]:
    """What ``alike`` experiments of information SᵀS (R, n, n) each leave: the precision (R, a, a) of what is asked, and
    its std (R, a) in transformed space, relative to the prior's; with another prior ``precision`` (n, n) than I.
    """
    prior = np.eye(information.shape[2])[None] if precision is None else precision[None]
    before, after = (about(each, planned.shared) for each in (prior, prior + information))
    asked, a = about(before + alike * (after - before), planned.asked), planned.asked
    root = planned.root[planned.order][:a, :a]
    spread = np.sqrt(np.einsum("ij,rjk,ik->ri", root, np.linalg.inv(asked), root))
    return asked, spread / np.sqrt(np.einsum("ij,ij->i", root, root))


def precision(rows: Array) -> Array:
    """I + SᵀS (R, n, n) of sensitivities (R, K', n)."""
    return np.asarray(np.eye(rows.shape[2]) + np.einsum("rki,rkj->rij", rows, rows))


def about(matrices: Array, asked: int) -> Array:
    """Schur complements (R, a, a) of precision matrices (R, n, n): the precision of the first a coordinates."""
    if asked == matrices.shape[2]:
        return matrices
    mixed = matrices[:, :asked, asked:]
    return np.asarray(
        matrices[:, :asked, :asked] - mixed @ np.linalg.solve(matrices[:, asked:, asked:], mixed.transpose(0, 2, 1))
    )


def require_alive(alive: int, count: int) -> None:
    """Raise :class:`TooFewMembersError` unless half of the draws are alive."""
    if alive < FEWEST * count or not alive:
        raise TooFewMembersError(f"the model fails at {count - alive} of {count} draws of the prior")
