"""Gauss–Newton in arrow form: each experiment is linearised in its own few directions, the border is solved once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from en4dvar.descent.window import FAKED
from en4dvar.joint.arrow import Arrow
from en4dvar.joint.problem import JointProblem
from en4dvar.joint.tangent import Experiment, LocalForm
from en4dvar.state import Array

LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)  # of a step, tried in turn until J falls
WIDER = (5.0, 25.0)  # factors of the bundle where J does not fall along the step
SUFFICIENT = 1e-4  # share of the decrease that the gradient promises (Armijo)


@dataclass(frozen=True)
class Place:
    """A point of the joint control space in units of the prior: ``border`` (c,) and ``own`` (n_e,) each."""

    border: Array
    own: tuple[Array, ...]

    def moved(self, by: tuple[Array, Sequence[Array]], length: float) -> Place:
        """The point so much of a step away."""
        own = tuple(v + length * dv for v, dv in zip(self.own, by[1], strict=True))
        return Place(self.border + length * by[0], own)

    @property
    def background(self) -> float:
        """J_b."""
        return 0.5 * float(self.border @ self.border + sum(v @ v for v in self.own))


@dataclass(frozen=True)
class Joined:
    """J at a place, with each experiment's linearisation, the step from there and its length √(δᵀAδ)."""

    place: Place
    cost: float
    locals: tuple[LocalForm, ...]
    arrow: Arrow
    step: tuple[Array, list[Array]]
    norm: float


@dataclass
class JointDescent:
    """Where a descent ended, J of its iterations, and why it ended."""

    at: Joined
    costs: list[float] = field(default_factory=list)
    stop: str = ""
    converged: bool = False


def linearise(
    joint: JointProblem, experiments: Sequence[Experiment], place: Place, wider: float = 1.0
) -> Joined | None:
    """The arrow system of J at a place; None where an experiment cannot be run there."""
    found = []
    for e, experiment in enumerate(experiments):
        local = experiment.linearise(joint.standard(e, place.border, place.own[e]), wider)
        if local is None:
            return None
        found.append(local)
    arrow, slope, slopes = assembled(joint, [local.hessian for local in found], [local.gradient for local in found])
    slope = place.border + slope
    slopes = [v + b for v, b in zip(place.own, slopes, strict=True)]
    x, y = arrow.solve(-slope, [-b for b in slopes])
    decrease = -float(slope @ x + sum(b @ v for b, v in zip(slopes, y, strict=True)))
    cost = place.background + sum(local.cost for local in found)
    return Joined(place, cost, tuple(found), arrow, (x, y), float(np.sqrt(max(0.0, decrease))))


def assembled(
    joint: JointProblem, hessians: Sequence[Array], gradients: Sequence[Array]
) -> tuple[Arrow, Array, list[Array]]:
    """The arrow of the prior and the experiments' Hessians (n, n) of J_o; their gradients (n,) summed over what is
    shared, and what is each experiment's own.
    """
    border, slope = np.eye(len(joint.shared)), np.zeros(len(joint.shared))
    edges, blocks, slopes = [], [], []
    for e, (hessian, gradient) in enumerate(zip(hessians, gradients, strict=True)):
        (shared, rest), at = joint.columns(e), joint.of_border(e)
        np.add.at(slope, at, gradient[shared])
        np.add.at(border, np.ix_(at, at), hessian[np.ix_(shared, shared)])
        edge = np.zeros((len(border), len(rest)))
        edge[at] = hessian[np.ix_(shared, rest)]
        edges.append(edge)
        blocks.append(np.eye(len(rest)) + hessian[np.ix_(rest, rest)])
        slopes.append(gradient[rest])
    return Arrow(border, edges, blocks), slope, slopes


def cost(joint: JointProblem, experiments: Sequence[Experiment], place: Place) -> float:
    """J at a place."""
    total = place.background
    for e, experiment in enumerate(experiments):
        total += float(experiment.costs(joint.standard(e, place.border, place.own[e])[None])[0])
        if not np.isfinite(total):
            break
    return total


def descend(
    joint: JointProblem, experiments: Sequence[Experiment], start: Place, most: int, tolerance: float, fall: float
) -> JointDescent | None:
    """To a minimum of J, in at most so many iterations; None where the start cannot be run.

    It has converged where the step is shorter than ``tolerance`` posterior standard deviations or the decrease that it
    promises is below ``fall``, relative to J (absolute below 1).
    """
    at = linearise(joint, experiments, start)
    if at is None:
        return None
    found = JointDescent(at, [at.cost])
    for _ in range(most):
        if at.norm < tolerance or 0.5 * at.norm**2 < fall * max(1.0, at.cost):
            found.converged, found.stop = True, f"the next step is {at.norm:.1g} posterior standard deviations long"
            return found
        moved = _search(joint, experiments, at)
        for wider in WIDER:
            # a step of the model's own error: a wider bundle feels its jumps less
            if moved is None and (again := linearise(joint, experiments, at.place, wider)):
                at = found.at = again
                moved = _search(joint, experiments, at)
        ahead = linearise(joint, experiments, moved) if moved else None
        if ahead is None:
            found.converged = at.norm < FAKED
            found.stop = f"J does not fall along the step, of {at.norm:.1g} posterior standard deviations"
            return found
        at = found.at = ahead
        found.costs.append(at.cost)
    found.stop = f"{most} iterations"
    return found


def _search(joint: JointProblem, experiments: Sequence[Experiment], at: Joined) -> Place | None:
    """The first of the lengths at which J has fallen enough."""
    for length in LENGTHS:
        there = at.place.moved(at.step, length)
        if cost(joint, experiments, there) <= at.cost - SUFFICIENT * length * at.norm**2:
            return there
    return None
