"""J of several data sets: each experiment is linearised in its own few directions, by runs close to a place; what is
shared is solved once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from en4dvar.data.noise import Linearisation
from en4dvar.descent.loop import Descends, Objective
from en4dvar.descent.step_control import SUFFICIENT, Move, Search
from en4dvar.descent.window import FAKED, WIDER, WIDEST
from en4dvar.ensemble.forecast import NO_TIMES, Composite, Forecast
from en4dvar.ensemble.linalg import bundle_steps
from en4dvar.ensemble.missing import Beside
from en4dvar.estimation.joint.problem import JointProblem
from en4dvar.executor import Executor
from en4dvar.model.state import Array
from en4dvar.plumbing.hints import counted
from en4dvar.priors.prior import whiten_sample
from en4dvar.schemes.base import Minimiser

LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01)  # of a step, tried in turn until J falls
CLOSE = 0.3  # posterior standard deviations: own quantities that a step moves no further have settled
STAGES, STEPS = 4, 8  # on the way to what is shared; linearisations at each that own quantities given it are sought by
LONGEST = 40.0  # step in prior standard deviations of one experiment, as of a data set alone (step_control.py)


@dataclass(frozen=True)
class Arrow:
    r"""A symmetric positive definite matrix of arrow form: a border that all blocks share, and blocks of their own.

        [ A    B_1 … B_E ]        S  = A − Σ_e B_e C_e⁻¹ B_eᵀ
        [ B_1ᵀ C_1       ]        x  = S⁻¹ (a − Σ_e B_e C_e⁻¹ b_e)
        [ …          C_E ]        y_e = C_e⁻¹ (b_e − B_eᵀ x)

    ``border`` A (c, c); for each of E experiments ``edges`` B_e (c, n_e) and ``blocks`` C_e (n_e, n_e). Any n_e may be
    0. The cost grows with the number of blocks, not with its square.
    """

    border: Array
    edges: Sequence[Array]
    blocks: Sequence[Array]

    @cached_property
    def schur(self) -> Array:
        """S (c, c): the precision of the border with all blocks eliminated."""
        passed = (edge @ self._solve(e, edge.T) for e, edge in enumerate(self.edges))
        return np.asarray(self.border - sum(passed, start=np.zeros_like(self.border)))

    @property
    def log_determinant(self) -> float:
        """ln det of the whole matrix."""
        own = sum(2 * float(np.log(np.diag(factor[0])).sum()) for factor in self._factors)
        return own + float(np.linalg.slogdet(self.schur)[1])

    def solve(self, a: Array, b: Sequence[Array]) -> tuple[Array, list[Array]]:
        """x (c,) and y_e (n_e,) for the right-hand side a (c,), b_e (n_e,)."""
        passed = (edge @ self._solve(e, b[e]) for e, edge in enumerate(self.edges))
        a = a - sum(passed, start=np.zeros_like(a))
        x = np.asarray(np.linalg.solve(self.schur, a))
        return x, [self._solve(e, b[e] - edge.T @ x) for e, edge in enumerate(self.edges)]

    def sample(self, border: Array, own: Callable[[int], Array]) -> tuple[Array, list[Array]]:
        """N draws of the Gaussian of mean zero with this precision: border (N, c), and (N, n_e) of each experiment.

        ``border``: (N, c) standard normal numbers; own: gives those (N, n_e) of an experiment by its number.

        Mean and covariance of the N draws of every pair (border, experiment) are exact. Those of different experiments
        are independent given the border, up to what N draws correlate by chance.

        Raises ValueError: N is not larger than c + n_e.
        """
        x = solve_triangular(np.linalg.cholesky(self.schur).T, whiten_sample(border).T).T
        return x, [self._own(e, edge, x, border, own(e)) for e, edge in enumerate(self.edges)]

    def _own(self, e: int, edge: Array, x: Array, border: Array, numbers: Array) -> Array:
        """Draws of an experiment's own quantities given those of the border."""
        count, size = len(x), edge.shape[0] + edge.shape[1]
        if count <= size:
            raise ValueError(f"{count} draws are too few for {size} quantities; at least {size + 1}")
        standard = whiten_sample(np.hstack([border, numbers]))[:, edge.shape[0] :]  # orthogonal to the border's
        factor = self._factors[e][0]
        return np.asarray(solve_triangular(factor, standard.T).T - self._solve(e, edge.T @ x.T).T)

    def _solve(self, e: int, right: Array) -> Array:
        return np.asarray(cho_solve(self._factors[e], right)) if len(right) else right

    @cached_property
    def _factors(self) -> list[tuple[Array, bool]]:
        return [cho_factor(block) if len(block) else (block, False) for block in self.blocks]


