"""Where descents ended: minima of J, as far as a rough descent tells, and the Gaussians about them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from en4dvar.descent.weight_space import WeightSpace
from en4dvar.descent.window import Descent
from en4dvar.model.state import Array
from en4dvar.plumbing.caution import Caution
from en4dvar.priors.prior import Prior
from en4dvar.schemes.base import GaussNewtonStep

AGREE = 2  # descents from different members that must have ended in the lowest minimum
UNSEEN = 0.115  # chance of ending lower that settles a search: two descents that agree and one elsewhere do, 1/9
REACHED = 2.0  # posterior standard deviations between a minimum and a descent that ended in it
SLOPE = 4.0  # as many, within which one that ended early on the slope of a minimum is told from another minimum
WIDER = 10.0  # times as wide in the mean over directions, each of two Gaussians as the other: of another shape
BESIDE = 1e-3  # of the evidence of a minimum, which one of another shape must hold


@dataclass(frozen=True)
class Minimum:
    """A minimum ``x`` (n,) of J, transformed, the covariance (n, n) of the Gaussian about it, J there, the prior
    ``members`` from which descents ended in it (N: the prior mean), and by how much J of these differs.

    ``shapes``: the Gaussians, by their linearisations, of other descents that ended in it or of points on the way
    there, where these are utterly different: as of the other side of a kink, of which no descent may end.
    """

    x: Array
    covariance: Array
    cost: float
    members: tuple[int, ...] = ()
    spread: float = 0.0
    shapes: "tuple[Minimum, ...]" = ()

    @classmethod
    def of(cls, space: WeightSpace, end: Descent) -> "Minimum":
        """Where a descent has ended; the Hessian of J is known there or close by."""

        def about(w: Array, step: GaussNewtonStep, *more: Any) -> "Minimum":
            covariance = space.anomalies.T @ step.hessian.solve(space.anomalies.T).T
            return cls(space.control(w), np.asarray(covariance), *more)

        spread = max(0.0, end.highest - end.cost)
        shapes = tuple(about(step.w + step.direction, step, cost) for step, cost in end.passed)
        return about(end.weights.w, end.newton, end.cost, end.members, spread, shapes)

    @property
    def descents(self) -> int:
        """How many, from different members, ended in it."""
        return len(self.members)

    def distance(self, x: Array) -> float:
        """Of a control vector (n,), in posterior standard deviations."""
        apart = x - self.x
        return math.sqrt(max(0.0, float(apart @ self._precision @ apart)))

    def unlike(self, other: "Minimum") -> bool:
        """Whether the Gaussian about either is :data:`WIDER` than the other, and the other's evidence counts."""
        pairs, least = ((self, other), (other, self)), WIDER**2 * len(self.x)
        if any(np.sum(narrow._precision * wide.covariance) < least for narrow, wide in pairs):
            return False
        volumes = np.linalg.slogdet(other.covariance)[1] - np.linalg.slogdet(self.covariance)[1]
        return bool(self.cost - other.cost + 0.5 * volumes > math.log(BESIDE))

    @cached_property
    def _precision(self) -> Array:
        """(n, n), in any units; that of the directions that the covariance has, where some are lost to rounding."""
        std = np.sqrt(np.diag(self.covariance))
        sizes = np.outer(std, std) + np.finfo(float).tiny
        rounding = np.finfo(float).eps * len(self.x)
        return np.asarray(np.linalg.pinv(self.covariance / sizes, rcond=rounding, hermitian=True) / sizes)

    def log_evidence(self, prior: Prior) -> float:
        """Laplace's approximation of ln ∫ exp(−J_o) N(x; prior) dx over this minimum alone."""
        return float(-self.cost + 0.5 * np.linalg.slogdet(self.covariance)[1] - prior.log_det_root)


@dataclass(frozen=True)
class Outcome:
    """The lowest ``descent``, all minima, the lowest first, and the members that were ``tried``, from which descents
    started (N: the prior mean; beyond it draws that are no members).

    ``runs``: forward runs of a search of so many ``rounds``; ``warnings`` of the start.
    """

    descent: Descent
    minima: tuple[Minimum, ...] = ()
    tried: tuple[int, ...] = ()
    runs: int = 0
    rounds: int = 0
    warnings: tuple[Caution, ...] = ()

    @property
    def agreed(self) -> bool:
        """Whether descents from different members ended in the lowest minimum, and another would hardly end lower."""
        return self.minima[0].descents >= AGREE and self.unseen <= UNSEEN

    @property
    def unseen(self) -> float:
        """The chance that one more descent ends lower than the lowest minimum.

        That of a new minimum is the share of descents that ended alone (Good 1953, Biometrika 40, 237), and of all
        minima with the new one each is as likely the lowest.
        """
        ended = [minimum.descents for minimum in self.minima]
        return ended.count(1) / (sum(ended) * (1 + len(ended)))


def merged(minima: Sequence[Minimum]) -> tuple[Minimum, ...]:
    """One for each place, the lowest first: a minimum that lies within the reach of a lower one is the lower one.

    So is one on its slope, where J exceeds that of the lower one by half of what the Gaussian about it has there.
    """
    places: list[list[Minimum]] = []  # of each the lowest first
    for minimum in sorted(minima, key=lambda minimum: minimum.cost):
        for place in places:
            distance = place[0].distance(minimum.x)
            on_slope = distance < SLOPE and minimum.cost - place[0].cost > 0.25 * distance**2
            if distance < REACHED or on_slope:
                place.append(minimum)
                break
        else:
            places.append([minimum])
    return tuple(_as_one(*place) if len(place) > 1 or place[0].shapes else place[0] for place in places)


def _as_one(lowest: Minimum, *others: Minimum) -> Minimum:
    spread = max([lowest.spread, *(minimum.cost + minimum.spread - lowest.cost for minimum in others)])
    members = {*lowest.members, *(member for minimum in others for member in minimum.members)}
    shapes = list[Minimum]()
    for other in (shape for minimum in (lowest, *others) for shape in (minimum, *minimum.shapes)):
        if all(shape.unlike(other) for shape in (lowest, *shapes)):
            shapes.append(replace(other, shapes=()))
    return replace(lowest, members=tuple(sorted(members)), spread=spread, shapes=tuple(shapes))
