"""J of several data sets: each experiment is linearised in its own few directions, what is shared is solved once."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from en4dvar.descent.loop import Objective
from en4dvar.descent.step_control import SUFFICIENT, Move, Search
from en4dvar.descent.window import FAKED, WIDER, WIDEST
from en4dvar.estimation.joint.arrow import Arrow
from en4dvar.estimation.joint.problem import JointProblem
from en4dvar.estimation.joint.tangent import Experiment, Linearised
from en4dvar.model.state import Array
from en4dvar.schemes.base import Minimiser

LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)  # of a step, tried in turn until J falls


@dataclass(frozen=True)
class Place:
    """A point of the joint control space in units of the prior: ``border`` (c,) and ``own`` (n_e,) each."""

    border: Array
    own: tuple[Array, ...]

    def moved(self, by: tuple[Array, Sequence[Array]], length: float) -> "Place":
        """The point so much of a step away."""
        own = tuple(v + length * dv for v, dv in zip(self.own, by[1], strict=True))
        return Place(self.border + length * by[0], own)

    @property
    def background(self) -> float:
        """J_b."""
        return 0.5 * float(self.border @ self.border + sum(v @ v for v in self.own))


@dataclass(frozen=True)
class ArrowSystem:
    """J at a place, with each experiment's linearisation, and the ``slope`` of J in what is shared and what is own."""

    place: Place
    cost: float
    forms: tuple[Linearised, ...]
    arrow: Arrow
    slope: tuple[Array, list[Array]]

    @property
    def own_costs(self) -> Array:
        """(E,) J_o of each experiment, and J_b of what is its own."""
        return np.array([form.cost + 0.5 * float(v @ v) for form, v in zip(self.forms, self.place.own, strict=True)])

    def chi2(self, joint: JointProblem) -> Array:
        """(E,) misfit per observation of each experiment."""
        of_each = zip(joint.experiments, self.forms, strict=True)
        return np.array([float(p.observations.chi2_per_observation(f.central.predicted)[0]) for p, f in of_each])

    @cached_property
    def direction(self) -> tuple[Array, list[Array]]:
        """The step of Gauss and Newton, in border and own quantities."""
        a, b = self.slope
        return self.arrow.solve(-a, [-own for own in b])

    @cached_property
    def norm(self) -> float:
        """The length √(δᵀAδ) of that step in posterior standard deviations."""
        (a, b), (x, y) = self.slope, self.direction
        decrease = -float(a @ x + sum(own @ v for own, v in zip(b, y, strict=True)))
        return float(np.sqrt(max(0.0, decrease)))


@dataclass
class JointDescent:
    """A descent: the ``place`` where it goes on, the ``system`` where it was linearised last, by a bundle that is
    ``wider``, and the length of the step from there, J of its iterates, and why it ended. ``step``: the system of the
    iteration under way, None where there is none."""

    place: Place
    system: ArrowSystem | None = None
    wider: float = 1.0
    norm: float = np.inf
    costs: list[float] = field(default_factory=list)
    step: ArrowSystem | None = None
    stop: str = ""
    converged: bool = False
    ended: bool = False

    @property
    def at(self) -> ArrowSystem:
        """Where it stands, once the runs are there."""
        assert self.system is not None
        return self.system


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


class JointObjective(Objective[JointDescent]):
    """J of a joint problem, of which no run is kept: each descent is short."""

    def __init__(self, joint: JointProblem, experiments: Sequence[Experiment], scheme: Minimiser):
        self.joint, self.experiments, self.scheme = joint, experiments, scheme

    def linearise(self, going: Sequence[JointDescent]) -> list[ArrowSystem | None]:
        systems = [self._system(descent) for descent in going]
        for descent, system in zip(going, systems, strict=True):
            descent.system = system or descent.system
        return systems

    def _system(self, descent: JointDescent) -> ArrowSystem | None:
        """None where an experiment cannot be run there."""
        place, before, forms = descent.place, descent.system, list[Linearised]()
        for e, experiment in enumerate(self.experiments):
            hessian = before.forms[e].hessian if before else None
            z = self.joint.standard(e, place.border, place.own[e])
            form = experiment.linearise(z, descent.wider, hessian)
            if form is None:
                return None
            forms.append(form)
        arrow, slope, slopes = assembled(self.joint, [f.hessian for f in forms], [f.gradient for f in forms])
        whole = place.border + slope, [v + b for v, b in zip(place.own, slopes, strict=True)]
        return ArrowSystem(place, place.background + sum(f.cost for f in forms), tuple(forms), arrow, whole)

    def judge(self, going: Sequence[JointDescent]) -> None:
        """A descent has converged where the step is shorter than the tolerance, in posterior standard deviations, or
        the decrease that it promises is below that of J, relative to J (absolute below 1)."""
        for descent in going:
            if descent.step is None:
                self._no_decrease(descent)
                continue
            scheme, cost = self.scheme, descent.at.cost
            descent.norm = norm = descent.step.norm
            if descent.wider == 1:
                descent.costs.append(cost)
            if norm < scheme.step_tolerance or 0.5 * norm**2 < scheme.cost_tolerance * max(1.0, cost):
                descent.converged = True
                descent.stop = f"the next step is {norm:.1g} posterior standard deviations long"
            elif len(descent.costs) > scheme.max_iterations:
                descent.stop = f"{scheme.max_iterations} iterations"
            descent.ended = bool(descent.stop)

    def search(self, descent: JointDescent) -> Search:
        """The first of the lengths at which J has fallen enough."""
        at = descent.at
        for length in LENGTHS:
            there = at.place.moved(at.direction, length)
            cost = yield [there]
            if cost <= at.cost - SUFFICIENT * length * at.norm**2:
                return Move(there, cost, length)
        return None

    def try_out(self, candidates: Sequence[Place]) -> float:
        """J at the one candidate there is."""
        (place,) = candidates
        return cost(self.joint, self.experiments, place)

    def move(self, going: Sequence[JointDescent], moves: Sequence[Move | None]) -> None:
        for descent, move in zip(going, moves, strict=True):
            if move is not None:
                descent.place, descent.wider = move.w, 1.0
            elif descent.wider < WIDEST:  # a step of the model's own error: a wider bundle feels its jumps less
                descent.wider *= WIDER
            else:
                self._no_decrease(descent)

    def _no_decrease(self, descent: JointDescent) -> None:
        descent.ended, descent.converged = True, descent.norm < FAKED
        descent.stop = f"J does not fall along the step, of {descent.norm:.1g} posterior standard deviations"


def cost(joint: JointProblem, experiments: Sequence[Experiment], place: Place) -> float:
    """J at a place."""
    total = place.background
    for e, experiment in enumerate(experiments):
        total += float(experiment.costs(joint.standard(e, place.border, place.own[e])[None])[0])
        if not np.isfinite(total):
            break
    return total