@dataclass(frozen=True)
class Linearised:
    """J_o at a point, its gradient (n,) and Gauss–Newton Hessian (n, n) in units of the prior, and the central run."""

    cost: float
    gradient: Array
    hessian: Array
    central: Forecast


class Experiment:
    """The runs of experiment ``e``: J_o of control vectors, and its linearisation."""

    def __init__(self, joint: JointProblem, e: int, epsilon: float, executor: Executor):
        self.joint, self.e, self.epsilon = joint, e, epsilon
        self.problem = joint.experiments[e]
        self.composite = Beside(Composite(self.problem, executor), self.problem.prior, epsilon)

    def run(self, z: Array, grid: Array = NO_TIMES) -> Forecast:
        """Control vectors (B, n) in units of the prior."""
        return self.composite(self.problem.prior.from_white(z), grid)

    def costs(self, z: Array) -> Array:
        """J_o (B,) of control vectors (B, n) in units of the prior; +inf where the model fails."""
        return self.problem.observations.cost(self.run(z).predicted)

    def linearise(self, z: Array, wider: float = 1.0, hessian: Array | None = None) -> Linearised | None:
        """At z (n,), by n runs beside it; None where it or too many of them fail.

        A run that fails is replaced by the one on the other side. A bundle that is ``wider`` has runs on both sides.
        The ``hessian`` (n, n) of J_o at the place before tells its steps (:func:`bundle_steps`).
        """
        size, steps = self.epsilon * wider, np.eye(len(z))
        if hessian is not None:
            precision, axes = np.linalg.eigh(steps + hessian)
            steps = bundle_steps(1 / np.sqrt(precision), axes, self.epsilon)
        observations, step = self.problem.observations, size * steps
        run = self.run(np.vstack([z, z + step]))
        stacked = run.predicted.stacked
        change = (stacked[1:] - stacked[0]) / size
        again = ~np.isfinite(change).all(axis=1) | (wider > 1)
        if again.any():
            behind = (stacked[0] - self.run(z - step[again]).predicted.stacked) / size
            ahead = change[again]
            both = 0.5 * (ahead + behind)
            change[again] = np.where(np.isfinite(both), both, np.where(np.isfinite(ahead), ahead, behind))
        cost = float(observations.cost(run.predicted)[0])
        if not (np.isfinite(cost) and np.isfinite(change).all()):
            return None
        tangent = np.linalg.solve(steps, change)
        d, S = observations.whiten(Linearisation.of_stacked(run.predicted[0], stacked[0], tangent))
        return Linearised(cost, -S.T @ d, S.T @ S, run[:1])

    def linearise_own(self, z: Array, columns: list[int]) -> tuple[Array, Array, Array]:
        """J_o (M,), its gradient (M, k) and Gauss–Newton Hessian (M, k, k) in k ``columns`` alone, at places (M, n).

        They are NaN where a run fails.
        """
        size, k, observations = self.epsilon, len(columns), self.problem.observations
        beside = z[:, None] + size * np.vstack([np.zeros(z.shape[1]), np.eye(z.shape[1])[columns]])
        run = self.run(beside.reshape(-1, z.shape[1]))
        stacked = run.predicted.stacked.reshape(len(z), k + 1, -1)
        cost = observations.cost(run.predicted)[:: k + 1]
        gradient, hessian = np.full((len(z), k), np.nan), np.full((len(z), k, k), np.nan)
        for i in np.flatnonzero(np.isfinite(cost) & np.isfinite(stacked).all(axis=(1, 2))).tolist():
            change = (stacked[i, 1:] - stacked[i, 0]) / size
            d, S = observations.whiten(Linearisation.of_stacked(run.predicted[i * (k + 1)], stacked[i, 0], change))
            gradient[i], hessian[i] = -S.T @ d, S.T @ S
        return cost, gradient, hessian

    def settled(self, border: Array, start: Array, precision: Array, steps: int) -> tuple[Array, Array, Array]:
        """The own quantities that J is low at, given what is shared (M, c): Gauss–Newton from ``start`` (M, n_e).

        Where J has not fallen the step is halved. Returns the lowest places (M, n_e), their precision (M, n_e, n_e), or
        the one given where no run lives, and J_o + J_b of the own quantities (M,) there, +inf where no run lives.
        """
        columns, going = self.joint.columns(self.e)[1], np.arange(len(start))
        lowest, mean, step = np.full(len(start), np.inf), start.copy(), np.zeros_like(start)
        precision = precision.copy()
        while steps and len(going):
            steps, there = steps - 1, mean[going] - step[going]
            z = self.joint.standard(self.e, border[going], there)
            cost, gradient, hessian = self.linearise_own(z, columns)
            cost = cost + 0.5 * np.sum(there**2, axis=1)
            lower = (cost < lowest[going]) & np.isfinite(gradient).all(axis=1)
            at, slope = going[lower], (there + gradient)[lower]
            lowest[at], mean[at], precision[at] = cost[lower], there[lower], np.eye(len(columns)) + hessian[lower]
            step[going[~lower]] *= 0.5
            step[at] = np.linalg.solve(precision[at], slope[..., None])[..., 0]
            step *= LONGEST / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), LONGEST)
            going = going[np.einsum("mi,mij,mj->m", step, precision, step)[going] > CLOSE**2]
        return mean, precision, lowest

    def followed(self, border: Array, origin: Array, own: Array, block: Array, edge: Array) -> tuple[Array, Array]:
        """The own quantities that J is low at, given what is shared (M, c), and their precision (M, n_e, n_e), from
        those (n_e,) that J is low at where what is shared is at its ``origin`` (c,), with ``block`` (n_e, n_e) and
        ``edge`` (c, n_e) of J's Hessian there.

        In stages, each from where the line through the last two leads: what one experiment knows much better alone than
        what is shared, as a time shift, is off the straight line of the Hessian by many of its standard deviations, and
        from there a descent may end in another minimum.
        """
        precision, step = np.broadcast_to(block, (len(border), *block.shape)), (border - origin) / STAGES
        if not len(own):
            return np.zeros((len(border), 0)), precision
        mean, ahead = own, -np.linalg.solve(block, edge.T @ step.T).T
        for stage in range(1, STAGES + 1):
            before = mean
            mean, precision, _ = self.settled(origin + stage * step, mean + ahead, precision, STEPS)
            ahead = mean - before
        return mean, precision


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
class JointDescent(Descends):
    """A descent: the ``place`` where it goes on, the ``system`` where it was linearised last, by a bundle that is
    ``wider``, and the length of the step from there, and J of its iterates. ``step``: the system of the iteration under
    way, None where there is none."""

    place: Place
    system: ArrowSystem | None = None
    wider: float = 1.0
    norm: float = np.inf
    costs: list[float] = field(default_factory=list)

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
                descent.stop = counted(scheme.max_iterations, "iteration")
            descent.ended = bool(descent.stop)

    def search(self, descent: JointDescent) -> Search:
        """The first of the lengths at which J has fallen enough, of a step that moves no experiment absurdly far."""
        at = descent.at
        border, own = at.direction
        standard = self.joint.standard
        far = max(float(np.linalg.norm(standard(e, border, step))) for e, step in enumerate(own))
        for length in np.array(LENGTHS) * (LONGEST / max(far, LONGEST)):
            there, enough = at.place.moved(at.direction, length), at.cost - SUFFICIENT * length * at.norm**2
            cost = yield [there]
            if cost > enough:  # a straight step leaves a bent valley that own quantities follow what is shared in
                there = self._settled(there, at.arrow)
                cost = yield [there]
            if cost <= enough:
                return Move(there, cost, length)
        return None

    def _settled(self, place: Place, arrow: Arrow) -> Place:
        """With the own quantities that J is low at, given what is shared."""
        each = zip(self.experiments, place.own, arrow.blocks, strict=True)
        own = [e.settled(place.border[None], v[None], block[None], STEPS)[0][0] for e, v, block in each]
        return Place(place.border, tuple(own))

    def try_out(self, candidates: Sequence[Place]) -> float:
        """J at the one candidate there is."""
        (place,) = candidates
        total = place.background
        for e, experiment in enumerate(self.experiments):
            total += float(experiment.costs(self.joint.standard(e, place.border, place.own[e])[None])[0])
            if not np.isfinite(total):
                break
        return total

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
